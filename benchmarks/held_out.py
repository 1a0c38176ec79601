"""Accuracy on sequences drawn at random, which no setting was chosen by.

    python benchmarks/held_out.py --data ../shared/data --first 30000

Each seed draws a shape of the family of camera paths, whole or in part, a path, a speed, a tilt
and a level of noise; the default options are compared with one relaxation and the nuclear norm as
there. The sequences that lose more than 5 % follow the table.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smsr.benchmark.camera_paths import (
    PATHS,
    SHAPES,
    compared,
    geometric_mean,
    lost,
    lost_lines,
    noisy_tracks,
    of_each_member,
    sway,
    true_shapes,
    write_members,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smsr.benchmark.camera_paths import Member

NOISES = (0.0, 0.005, 0.01, 0.02, 0.05)
SPEEDS = (0.5, 1.0, 1.5)
FEWEST_FRAMES = 24


def measure(folder: Path, seed: int) -> Member:
    """Draw a sequence and reconstruct it in the three ways."""
    rng = np.random.default_rng(seed)
    shape, path = str(rng.choice(list(SHAPES))), str(rng.choice(list(PATHS)))
    noise, speed = float(rng.choice(NOISES)), float(rng.choice(SPEEDS))
    true = true_shapes(folder, shape)
    if rng.random() < 0.5:
        frames = int(rng.integers(max(FEWEST_FRAMES, len(true) // 3), len(true) + 1))
        first = int(rng.integers(0, len(true) - frames + 1))
        true = true[first : first + frames]
    tilt = sway(rng.normal(0.0, 25.0, 1), rng.normal(0.0, 40.0, 1))
    rotations = PATHS[path](speed * np.arange(len(true), dtype=np.float64), rng) @ tilt
    W = noisy_tracks(rotations, true, noise, rng)
    return compared((shape, path, noise), W, rotations, true)


def table(members: list[Member]) -> str:
    """Return the mean ratios to the baseline by path as a table in Markdown."""
    lines = ["| path | sequences | ratio | camera frame | lost |", "|---|---|---|---|---|"]
    by_path = {path: [one for one in members if one.path == path] for path in PATHS}
    for path, some in [*by_path.items(), ("all", members)]:
        if some:
            lines.append(
                f"| {path} | {len(some)} | {_ratio(some, 0)} | {_ratio(some, 1)} | "
                f"{len(lost(some))} |"
            )
    return "\n".join(lines) + "\n"


def _ratio(some: Sequence[Member], frame: int) -> str:
    return f"{geometric_mean(one.ratios[frame] for one in some):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SMSR_DATA"))
    parser.add_argument("--json", type=Path, help="file that receives the members")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.data is None or not chosen.data.is_dir():
        parser.error("the evaluation data are needed: --data FOLDER or SMSR_DATA")
    seeds = range(chosen.first, chosen.first + chosen.count)
    members = list(of_each_member(partial(measure, chosen.data), seeds, chosen.processes))
    print(table(members))
    print("\n".join(f"- {line}" for line in lost_lines(members)))
    if chosen.json:
        write_members(chosen.json, members)


if __name__ == "__main__":
    main()
