"""The family of camera paths: true shapes of the sets under generated cameras and noise.

Published sets have few kinds of cameras. Here each shape is seen along many paths, the same in
every run, and reconstructed three times: as a baseline by one convex relaxation and the nuclear
norm, with the default options, and with the true cameras.
"""

from __future__ import annotations

import json
import math
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from smsr.alignment import orthogonal_factor
from smsr.files import open_array
from smsr.lifting import denoised_lifting
from smsr.measurements import as_source
from smsr.options import Options
from smsr.pipeline import reconstruct
from smsr.reduction import Reduction
from smsr.rotations import complete
from smsr.rowspace import factorise
from smsr.shapes.selection import estimate_shapes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Array: TypeAlias = NDArray[np.float64]
    Key: TypeAlias = tuple[str, str, float]

K = TypeVar("K")
T = TypeVar("T")

SHAPES: Final[Mapping[str, tuple[str, str]]] = {
    "drink": ("sparse/drink.mat", "S"),
    "pickup": ("sparse/pickup.mat", "S"),
    "stretch": ("sparse/stretch.mat", "S"),
    "yoga": ("sparse/yoga.mat", "S"),
    "dance": ("sparse/dance.mat", "S"),
    "dinosaur": ("sparse/dinosaur.mat", "GT.shape3D"),
    "facecap": ("dense/facecap.npz", "S_world"),
    "samba": ("dense/samba.npz", "S_world"),
    "elephant": ("dense/elephant_gallop_base.npz", "S_world"),
}
"""File and key of the true shapes (3T x N) by name."""

NOISES: Final = (0.0, 0.01, 0.05)
"""Standard deviations of the noise, parts of the largest coordinate."""

LOSS: Final = 1.05
"""Ratio to the baseline above which a member counts as lost."""

MOST_FRAMES = 370
MOST_POINTS = 500
_PERIODIC = {"elephant": 48}  # frames of two periods of a motion that repeats itself

AXIS = np.array([0.15, 1.0, 0.1]) / np.linalg.norm([0.15, 1.0, 0.1])


def turn(degrees: Array) -> Array:
    """Rotations (T, 3, 3) by angles (T,) about one tilted axis."""
    return np.asarray(Rotation.from_rotvec(np.radians(degrees)[:, None] * AXIS).as_matrix())


def sway(x: Array, y: Array | float = 0.0, z: Array | float = 0.0) -> Array:
    """Rotations (T, 3, 3) of rotation vectors in degrees."""
    vectors = np.stack(np.broadcast_arrays(x, y, z), axis=1)
    return np.asarray(Rotation.from_rotvec(np.radians(vectors)).as_matrix())


def handheld(t: Array, rng: np.random.Generator) -> Array:
    """Walk at random, drawn back to the start."""
    steps = 0.8 * rng.standard_normal((len(t), 3))
    angles = np.zeros_like(steps)
    for i in range(1, len(t)):
        angles[i] = 0.99 * angles[i - 1] + steps[i]
    return sway(*angles.T)


def oscillate(t: Array, _: np.random.Generator) -> Array:
    """Turn to and fro about the vertical and, at another pace, the horizontal axis."""
    phase = 2.0 * np.pi * t / len(t)
    zero = np.zeros_like(t)
    return sway(12.0 * np.sin(2.2 * phase + 0.7)) @ sway(zero, 45.0 * np.sin(1.5 * phase))


def lissajous(t: Array, _: np.random.Generator) -> Array:
    """Turn by three sines of different frequency."""
    phase = 2.0 * np.pi * t / len(t)
    return sway(30.0 * np.sin(3 * phase), 60.0 * np.sin(2 * phase + 1.0), 10.0 * np.sin(phase))


def wobble(t: Array, _: np.random.Generator) -> Array:
    """Turn steadily and nod."""
    phase = 2.0 * np.pi * t / len(t)
    return sway(8.0 * np.sin(5 * phase), 0.0, 5.0 * np.cos(7 * phase)) @ turn(2.0 * t)


