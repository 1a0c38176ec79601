"""Measure the error of true shapes under many camera paths and levels of noise.

    python benchmarks/camera_paths.py --data ../shared/data --out camera-paths

The shapes are those of the evaluation sets; cameras and noise are made here, the same in every run.
Each member of the family is reconstructed three times: as a baseline by one convex relaxation and
the nuclear norm, with the default options, and with the true cameras. Errors are e3D in the object
frame and in the camera frame, which does not see a slow drift of the cameras. ``camera-paths.md``
and ``camera-paths.json`` receive the table and every member.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before BLAS is loaded: processes share the cores

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation

from smsr import reconstruct
from smsr.alignment import orthogonal_factor
from smsr.rotations import complete
from smsr.shapes import reweighted_shapes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SPARSE = ("drink", "pickup", "stretch", "yoga", "dance", "dinosaur")
DENSE = ("facecap", "samba")
NOISES = (0.0, 0.01, 0.05)
MOST_FRAMES = 370
POINTS = 500

AXIS = np.array([0.15, 1.0, 0.1]) / np.linalg.norm([0.15, 1.0, 0.1])


def turn(degrees: Array) -> Array:
    """Rotations (T, 3, 3) by angles (T,) about one tilted axis."""
    return np.asarray(Rotation.from_rotvec(np.radians(degrees)[:, None] * AXIS).as_matrix())


def sway(x: Array, y: Array | float = 0.0, z: Array | float = 0.0) -> Array:
    """Rotations (T, 3, 3) of rotation vectors in degrees."""
    vectors = np.stack(np.broadcast_arrays(x, y, z), axis=1)
    return np.asarray(Rotation.from_rotvec(np.radians(vectors)).as_matrix())


def handheld(t: Array, rng: np.random.Generator) -> Array:
    """Random walk that is drawn back to where it started."""
    steps = 0.8 * rng.standard_normal((len(t), 3))
    angles = np.zeros_like(steps)
    for i in range(1, len(t)):
        angles[i] = 0.99 * angles[i - 1] + steps[i]
    return sway(*angles.T)


def oscillate(t: Array, _: np.random.Generator) -> Array:
    phase = 2.0 * np.pi * t / len(t)
    zero = np.zeros_like(t)
    return sway(12.0 * np.sin(2.2 * phase + 0.7)) @ sway(zero, 45.0 * np.sin(1.5 * phase))


def lissajous(t: Array, _: np.random.Generator) -> Array:
    phase = 2.0 * np.pi * t / len(t)
    return sway(30.0 * np.sin(3 * phase), 60.0 * np.sin(2 * phase + 1.0), 10.0 * np.sin(phase))


def wobble(t: Array, _: np.random.Generator) -> Array:
    phase = 2.0 * np.pi * t / len(t)
    return sway(8.0 * np.sin(5 * phase), 0.0, 5.0 * np.cos(7 * phase)) @ turn(2.0 * t)


def stop_and_go(t: Array, _: np.random.Generator) -> Array:
    going = (t // max(8, len(t) // 8)) % 2 == 0
    return turn(np.cumsum(4.0 * going))


def two_turns(t: Array, _: np.random.Generator) -> Array:
    half = len(t) / 2
    return sway(3.0 * np.maximum(t - half, 0.0)) @ turn(3.0 * np.minimum(t, half))


def jitter(t: Array, rng: np.random.Generator) -> Array:
    return sway(*(2.0 * rng.standard_normal((3, len(t))))) @ turn(3.0 * t)


PATHS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "slow": lambda t, _: turn(1.0 * t),
    "fast": lambda t, _: turn(5.0 * t),
    "accelerate": lambda t, _: turn(np.cumsum(np.linspace(1.0, 5.0, len(t)))),
    "reversal": lambda t, _: turn(3.0 * np.minimum(t, len(t) - t)),
    "stop and go": stop_and_go,
    "jitter": jitter,
    "wobble": wobble,
    "oscillate": oscillate,
    "lissajous": lissajous,
    "two turns": two_turns,
    "handheld": handheld,
    "tripod": lambda t, _: turn(0.0 * t),
}
"""Cameras (T, 3, 3) by frame number and random generator; the units are degrees a frame."""


@dataclass(frozen=True)
class Errors:
    """e3D in the two frames."""

    object: float
    camera: float


@dataclass(frozen=True)
class Member:
    """One shape under one path with one level of noise, and how it came out."""

    shape: str
    path: str
    noise: float
    model: str
    seconds: float
    baseline: Errors
    default: Errors
    true_cameras: Errors


@cache
def true_shapes(folder: Path, name: str) -> Array:
    """Return centred shapes (T, 3, N) of at most so many frames and points."""
    if name in SPARSE:
        content = scipy.io.loadmat(folder / "sparse" / f"{name}.mat")
        S = content["GT"][0, 0]["shape3D"] if name == "dinosaur" else content["S"]
    else:
        with np.load(folder / "dense" / f"{name}.npz") as stored:
            S = stored["S_world"]
    shapes = np.asarray(S, dtype=np.float64).reshape(-1, 3, S.shape[-1])
    shapes = shapes[:: math.ceil(len(shapes) / MOST_FRAMES)]
    points = shapes.shape[2]
    if points > POINTS:
        chosen = np.random.default_rng(1).choice(points, POINTS, replace=False)
        shapes = shapes[:, :, np.sort(chosen)]
    shapes = shapes - shapes.mean(axis=2, keepdims=True)
    return np.asarray(shapes / np.abs(shapes).max())


def e3d(found: NDArray[Any], true: Array) -> float:
    """Return e3D of shapes (T, 3, N), aligned by one orthogonal matrix."""
    turned = orthogonal_factor(np.einsum("tin,tjn->ij", true, found)) @ found
    return float(np.linalg.norm(turned - true, axis=1).mean() / true.std(axis=2).mean())


def errors(cameras: Array, shapes: NDArray[Any], rotations: Array, true: Array) -> Errors:
    """Compare shapes (T, 3, N) with the truth in both frames."""
    return Errors(e3d(shapes, true), e3d(complete(cameras) @ shapes, rotations @ true))


def measure(folder: Path, key: tuple[str, str, float]) -> Member:
    """Make one member and reconstruct it in the three ways."""
    name, path, noise = key
    true = true_shapes(folder, name)
    rng = np.random.default_rng(zlib.crc32(f"{name} {path} {noise}".encode()))
    rotations = PATHS[path](np.arange(len(true), dtype=np.float64), rng) @ sway(
        np.array([20.0]), 30.0
    )
    W = (rotations[:, :2] @ true).reshape(2 * len(true), -1)
    W = W + noise * np.abs(W).max() * rng.standard_normal(W.shape)

    plain = reconstruct(W, camera_model="relaxed", basis_size=10, shape_method="nuclear", noise=0.0)
    start = time.process_time()
    result = reconstruct(W)
    seconds = time.process_time() - start
    centred = W - W.mean(axis=1, keepdims=True)
    known = reweighted_shapes(centred, rotations).shapes
    return Member(
        shape=name,
        path=path,
        noise=noise,
        model=result.diagnostics.camera_model,
        seconds=seconds,
        baseline=errors(plain.cameras, plain.shapes.transpose(0, 2, 1), rotations, true),
        default=errors(result.cameras, result.shapes.transpose(0, 2, 1), rotations, true),
        true_cameras=errors(rotations[:, :2], known, rotations, true),
    )


def mean(values: Iterable[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(np.maximum(list(values), 1e-12)))))


def markdown(members: list[Member]) -> str:
    """Return geometric means over the shapes, and the members that lost."""
    lines = [
        "| noise | path | baseline | default | true cameras | ratio | camera frame | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for noise, path in dict.fromkeys((one.noise, one.path) for one in members):
        some = [one for one in members if (one.noise, one.path) == (noise, path)]
        baseline, default, known = (
            mean(getattr(one, what).object for one in some)
            for what in ("baseline", "default", "true_cameras")
        )
        camera = mean(one.default.camera / one.baseline.camera for one in some)
        slowest = max(one.seconds for one in some)
        lines.append(
            f"| {noise:.0%} | {path} | {baseline:.4f} | {default:.4f} | {known:.4f} "
            f"| {default / baseline:.2f} | {camera:.2f} | {slowest:.1f} |"
        )
    lines += ["", "Members that lost more than 5 %:", ""]
    for one in members:
        ratios = (
            one.default.object / one.baseline.object,
            one.default.camera / one.baseline.camera,
        )
        if max(ratios) > 1.05:
            lines.append(
                f"- {one.shape}, {one.path}, {one.noise:.0%} noise: {ratios[0]:.2f} in the object "
                f"frame, {ratios[1]:.2f} in the camera frame"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SMSR_DATA"))
    parser.add_argument("--out", type=Path, default=Path("camera-paths"))
    parser.add_argument("--shapes", nargs="+", choices=SPARSE + DENSE, default=SPARSE + DENSE)
    parser.add_argument("--paths", nargs="+", choices=list(PATHS), default=list(PATHS))
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="two shapes, four paths, no noise")
    chosen = parser.parse_args()
    if chosen.data is None or not chosen.data.is_dir():
        parser.error("the evaluation data are needed: --data FOLDER or SMSR_DATA")
    keys = list(product(chosen.shapes, chosen.paths, chosen.noises))
    if chosen.quick:
        keys = list(
            product(("yoga", "facecap"), ("fast", "reversal", "handheld", "tripod"), (0.0,))
        )
    keys.sort(key=lambda key: (key[2], list(PATHS).index(key[1])))
    with ProcessPoolExecutor(chosen.processes) as pool:
        members = list(pool.map(partial(measure, chosen.data), keys))
    table = markdown(members)
    chosen.out.with_suffix(".md").write_text(table)
    report = [asdict(one) for one in members]
    chosen.out.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    print(table)


if __name__ == "__main__":
    main()
