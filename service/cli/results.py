"""Commands that show a result: as an animated GLB."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.exits import console
from smsr.errors import ArrayNotFound
from smsr.files import GlbOptions, load_faces, open_result, write_glb
from smsr.files.glb import ImageV

Result = Annotated[
    Path,
    typer.Argument(
        exists=True, metavar="RESULT", show_default=False, help="result.npz, or its folder."
    ),
]
DEFAULTS = GlbOptions()


def convert(
    result: Result,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE.glb", help="[default: beside RESULT]"),
    ] = None,
    fps: Annotated[
        float, typer.Option(min=0.001, max=1000, help="Frames of the sequence per second.")
    ] = DEFAULTS.fps,
    quantised: Annotated[
        bool, typer.Option("--quantised", help="16-bit integers: smaller, for newer viewers.")
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th frame.")] = 1,
    image_v: Annotated[
        ImageV, typer.Option(help="Where the second image coordinate grows to; down for pixels.")
    ] = DEFAULTS.image_v,
) -> None:
    """Write a result as one animated GLB, for Blender and viewers.

    It stands upright and as the first camera saw it. With faces in the result it is a mesh, and
    otherwise points coloured by depth.
    """
    source = result / "result.npz" if result.is_dir() else result
    target = out or source.with_suffix(".glb")
    found = open_result(source)
    try:
        faces = load_faces(source, found.shapes.shape[1], key="faces")
    except ArrayNotFound:
        faces = None
    write_glb(
        target, found.shapes, found.cameras, faces, GlbOptions(fps, quantised, every, image_v)
    )
    console.print(f"Wrote {target} ({target.stat().st_size / 2**20:.1f} MiB)", soft_wrap=True)
