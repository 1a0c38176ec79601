"""Accuracy on sheets: generated paper, cloth, flags and torn sheets under paths of the camera.

    python benchmarks/sheets.py --json sheets.json

Every figure is the geometric mean of e3d over the sequences, in the object frame and, behind the
slash, in the camera frame: of one relaxation and the nuclear norm, of the default options, and of
the default shape stage with the true cameras.
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from smsr.benchmark.camera_paths import (
    PATHS,
    compared,
    geometric_mean,
    of_each_member,
    write_members,
)
from smsr.benchmark.sheets import SHEETS, sheet_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smsr.benchmark.camera_paths import Errors, Member

SOME_PATHS = (
    "slow",
    "fast",
    "lissajous",
    "pendulum",
    "two turns",
    "jitter",
    "slow pan",
    "handheld",
)


def measure(key: tuple[str, str, float, int]) -> Member:
    """Make a sequence and reconstruct it in the three ways."""
    sheet, path, noise, seed = key
    return compared(key[:3], *sheet_tracks(sheet, path, noise=noise, seed=seed))


def table(members: list[Member]) -> str:
    """Return the geometric means over paths and seeds as a table in Markdown."""
    lines = [
        "| noise | sheet | one relaxation | default | true cameras |",
        "|---|---|---|---|---|",
    ]
    for noise, sheet in dict.fromkeys((one.noise, one.shape) for one in members):
        some = [one for one in members if (one.noise, one.shape) == (noise, sheet)]
        ways = zip(*((one.baseline, one.default, one.true_cameras) for one in some), strict=True)
        cells = [_cell(way) for way in ways]
        lines.append("| " + " | ".join([f"{noise:.0%}", sheet, *cells]) + " |")
    return "\n".join(lines) + "\n"


def _cell(some: Sequence[Errors]) -> str:
    in_object = geometric_mean(one.object for one in some)
    return f"{in_object:.3f} / {geometric_mean(one.camera for one in some):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file that receives the members")
    parser.add_argument("--sheets", nargs="+", choices=list(SHEETS), default=list(SHEETS))
    parser.add_argument("--paths", nargs="+", choices=list(PATHS), default=list(SOME_PATHS))
    parser.add_argument("--noises", nargs="+", type=float, default=(0.0, 0.01))
    parser.add_argument("--seeds", type=int, default=3, help="sequences of each kind")
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    which = [
        (sheet, path, noise, seed)
        for noise, sheet, path, seed in product(
            chosen.noises, chosen.sheets, chosen.paths, range(chosen.seeds)
        )
    ]
    members = list(of_each_member(measure, which, chosen.processes))
    print(table(members))
    if chosen.json:
        write_members(chosen.json, members)


if __name__ == "__main__":
    main()
