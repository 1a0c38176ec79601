"""Commands that show a result: as an animation and as figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.exits import console, errors
from smsr.errors import ArrayNotFound, NothingToDraw
from smsr.figures import NAMES, FigureFormat, FigureName, FigureSource, draw
from smsr.files import GlbOptions, load_faces, open_result, write_glb, write_xdmf
from smsr.files.glb import ImageV

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

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
        typer.Option("-o", "--out", metavar="FILE", help="[default: beside RESULT]"),
    ] = None,
    form: Annotated[
        Literal["glb", "xdmf"],
        typer.Option("--format", help="glb for viewers and Blender, xdmf for ParaView."),
    ] = "glb",
    fps: Annotated[
        float, typer.Option(min=0.001, max=1000, help="Frames of the sequence per second.")
    ] = DEFAULTS.fps,
    quantised: Annotated[
        bool, typer.Option("--quantised", help="16-bit integers: smaller, for newer viewers.")
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th frame.")] = 1,
    image_v: Annotated[
        ImageV,
        typer.Option(
            help="Where the second image coordinate grows to: down for pixels; auto: by its signs."
        ),
    ] = DEFAULTS.image_v,
) -> None:
    """Write a result as one animated GLB, for Blender and viewers, or as XDMF, for ParaView.

    A GLB stands upright and as the first camera saw it. With faces in the result it is a mesh, and
    otherwise points coloured by depth. An XDMF file is small: it names positions in result.npz,
    which has to stay where it is from there.
    """
    source = result / "result.npz" if result.is_dir() else result
    target = out or source.with_suffix(f".{form}")
    if form == "xdmf":
        if quantised or image_v != DEFAULTS.image_v:
            raise typer.BadParameter("--quantised and --image-v are for --format glb.")
        write_xdmf(target, source, fps=fps, every=every)
        console.print(f"Wrote {target}, which reads {source}", soft_wrap=True)
        return
    found = open_result(source)
    faces = _faces_of(source, found.shapes.shape[1])
    options = GlbOptions(fps, quantised, every, image_v)
    write_glb(target, found.shapes, found.cameras, faces, options, found.translations)
    console.print(f"Wrote {target} ({target.stat().st_size / 2**20:.1f} MiB)", soft_wrap=True)


def plot(
    result: Result,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", show_default=False, help=f"{', '.join(NAMES)}; all."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="[default: figures/ beside RESULT]"),
    ] = None,
    form: Annotated[FigureFormat, typer.Option("--format", help="Kind of picture.")] = "png",
    image_v: Annotated[
        ImageV,
        typer.Option(
            help="Where the second image coordinate grows to: down for pixels; auto: by its signs."
        ),
    ] = DEFAULTS.image_v,
) -> None:
    """Draw a result: convergence, singular values, error, shapes and cameras.

    What the run did is read from the report.json beside the result; without it, shapes and cameras
    are drawn.
    """
    wanted: list[FigureName] = [name for name in NAMES if not names or name in names]
    if unknown := set(names or ()) - set(NAMES):
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: not one of {', '.join(NAMES)}")
    source = result / "result.npz" if result.is_dir() else result
    target = out or source.parent / "figures"
    found = open_result(source)
    rows = found.shapes.reshape(-1, 3)
    report = source.with_name("report.json")
    drawn_from = FigureSource(
        json.loads(report.read_text(encoding="utf-8")) if report.exists() else {},
        found.cameras,
        found.translations,
        found.shapes.shape[1],
        lambda start, stop: rows[start:stop],
        _faces_of(source, found.shapes.shape[1]),
        image_v,
    )
    target.mkdir(parents=True, exist_ok=True)
    for name in wanted:
        try:
            picture = draw(name, drawn_from, form)
        except NothingToDraw as problem:
            if names:
                raise
            errors.print(f"{name}: {problem.detail}", soft_wrap=True)
            continue
        (target / f"{name}.{form}").write_bytes(picture)
        console.print(f"{target / f'{name}.{form}'}", soft_wrap=True)


def _faces_of(source: Path, points: int) -> NDArray[np.int32] | None:
    """Return the faces in a result, where it has some."""
    try:
        return load_faces(source, points, key="faces")
    except ArrayNotFound:
        return None
