"""Accuracy with gaps and with gross errors in the tracks.

    python benchmarks/missing_data.py --data ../shared/data --json missing-data.json

Hides positions of the evaluation sets at random or in blocks (tracks that start late, end early or
drop out for an eighth to a quarter of the sequence, never less than a quarter of a track left), or
moves some by up to the spread of the tracks in either coordinate, and reconstructs. Every figure
is the mean over the draws, which are seeded. The tables show e3d, in the frame of each set's ground
truth, and the root mean square error of what was filled in, a coordinate, in parts of the spread.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smsr.benchmark.datasets import DATASETS, load, select
from smsr.completion import completed
from smsr.measurements import as_source
from smsr.metrics import evaluate
from smsr.options import Options
from smsr.pipeline import reconstruct

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

SETS = ("drink", "yoga", "dance", "facecap")


@dataclass(frozen=True)
class Case:
    """One way to spoil the tracks: a kind, the part that is hit, and the option `outliers`."""

    name: str
    kind: str
    part: float = 0.0
    outliers: str = "keep"


CASES = (
    Case("all seen", "none"),
    *(Case(f"{part:.0%} at random", "random", part) for part in (0.1, 0.3, 0.5)),
    *(Case(f"{part:.0%} in blocks", "blocks", part) for part in (0.1, 0.3, 0.5)),
    Case("all seen, reject", "none", outliers="reject"),
    Case("1% errors, reject", "errors", 0.01, "reject"),
    Case("5% errors, reject", "errors", 0.05, "reject"),
    Case("5% errors, keep", "errors", 0.05),
)


@dataclass(frozen=True)
class Row:
    """Means over the draws.

    Attributes
    ----------
    set, case : str
        Names.
    e3d : float
    filled : float or None
        Root mean square error of what was filled in, in parts of the spread; None for nothing.
    missing, rejected : float
        Parts of the positions.
    wrong : float
        Part of the positions that was rejected although nothing had been done to it.
    camera_model : str
        Of the last draw.
    completion_seconds, seconds : float
        Processor time of the completion, and wall time of the reconstruction.
    """

    set: str
    case: str
    e3d: float
    filled: float | None
    missing: float
    rejected: float
    wrong: float
    camera_model: str
    completion_seconds: float
    seconds: float


def spoil(
    tracks: NDArray[np.float64], case: Case, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return tracks (T, 2, N) and which of them (T, N) are hidden or moved."""
    frames, _, points = tracks.shape
    hit = np.zeros((frames, points), dtype=bool)
    if case.kind == "random":
        hit = rng.random((frames, points)) < case.part
    elif case.kind == "blocks":
        hidden = 0
        while hidden < case.part * hit.size:
            point = rng.integers(points)
            length = int(rng.integers(max(2, frames // 8), frames // 4 + 1))
            start = int(rng.integers(-length // 2, frames - length // 2))
            trial = hit[:, point].copy()
            trial[max(0, start) : start + length] = True
            if np.count_nonzero(~trial) >= frames / 4:
                hidden += int(np.count_nonzero(trial)) - int(np.count_nonzero(hit[:, point]))
                hit[:, point] = trial
    elif case.kind == "errors":
        hit = rng.random((frames, points)) < case.part
        moves = rng.uniform(-1.0, 1.0, tracks.shape) * spread(tracks)
        return tracks + hit[:, None] * moves, hit
    return tracks, hit


def spread(tracks: NDArray[np.float64]) -> float:
    """Return the standard deviation of a coordinate about the mean of its frame."""
    return float((tracks - tracks.mean(axis=2, keepdims=True)).std())


def measure(name: str, case: Case, folder: Path, draws: int) -> Row:
    """Spoil one set, reconstruct and compare."""
    (dataset,) = select([name])
    measurements, truths = load(dataset, folder)
    clean = np.asarray(measurements, dtype=np.float64)
    tracks = clean.reshape(len(clean) // 2, 2, -1)
    rows = []
    for draw in range(draws):
        spoilt, hit = spoil(tracks, case, np.random.default_rng(draw))
        seen = None if case.kind == "errors" else ~hit
        options = Options(outliers="reject" if case.outliers == "reject" else "keep")
        begun = time.process_time()
        source, gaps = completed(as_source(spoilt), options, seen)
        filled = np.concatenate([block for _, block in source.chunks()], axis=1)
        completion_seconds = time.process_time() - begun
        changed = (filled.reshape(tracks.shape) != spoilt).any(axis=1)
        error = (filled.reshape(tracks.shape) - tracks).transpose(0, 2, 1)[changed]
        begun = time.perf_counter()
        result = reconstruct(spoilt, visibility=seen, options=options)
        seconds = time.perf_counter() - begun
        rows.append(
            Row(
                set=name,
                case=case.name,
                e3d=evaluate(truths[dataset.frame], result, frame=dataset.frame).e3d,
                filled=float(np.sqrt(np.mean(error**2))) / spread(tracks) if len(error) else None,
                missing=gaps.missing / hit.size,
                rejected=gaps.rejected / hit.size,
                wrong=float(np.mean(changed & ~hit)),
                camera_model=result.diagnostics.camera_model,
                completion_seconds=completion_seconds,
                seconds=seconds,
            )
        )
    fills = [row.filled for row in rows if row.filled is not None]
    return Row(
        set=name,
        case=case.name,
        e3d=_mean(row.e3d for row in rows),
        filled=_mean(fills) if fills else None,
        missing=_mean(row.missing for row in rows),
        rejected=_mean(row.rejected for row in rows),
        wrong=_mean(row.wrong for row in rows),
        camera_model=rows[-1].camera_model,
        completion_seconds=_mean(row.completion_seconds for row in rows),
        seconds=_mean(row.seconds for row in rows),
    )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def table(rows: Iterable[Row]) -> str:
    """Return a Markdown table: a case a line, e3d and the error of what was filled in by set."""
    rows = list(rows)
    names = list(dict.fromkeys(row.set for row in rows))
    lines = [
        "| tracks | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for case in dict.fromkeys(row.case for row in rows):
        cells = []
        for name in names:
            (row,) = (row for row in rows if (row.set, row.case) == (name, case))
            filled = "" if row.filled is None else f" ({row.filled:.4f})"
            cells.append(f"{row.e3d:.4f}{filled}")
        lines.append(f"| {case} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data = os.environ.get("SMSR_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(data))
    parser.add_argument("--sets", nargs="+", default=SETS, choices=[d.name for d in DATASETS])
    parser.add_argument("--cases", nargs="+", default=[case.name for case in CASES])
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write all figures to this file")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.sets:
        for case in CASES:
            if case.name in arguments.cases:
                draws = 1 if case.kind == "none" else arguments.draws
                rows.append(measure(name, case, arguments.data, draws))
    print(table(rows))
    if arguments.json:
        text = json.dumps([dataclasses.asdict(row) for row in rows], indent=1)
        arguments.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
