"""Commands that need no server: reconstruct, evaluate, options, example."""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.padding import Padding
from rich.table import Table

import smsr
from service.cli import option_values
from service.cli.bars import SolverBar, progress_bars
from service.cli.exits import console, errors
from smsr.errors import InputError
from smsr.files import load_faces, open_array, open_result, write_glb, write_npz, write_ply
from smsr.measurements import as_source
from smsr.metrics import Frame, as_shapes
from smsr.options import OptionDescription, Options, describe, parse
from smsr.synthetic import write_example
from worker.options import JobOptions

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

    from numpy.typing import NDArray

    from smsr.metrics import Evaluation
    from smsr.progress import Progress, ProgressCallback
    from smsr.result import Diagnostics, Reconstruction

Tracks = Annotated[
    Path,
    typer.Argument(
        exists=True,
        dir_okay=False,
        metavar="FILE",
        show_default=False,
        help="2D tracks: .npy, .npz, .mat, .csv, .txt, ...",
    ),
]
Faces = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, metavar="FILE", help="Triangles of the surface."),
]
OptionValues = Annotated[
    list[str] | None,
    typer.Option(
        "-O", "--option", metavar="NAME=VALUE", help="An option, see smsr options; repeatable."
    ),
]
Preset = Annotated[
    str | None, typer.Option(metavar="NAME", help="Short for -O preset=NAME: default or paper.")
]
Key = Annotated[
    str | None, typer.Option(metavar="NAME", help="Name of the array in a file of several.")
]
FrameOfTruth = Annotated[Frame, typer.Option(help="Frame that the ground truth is given in.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]

_OF_FILES = ("measurements_key", "ground_truth_key", "faces_key", "ground_truth_frame")
"""Options of a job that are flags here; by ``-O`` they are taken, too."""


def preset_and_options(
    cls: type, preset: str | None, assignments: list[str] | None
) -> dict[str, object]:
    """Return option values by name; -O wins over --preset."""
    values: dict[str, object] = {} if preset is None else {"preset": preset}
    return values | option_values.read(cls, assignments or [])


def reconstruct(
    file: Tracks,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, metavar="FILE", help="True 3D shapes, to measure e3D."
        ),
    ] = None,
    faces: Faces = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Folder of the result. [default: FILE-3d]"),
    ] = None,
    preset: Preset = None,
    key: Key = None,
    ground_truth_key: Key = None,
    faces_key: Key = None,
    frame: FrameOfTruth = "auto",
    option: OptionValues = None,
    ply: Annotated[bool, typer.Option(help="Write a PLY of every frame.")] = True,
    glb: Annotated[
        bool, typer.Option("--glb", help="Write an animated GLB; smsr convert has its options.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Reconstruct the surface from 2D tracks, on this machine.

    Writes result.npz, report.json and frames/frame_0000.ply, ... into the folder; with ground truth
    it tells the error e3D.
    """
    values = preset_and_options(JobOptions, preset, option)
    given = parse(JobOptions, {name: values.pop(name) for name in _OF_FILES if name in values})
    key = key or given.measurements_key
    ground_truth_key = ground_truth_key or given.ground_truth_key
    faces_key = faces_key or given.faces_key
    if frame == "auto":
        frame = given.ground_truth_frame
    options = parse(Options, values)
    # All inputs are checked before the work begins.
    with _naming(file):
        measurements = open_array(file, key=key)
        source = as_source(measurements, options.layout, check=options.missing == "refuse")
    truth = triangles = None
    if ground_truth is not None:
        with _naming(ground_truth):
            truth = open_array(ground_truth, key=ground_truth_key, role="ground_truth")
            truth = as_shapes(truth, source.frames, source.points)
    if faces is not None:
        with _naming(faces):
            triangles = load_faces(faces, source.points, key=faces_key)
    target = out or Path(f"{file.stem}-3d")
    target.mkdir(parents=True, exist_ok=True)

    # The arrays are views of files in the scratch folder: all is written before it goes.
    with (
        tempfile.TemporaryDirectory(dir=target, prefix=".arrays-") as scratch,
        progress_bars() as bars,
    ):
        bar = SolverBar(bars, file.name)
        with _stop_at_interrupt(bar) as progress:
            result = smsr.reconstruct(source, out=scratch, progress=progress, options=options)
        bar.finish()
        error = None if truth is None else smsr.evaluate(truth, result, frame=frame)
        report = result.diagnostics.to_dict()
        report["metrics"] = None if error is None else error.to_dict()
        _write(target, result, triangles, report, ply=ply)
        if glb:
            write_glb(
                target / "result.glb",
                result.shapes,
                result.cameras,
                triangles,
                translations=result.translations,
            )
    if as_json:
        console.print_json(data=report)
    else:
        _tell(target, result.diagnostics, error)


def evaluate(
    ground_truth: Annotated[
        Path,
        typer.Argument(exists=True, dir_okay=False, metavar="GROUND_TRUTH", show_default=False),
    ],
    result: Annotated[
        Path,
        typer.Argument(exists=True, dir_okay=False, show_default=False, metavar="RESULT.npz"),
    ],
    key: Key = None,
    frame: FrameOfTruth = "auto",
    as_json: AsJson = False,
) -> None:
    """Measure the error of a result against ground truth."""
    with _naming(ground_truth):
        truth = open_array(ground_truth, key=key, role="ground_truth")
    with _naming(result):
        found = open_result(result)
    error = smsr.evaluate(truth, found, frame=frame)
    if as_json:
        console.print_json(data=error.to_dict())
    else:
        console.print(_error_table(error))


def options(
    as_json: AsJson = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
) -> None:
    """List every option: type, default, range, help."""
    described = describe(JobOptions)
    if as_json:
        console.print_json(
            data=[{name: getattr(what, name) for name in what.__slots__} for what in described]
        )
    elif markdown:
        console.print(options_markdown(described), markup=False, soft_wrap=True, end="")
    else:
        for what in described:
            name, kind, default, span, meaning = _cells(what)
            facts = span if what.choices else ", ".join(filter(None, (kind, span)))
            console.print(f"[bold]{name}[/] = {default}  [dim]({facts})[/]")
            console.print(Padding(meaning, (0, 0, 0, 4)))


def example(
    folder: Annotated[Path, typer.Argument(file_okay=False, metavar="DIR", show_default=False)],
    frames: Annotated[int, typer.Option(min=3, help="Number of frames.")] = 60,
    side: Annotated[int, typer.Option(min=3, help="Points along a side of the grid.")] = 40,
    seed: Annotated[int, typer.Option(help="Chooses the expressions and the camera's path.")] = 0,
) -> None:
    """Write a generated example: a talking mask, filmed by a camera that swings around it."""
    made = write_example(folder, frames=frames, side=side, seed=seed)
    points = made.ground_truth.shape[1]
    console.print(
        f"Wrote measurements.npy, ground_truth.npy and faces.npy ({frames} frames of {points} "
        f"points) to {folder}",
        soft_wrap=True,
    )


def options_markdown(described: tuple[OptionDescription, ...]) -> str:
    """Return the table of the options as it stands in the README."""
    lines = ["| option | type | default | range | meaning |", "|---|---|---|---|---|"]
    for what in described:
        name, kind, default, span, meaning = _cells(what)
        lines.append(f"| `{name}` | {kind} | {default} | {span} | {meaning} |")
    return "\n".join(lines) + "\n"


def _cells(what: OptionDescription) -> tuple[str, str, str, str, str]:
    default = json.dumps(what.default) if what.type != "string" else str(what.default or "none")
    low, high = what.minimum, what.maximum
    if what.choices is not None:
        span = ", ".join(what.choices)
    elif low is not None and high is not None:
        span = f"{low:g} to {high:g}"
    elif low is not None:
        span = f"at least {low:g}"
    else:
        span = "" if high is None else f"at most {high:g}"
    default = "none" if what.default is None else default
    return what.name, what.type, default, span, what.help


@contextlib.contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Begin the message of what is wrong with a file with its name."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{file}: {error.detail}", **error.context) from error


@contextlib.contextmanager
def _stop_at_interrupt(bar: SolverBar) -> Iterator[ProgressCallback]:
    """Cancel the run at the first interrupt, in order; a second one is raised at once.

    Python drops an exception that a signal raises while a callback of C code runs, and a run takes
    long: it must not miss the only one.
    """
    interrupted = threading.Event()

    def interrupt(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            signal.default_int_handler(signum, frame)
        interrupted.set()

    def report(progress: Progress) -> bool:
        bar(progress)
        return not interrupted.is_set()

    former = signal.signal(signal.SIGINT, interrupt)
    try:
        yield report
    finally:
        signal.signal(signal.SIGINT, former)


def _write(
    target: Path,
    result: Reconstruction,
    faces: NDArray[Any] | None,
    report: dict[str, Any],
    *,
    ply: bool,
) -> None:
    arrays = {
        "shapes": result.shapes,
        "cameras": result.cameras,
        "translations": result.translations,
    }
    write_npz(target / "result.npz", arrays if faces is None else {**arrays, "faces": faces})
    (target / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if ply:
        (target / "frames").mkdir(exist_ok=True)
        for t, shape in enumerate(result.shapes):
            write_ply(target / "frames" / f"frame_{t:04d}.ply", shape, faces)


def _tell(target: Path, found: Diagnostics, error: Evaluation | None) -> None:
    seconds = sum(found.seconds.values())
    console.print(
        f"{found.frames} frames of {found.points} points in {seconds:.1f} s, K = "
        f"{found.basis_size}, {found.camera_model} camera: {target}",
        soft_wrap=True,
    )
    if error is not None:
        console.print(_error_table(error))
    for caution in found.cautions:
        errors.print(f"[yellow]Caution[/] ({caution.code}): {caution.message}", soft_wrap=True)
    if not found.converged:
        errors.print("[yellow]Caution[/]: a stage stopped before its tolerance; see report.json.")


def _error_table(error: Evaluation) -> Table:
    table = Table(box=None, show_header=False)
    table.add_row("e3D", f"[bold]{error.e3d:.4f}[/]", f"in the {error.frame} frame")
    table.add_row("", f"{error.e3d_per_frame:.4f}", "each frame aligned on its own")
    table.add_row("", f"{error.relative_rms:.4f}", "relative RMS")
    if error.scale != 1.0:
        table.add_row("", f"{error.scale:.4f}", "scale that was fitted, the size being open")
    return table
