"""How much of the error in the object frame is the frame itself.

    python benchmarks/frame.py --data ../shared/data

A camera that may turn in any way cannot be told from one that turns with the object. So even true
shapes have an error once the frame is to be found from them: each is turned to where its points
rest, as free cameras are. Beside it stand the errors of the default, in the object frame and in
that of the camera, without noise: geometric means over paths that are not about one axis.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from smsr.benchmark.camera_paths import (
    SHAPES,
    Errors,
    e3d,
    errors,
    geometric_mean,
    of_each_member,
    tracks,
    true_shapes,
    write_members,
)
from smsr.cameras.rest import resting_frame
from smsr.pipeline import reconstruct

SOME_PATHS = ("wobble", "lissajous", "two turns", "drone", "spiral", "smooth")


@dataclass(frozen=True, slots=True)
class Member:
    """Errors of a set: of its true shapes in their resting frame, and of the default by path."""

    shape: str
    frame: float
    default: dict[str, Errors]


def measure(folder: Path, shape: str) -> Member:
    """Turn the true shapes of a set to their resting frame, and reconstruct them by path."""
    true = true_shapes(folder, shape)
    default = {}
    for path in SOME_PATHS:
        W, rotations, _ = tracks(folder, (shape, path, 0.0))
        result = reconstruct(W)
        default[path] = errors(result.cameras, result.shapes.transpose(0, 2, 1), rotations, true)
    return Member(shape, e3d(resting_frame(true).turns @ true, true), default)


def table(members: list[Member]) -> str:
    """Return a row for each set, in Markdown."""
    lines = ["| set | the frame alone | default | camera frame |", "|---|---|---|---|"]
    for one in members:
        found = one.default.values()
        cells = (
            one.frame,
            geometric_mean(each.object for each in found),
            geometric_mean(each.camera for each in found),
        )
        lines.append(f"| {one.shape} | " + " | ".join(f"{cell:.3f}" for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SMSR_DATA"))
    parser.add_argument("--json", type=Path, help="file that receives the members")
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.data is None or not chosen.data.is_dir():
        parser.error("the evaluation data are needed: --data FOLDER or SMSR_DATA")
    found = of_each_member(partial(measure, chosen.data), chosen.shapes, chosen.processes)
    members = list(found)
    print(table(members))
    if chosen.json:
        write_members(chosen.json, members)


if __name__ == "__main__":
    main()