def stop_and_go(t: Array, _: np.random.Generator) -> Array:
    """Turn steadily, with four pauses."""
    going = (t // max(8, len(t) // 8)) % 2 == 0
    return turn(np.cumsum(4.0 * going))


def two_turns(t: Array, _: np.random.Generator) -> Array:
    """Turn about one axis, then about another."""
    half = len(t) / 2
    return sway(3.0 * np.maximum(t - half, 0.0)) @ turn(3.0 * np.minimum(t, half))


def jitter(t: Array, rng: np.random.Generator) -> Array:
    """Turn steadily and shake in every frame on its own."""
    return sway(*(2.0 * rng.standard_normal((3, len(t))))) @ turn(3.0 * t)


def ease(t: Array) -> Array:
    """Return parts of the way, at frames t, of a motion that starts and ends at rest."""
    x = t / len(t)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def pendulum(t: Array, _: np.random.Generator) -> Array:
    """Swing twice about one axis."""
    return turn(40.0 * np.sin(4.0 * np.pi * t / len(t)))


def swing(t: Array, _: np.random.Generator) -> Array:
    """Swing widely, and less than once."""
    return turn(60.0 * np.sin(1.5 * np.pi * t / len(t) + 0.4))


def drone(t: Array, _: np.random.Generator) -> Array:
    """Turn steadily, rising and sinking once."""
    return sway(15.0 * np.sin(2.0 * np.pi * t / len(t))) @ turn(2.0 * t)


def smooth(t: Array, rng: np.random.Generator) -> Array:
    """Turn about all axes by random cosines."""
    cosines = np.cos(np.pi * np.arange(1, 7)[:, None] * (t + 0.5) / len(t))
    sizes = 30.0 / np.arange(1, 7) * rng.standard_normal((3, 6))
    return sway(*(sizes @ cosines))


PATHS: Final[Mapping[str, Callable[[Array, np.random.Generator], Array]]] = {
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
    "eased": lambda t, _: turn(3.0 * len(t) * ease(t)),
    "decelerate": lambda t, _: turn(2.0 * len(t) * (1.0 - (1.0 - t / len(t)) ** 2)),
    "pendulum": pendulum,
    "swing": swing,
    "slow pan": lambda t, _: turn(60.0 * ease(t)),
    "drone": drone,
    "spiral": lambda t, _: sway(20.0 * t / len(t)) @ turn(3.0 * t),
    "smooth": smooth,
}
"""Cameras (T, 3, 3) by frame number and random generator; the units are degrees a frame."""


@dataclass(frozen=True, slots=True)
class Errors:
    """e3D in the two frames; that of the camera does not see a slow drift."""

    object: float
    camera: float


@dataclass(frozen=True, slots=True)
class Member:
    """One shape under one path with one level of noise, and how it came out.

    Attributes
    ----------
    shape, path, noise
        Which member.
    model : str
        The camera model that the default took.
    seconds : float
        Processor time of the default.
    baseline, default, true_cameras : Errors
        Of one relaxation and the nuclear norm, of the default, of the default with true cameras.
    """

    shape: str
    path: str
    noise: float
    model: str
    seconds: float
    baseline: Errors
    default: Errors
    true_cameras: Errors

    @property
    def ratios(self) -> tuple[float, float]:
        """Error of the default over that of the baseline, in the object and the camera frame."""
        return (
            self.default.object / self.baseline.object,
            self.default.camera / self.baseline.camera,
        )


def keys(
    shapes: Iterable[str] = SHAPES,
    paths: Iterable[str] = PATHS,
    noises: Iterable[float] = NOISES,
) -> list[Key]:
    """Return what `measure_members` takes, in the order of the table."""
    return [(shape, path, noise) for noise, path, shape in product(noises, paths, list(shapes))]


@cache
def true_shapes(folder: Path, name: str) -> Array:
    """Return centred shapes (T, 3, N) of at most so many frames and points.

    Raises
    ------
    UnreadableFile
        The file is not there or is broken.
    """
    file, key = SHAPES[name]
    S = open_array(folder / file, key=key, role="ground_truth")
    shapes = np.asarray(S).reshape(-1, 3, S.shape[-1])
    shapes = shapes[:: math.ceil(len(shapes) / MOST_FRAMES)]
    points = shapes.shape[2]
    if points > MOST_POINTS:
        chosen = np.random.default_rng(1).choice(points, MOST_POINTS, replace=False)
        shapes = shapes[:, :, np.sort(chosen)]
    shapes = shapes.astype(np.float64)
    if name in _PERIODIC:
        times = np.arange(len(shapes) + 1)
        spline = CubicSpline(times, np.concatenate([shapes, shapes[:1]]), bc_type="periodic")
        shapes = spline(np.linspace(0.0, 2.0 * len(shapes), _PERIODIC[name], endpoint=False))
    shapes = shapes - shapes.mean(axis=2, keepdims=True)
    return np.asarray(shapes / np.abs(shapes).max())


def e3d(found: NDArray[Any], true: Array) -> float:
    """Return e3D of shapes (T, 3, N), aligned by one orthogonal matrix."""
    turned = orthogonal_factor(np.einsum("tin,tjn->ij", true, found)) @ found
    return float(np.linalg.norm(turned - true, axis=1).mean() / true.std(axis=2).mean())


def errors(cameras: Array, shapes: NDArray[Any], rotations: Array, true: Array) -> Errors:
    """Compare shapes (T, 3, N) with the truth in both frames."""
    return Errors(e3d(shapes, true), e3d(complete(cameras) @ shapes, rotations @ true))


def tracks(folder: Path, key: Key) -> tuple[Array, Array, Array]:
    """Return the tracks W (2T, N), cameras (T, 3, 3) and shapes (T, 3, N) of a member."""
    name, path, noise = key
    true = true_shapes(folder, name)
    rng = np.random.default_rng(zlib.crc32(f"{name} {path} {noise}".encode()))
    times = np.arange(len(true), dtype=np.float64)
    rotations = PATHS[path](times, rng) @ sway(np.array([20.0]), 30.0)
    return noisy_tracks(rotations, true, noise, rng), rotations, true


def noisy_tracks(rotations: Array, shapes: Array, noise: float, rng: np.random.Generator) -> Array:
    """Return the tracks W (2T, N) of shapes (T, 3, N) that cameras (T, 3, 3) see.

    The standard deviation of the noise is a part of the largest coordinate.
    """
    W = (rotations[:, :2] @ shapes).reshape(2 * len(shapes), -1)
    noisy: Array = W + noise * np.abs(W).max() * rng.standard_normal(W.shape)
    return noisy


def with_true_cameras(W: Array, rotations: Array) -> Array:
    """Return the shapes (T, 3, N) of the default shape stage under known cameras.

    As for free cameras: that a path was recognised, which would lower the error, is not told.

    Parameters
    ----------
    W : ndarray of shape (2T, N)
        Rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    space = factorise(as_source(W))
    options = Options()
    reduction = Reduction.of(space, options)
    found = estimate_shapes(
        reduction.measurements,
        rotations,
        options,
        noise=reduction.noise,
        points=reduction.sample,
    )
    lifting = denoised_lifting(reduction.unit * found.shapes, reduction.points.coordinates)
    return lifting.apply(W - space.means[:, None])


def compared(key: Key, W: Array, rotations: Array, true: Array) -> Member:
    """Reconstruct tracks in the three ways.

    Parameters
    ----------
    key
        What the tracks are called.
    W : ndarray of shape (2T, N)
    rotations : ndarray of shape (T, 3, 3)
        True cameras.
    true : ndarray of shape (T, 3, N)
        True shapes, centred.
    """
    plain = reconstruct(W, camera_model="relaxed", basis_size=10, shape_method="nuclear", noise=0.0)
    start = time.process_time()
    result = reconstruct(W)
    seconds = time.process_time() - start
    known = with_true_cameras(W, rotations)
    return Member(
        *key,
        model=result.diagnostics.camera_model,
        seconds=seconds,
        baseline=errors(plain.cameras, plain.shapes.transpose(0, 2, 1), rotations, true),
        default=errors(result.cameras, result.shapes.transpose(0, 2, 1), rotations, true),
        true_cameras=errors(rotations[:, :2], known, rotations, true),
    )


def measure_member(folder: Path, key: Key) -> Member:
    """Make one member and reconstruct it in the three ways."""
    return compared(key, *tracks(folder, key))


def measure_members(folder: Path, members: Sequence[Key], processes: int = 1) -> Iterator[Member]:
    """Measure members of the family, several at a time with one BLAS thread each, in order."""
    return of_each_member(partial(measure_member, folder), members, processes)


def of_each_member(measure: Callable[[K], T], members: Sequence[K], processes: int) -> Iterator[T]:
    """Return what a function of a module finds of each member, as `measure_members` does."""
    context = get_context("spawn")  # threads of the caller's may hold locks
    with ProcessPoolExecutor(processes, context, _one_thread) as pool:
        yield from pool.map(measure, members)


def write_members(path: Path, members: Iterable[Any]) -> None:
    """Write members, dataclasses of any kind, as JSON."""
    text = json.dumps([asdict(one) for one in members], indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def _one_thread() -> None:
    threadpool_limits(limits=1)


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.mean(np.log(np.maximum(list(values), 1e-12)))))


def rows(members: Sequence[Member]) -> list[list[str]]:
    """Return the table: geometric means over the shapes for each path and level of noise.

    The ratio is of the error in the object frame, the column after it of that in the camera frame;
    seconds are those of the slowest member. The first row is the heading.
    """
    table = [
        ["noise", "path", "baseline", "default", "true cameras", "ratio", "camera frame", "seconds"]
    ]
    for noise, path in dict.fromkeys((one.noise, one.path) for one in members):
        some = [one for one in members if (one.noise, one.path) == (noise, path)]
        table.append([f"{noise:.0%}", path, *_cells(some)])
    table.append(["all", "all", *_cells(members)])
    return table


def _cells(some: Sequence[Member]) -> list[str]:
    return [
        f"{geometric_mean(one.baseline.object for one in some):.4f}",
        f"{geometric_mean(one.default.object for one in some):.4f}",
        f"{geometric_mean(one.true_cameras.object for one in some):.4f}",
        f"{geometric_mean(one.ratios[0] for one in some):.2f}",
        f"{geometric_mean(one.ratios[1] for one in some):.2f}",
        f"{max(one.seconds for one in some):.1f}",
    ]


def lost(members: Iterable[Member]) -> list[Member]:
    """Return the members whose error is more than `LOSS` times the baseline's in either frame."""
    return [one for one in members if max(one.ratios) > LOSS]


def lost_lines(members: Iterable[Member]) -> list[str]:
    """Say of each lost member how much it lost."""
    return [
        f"{one.shape}, {one.path}, {100 * one.noise:g}% noise: {one.ratios[0]:.2f} in the object "
        f"frame, {one.ratios[1]:.2f} in the camera frame"
        for one in lost(members)
    ]
