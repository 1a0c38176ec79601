"""Accuracy where the object comes nearer, with and without a camera of varying scale.

    python benchmarks/camera_scale.py --data ../shared/data --json camera-scale.json

True shapes of the sets are seen along some paths of the family of camera paths by three cameras: an
orthographic one; the same whose scale doubles in the course of the sequence and swings meanwhile
(scaled orthography); and a pinhole camera that comes from twelve of the object's radii, the root
mean square distance of its points from their centre, to six. Every figure is the geometric mean of
e3d over the shapes, in the object frame and, behind the slash, in the camera frame.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smsr.benchmark.camera_paths import (
    PATHS,
    SHAPES,
    geometric_mean,
    keys,
    of_each_member,
    tracks,
    write_members,
)
from smsr.metrics import evaluate
from smsr.pipeline import reconstruct

if TYPE_CHECKING:
    from numpy.typing import NDArray

SOME_PATHS = ("slow", "fast", "lissajous", "pendulum", "handheld", "slow pan")
NOISES = (0.0, 0.01)
CASES = (
    ("orthographic", "constant"),
    ("orthographic", "varying"),
    ("scaled", "constant"),
    ("scaled", "varying"),
    ("pinhole", "constant"),
    ("pinhole", "varying"),
)
"""Camera, and the option `camera_scale`."""


@dataclass(frozen=True, slots=True)
class Member:
    """One shape along one path with one level of noise: errors by camera and option."""

    shape: str
    path: str
    noise: float
    object: dict[str, float]
    camera: dict[str, float]


def scales(frames: int) -> NDArray[np.float64]:
    """Return scales (T,) of geometric mean 1 that double from first to last and swing."""
    x = np.linspace(0.0, 1.0, frames)
    logarithms = np.log(2.0) * x + np.log1p(0.1 * np.sin(4.0 * np.pi * x))
    centred: NDArray[np.float64] = np.exp(logarithms - logarithms.mean())
    return centred


def magnified(seen: NDArray[np.float64], camera: str) -> NDArray[np.float64]:
    """Return how much larger (T, 1, N) than orthographically a camera images each point.

    Parameters
    ----------
    seen : ndarray of shape (T, 3, N)
        True shapes in the frame of the camera.
    camera : {"orthographic", "scaled", "pinhole"}
    """
    frames, _, points = seen.shape
    if camera == "orthographic":
        return np.ones((frames, 1, points))
    if camera == "scaled":
        return np.broadcast_to(scales(frames)[:, None, None], (frames, 1, points))
    radius = np.sqrt((seen**2).sum(axis=1).mean())
    distances = 12.0 * radius * 0.5 ** np.linspace(0.0, 1.0, frames)
    logarithms = -np.log(distances[:, None, None] - seen[:, 2:])
    magnification: NDArray[np.float64] = np.exp(logarithms - logarithms.mean())
    return magnification


def measure(folder: Path, key: tuple[str, str, float]) -> Member:
    """Make the tracks of a member as each camera sees them, and reconstruct them."""
    W, rotations, true = tracks(folder, key)
    seen = rotations @ true
    in_object: dict[str, float] = {}
    in_camera: dict[str, float] = {}
    for camera, option in CASES:
        # Noise grows with the image.
        image = W.reshape(len(true), 2, -1) * magnified(seen, camera)
        result = reconstruct(image, camera_scale=option)
        name = f"{camera}, {option}"
        in_object[name] = evaluate(true, result, frame="object").e3d
        in_camera[name] = evaluate(seen, result, frame="camera").e3d
    return Member(*key, object=in_object, camera=in_camera)


def table(members: list[Member]) -> str:
    """Return the geometric means over the shapes as a table in Markdown."""
    names = [", ".join(case) for case in CASES]
    lines = ["| " + " | ".join(["noise", "path", *names]) + " |", "|---" * (2 + len(names)) + "|"]
    for noise, path in dict.fromkeys((one.noise, one.path) for one in members):
        some = [one for one in members if (one.noise, one.path) == (noise, path)]
        cells = (
            f"{geometric_mean(one.object[name] for one in some):.3f} / "
            f"{geometric_mean(one.camera[name] for one in some):.3f}"
            for name in names
        )
        lines.append("| " + " | ".join([f"{noise:.0%}", path, *cells]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SMSR_DATA"))
    parser.add_argument("--json", type=Path, help="file that receives the members")
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--paths", nargs="+", choices=list(PATHS), default=list(SOME_PATHS))
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES)
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.data is None or not chosen.data.is_dir():
        parser.error("the evaluation data are needed: --data FOLDER or SMSR_DATA")
    which = keys(chosen.shapes, chosen.paths, chosen.noises)
    members = list(of_each_member(partial(measure, chosen.data), which, chosen.processes))
    print(table(members))
    if chosen.json:
        write_members(chosen.json, members)


if __name__ == "__main__":
    main()
