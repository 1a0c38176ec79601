"""The command that measures accuracy, time and memory on the evaluation sets."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from service.cli.bars import progress_bars
from service.cli.exits import console
from service.cli.local import AsJson, OptionValues, Preset, preset_and_options
from service.cli.option_values import read
from smsr.benchmark import (
    DATASETS,
    METHODS,
    PUBLISHED,
    best_published,
    camera_paths,
    environment,
    run,
    select,
)
from smsr.options import Options, parse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smsr.benchmark import Dataset, Environment, Figure, Measurement
    from smsr.benchmark.camera_paths import Key, Member

MEBIBYTE = 1 << 20
OURS = "this code"
NOISES = ",".join(f"{noise:g}" for noise in camera_paths.NOISES)


def benchmark(
    data: Annotated[
        Path,
        typer.Option(
            exists=True,
            file_okay=False,
            envvar="SMSR_DATA",
            metavar="DIR",
            help="Folder with sparse/*.mat and dense/*.npz.",
            show_default=False,
        ),
    ],
    sets: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Comma-separated sets, or .npz files. [default: all]"),
    ] = None,
    preset: Preset = None,
    option: OptionValues = None,
    also: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="Measure with this option too, as a row more; repeatable."
        ),
    ] = None,
    paths: Annotated[
        str | None,
        typer.Option(
            "--camera-paths",
            metavar="NAMES",
            help="Then measure the true shapes of the sets under generated camera paths, too: "
            "comma-separated names, or 'all'.",
        ),
    ] = None,
    noises: Annotated[
        str, typer.Option(metavar="PARTS", help="Noise on the camera paths, parts of the extent.")
    ] = NOISES,
    threads: Annotated[int, typer.Option(min=1, help="BLAS threads.")] = 1,
    as_json: AsJson = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown tables.")] = False,
) -> None:
    """Measure e3D, wall time and peak memory on each set, beside the published figures.

    Each set runs in a process of its own, one after the other; the members of the family of camera
    paths run with the default options, two at a time.
    """
    values = preset_and_options(Options, preset, option)
    variants = {"": values}
    for assignment in also or []:
        variants[assignment] = values | read(Options, [assignment])
    for options in variants.values():
        parse(Options, options)
    chosen = DATASETS if sets is None else select(name.strip() for name in sets.split(","))
    family = _family(None if sets is None else [one.name for one in chosen], paths, noises)
    measured: dict[str, list[Measurement]] = {}
    members: list[Member] = []
    with progress_bars() as bars:
        bar = bars.add_task("measuring", total=len(variants) * len(chosen), stage="")
        for variant, options in variants.items():
            measured[variant] = []
            for dataset in chosen:
                bars.update(bar, stage=f"{dataset.name} {variant}")
                measured[variant].append(run(dataset, data, options=options, threads=threads))
                bars.advance(bar)
        bars.update(bar, stage="")
        bar = bars.add_task("camera paths", total=len(family), stage="", visible=bool(family))
        for member in camera_paths.measure_members(data, family, processes=2) if family else ():
            members.append(member)
            bars.update(bar, advance=1, stage=f"{member.path} {member.shape}")
        bars.update(bar, stage="")
    where = environment(threads)
    if as_json:
        console.print_json(
            data={
                "environment": dataclasses.asdict(where),
                "options": values,
                "sets": [dataclasses.asdict(one) for one in measured.pop("")],
                "also": {
                    variant: [dataclasses.asdict(one) for one in sets_of_it]
                    for variant, sets_of_it in measured.items()
                },
                "camera_paths": [dataclasses.asdict(one) for one in members],
            }
        )
        return
    accuracy, cost = accuracy_rows(chosen, measured), cost_rows(measured[""])
    if markdown:
        parts = [_markdown(accuracy), _markdown(cost)]
        if members:
            losses = [f"- {line}" for line in camera_paths.lost_lines(members)]
            parts += [_markdown(camera_paths.rows(members)), "\n".join([_losses(members), *losses])]
        text = "\n\n".join((*parts, footnote(where, measured[""])))
        console.print(text, markup=False, soft_wrap=True)
        return
    console.print(_table(accuracy))
    console.print(_table(cost))
    if members:
        console.print(_table(camera_paths.rows(members)))
        console.print(_losses(members))
        for line in camera_paths.lost_lines(members):
            console.print(line)
    console.print(footnote(where, measured[""]), style="dim")
    for method, source in METHODS.items():
        console.print(f"{method}: {source}", style="dim")


def _family(sets: Sequence[str] | None, paths: str | None, noises: str) -> list[Key]:
    """Return the members of the family of camera paths that are asked for."""
    if paths is None:
        return []
    known = camera_paths.PATHS
    names = list(known) if paths == "all" else [name.strip() for name in paths.split(",")]
    for name in names:
        if name not in known:
            raise typer.BadParameter(f"There is no camera path {name!r}: {', '.join(known)}.")
    try:
        levels = [float(level) for level in noises.split(",")]
    except ValueError:
        raise typer.BadParameter(f"Noises are numbers, not {noises!r}.") from None
    shapes = [name for name in camera_paths.SHAPES if sets is None or name in sets]
    return camera_paths.keys(shapes, names, levels)


def _losses(members: Sequence[Member]) -> str:
    count = len(camera_paths.lost(members))
    return (
        f"{count} of {len(members)} lose more than {camera_paths.LOSS - 1:.0%} against one "
        "relaxation and the nuclear norm."
    )


def accuracy_rows(
    datasets: Sequence[Dataset], measured: Mapping[str, Sequence[Measurement]]
) -> list[list[str]]:
    """Return e3D of every method on every set; the first row names the sets.

    Of the variants that were measured too, only the frame of the ground truth is shown.
    """
    ours = measured[""]
    rows = [["e3D", *(one.name for one in ours)]]
    for method, figures in PUBLISHED.items():
        cells = [_published(figures, one.name) for one in ours]
        if any(cells):
            rows.append([method, *cells])
    for frame in ("object", "camera"):
        cells = [_number(one.e3d.get(frame)) for one in ours]
        if any(cells):
            rows.append([f"{OURS}, {frame} frame", *cells])
    frames = [dataset.frame for dataset in datasets]
    alone = [_number(one.e3d_per_frame[f]) for f, one in zip(frames, ours, strict=True)]
    rows.append([f"{OURS}, each frame aligned", *alone])
    for variant, results in measured.items():
        if variant:
            cells = [_number(one.e3d[f]) for f, one in zip(frames, results, strict=True)]
            rows.append([f"{OURS}, {variant}", *cells])
    return rows


def cost_rows(measured: Sequence[Measurement]) -> list[list[str]]:
    """Return size, time and memory of every set; the first row is the heading."""
    head = ["set", "T", "N", "K", "camera", "seconds", "peak MiB", "converged"]
    return [head] + [
        [
            one.name,
            str(one.frames),
            f"{one.points:,}",
            str(one.basis_size),
            one.camera_model,
            f"{one.seconds:.2f}",
            f"{one.peak_bytes / MEBIBYTE:.0f}",
            "yes" if one.converged else "no",
        ]
        for one in measured
    ]


def footnote(where: Environment, measured: Sequence[Measurement]) -> str:
    """Say what the figures were measured with."""
    start = max(one.start_bytes for one in measured) / MEBIBYTE
    return (
        f"smsr {where.smsr}, Python {where.python}, NumPy {where.numpy}, SciPy {where.scipy}, "
        f"{where.blas} on {where.blas_threads} thread(s), {where.machine} with {where.processors} "
        "processors. Seconds are wall time of the reconstruction, writing included; peak memory is "
        f"that of its process, {start:.0f} MiB of it Python and its libraries."
    )


def _published(figures: Mapping[str, Figure], name: str) -> str:
    if name not in figures:
        return ""
    figure = figures[name]
    best = best_published(name)
    text = _number(figure.e3d) + (f" ({figure.basis_size})" if figure.basis_size else "")
    return f"{text} *" if best is not None and figure.e3d == best[1] else text


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def _table(rows: Sequence[Sequence[str]]) -> Table:
    head, *body = rows
    table = Table(header_style="bold")
    for column, name in enumerate(head):
        if column == 0:
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, justify="right")
    for row in body:
        table.add_row(*row, style="bold" if row[0].startswith(OURS) else None)
    return table


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in body])
