"""Generated sequences with known truth: an example to try, and low-rank problems to test with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """A sequence whose 3D truth is known.

    Attributes
    ----------
    measurements : ndarray of shape (2T, N), float64
        W, rows u1, v1, u2, v2, ...: ``W_t = R_t S_t + t_t``.
    ground_truth : ndarray of shape (T, N, 3), float64
        S in the object frame, centred in each frame, in the units of W.
    faces : ndarray of shape (F, 3), int32
        Triangles, counter-clockwise seen from outside; none where the points form no surface.
    cameras : ndarray of shape (T, 2, 3), float64
        R.
    """

    measurements: Array
    ground_truth: Array
    faces: NDArray[np.int32]
    cameras: Array


def make_example(frames: int = 60, side: int = 40, seed: int = 0) -> Example:
    """Make a talking, breathing mask under a camera that swings around it.

    Parameters
    ----------
    frames : int
        T, at least 3.
    side : int
        Points along each side of the surface's grid, at least 3; N is ``side ** 2``.
    seed : int
        Chooses the expressions and the camera's path; equal seeds give equal arrays.

    Returns
    -------
    Example
        Units are pixels of an image about 640 wide, v counted from the top. The shapes are a mean
        and five modes of deformation, so the centred W has a rank of at most 18.
    """
    rng = np.random.default_rng(seed)
    shapes, faces = _mask(frames, side, rng)
    shapes *= 170.0
    shapes -= shapes.mean(axis=1, keepdims=True)
    time = np.linspace(0.0, 1.0, frames)
    start, tilt = rng.uniform(0.0, 2.0 * np.pi, 2)
    yaw = np.radians(55.0) * np.sin(2.0 * np.pi * 1.5 * time + start)
    pitch = np.radians(24.0) * np.sin(2.0 * np.pi * 1.1 * time + tilt)
    roll = np.radians(6.0) * np.sin(2.0 * np.pi * 0.7 * time)
    cameras = _cameras(yaw, pitch, roll)
    cameras[:, 1] *= -1.0  # pixels count from the top
    drift = np.stack([320.0 + 25.0 * np.sin(5.0 * time), 240.0 + 15.0 * np.cos(4.0 * time)], axis=1)
    return Example(_project(cameras, shapes, drift), shapes, faces, cameras)


def make_low_rank(
    frames: int,
    points: int,
    modes: int = 2,
    *,
    amplitude: float = 0.3,
    noise: float = 0.0,
    seed: int = 0,
) -> Example:
    """Make a random shape with random smooth deformations under a smoothly turning camera.

    Parameters
    ----------
    frames, points : int
        T and N.
    modes : int
        Modes of deformation beside the mean shape: the basis size K is ``modes + 1``.
    amplitude : float
        Standard deviation of a mode's displacement, the mean shape's extent being 1.
    noise : float
        Standard deviation of Gaussian noise on W, in the same unit.
    seed : int
        Chooses everything random.

    Returns
    -------
    Example
        Without faces.
    """
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.0, frames)
    rates = rng.uniform(0.5, 3.0, modes)
    phases = rng.uniform(0.0, 2.0 * np.pi, modes)
    weights = np.sqrt(2.0) * np.sin(2.0 * np.pi * np.outer(time, rates) + phases)
    basis = rng.standard_normal((modes + 1, points, 3))
    shapes = basis[0] + amplitude * np.tensordot(weights, basis[1:], axes=1)
    shapes -= shapes.mean(axis=1, keepdims=True)
    start, tilt = rng.uniform(0.0, 2.0 * np.pi, 2)
    yaw = start + 2.0 * np.pi * time
    pitch = 0.5 * np.sin(2.0 * np.pi * 1.3 * time + tilt)
    cameras = _cameras(yaw, pitch, np.zeros(frames))
    measurements = _project(cameras, shapes, rng.standard_normal((frames, 2)))
    measurements += noise * rng.standard_normal(measurements.shape)
    return Example(measurements, shapes, np.empty((0, 3), np.int32), cameras)


def write_example(
    folder: str | os.PathLike[str], *, frames: int = 60, side: int = 40, seed: int = 0
) -> Example:
    """Write `make_example` as measurements.npy, ground_truth.npy and faces.npy.

    Parameters
    ----------
    folder : path
        Created if need be.
    frames, side, seed
        As in `make_example`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    example = make_example(frames, side, seed)
    for name in ("measurements", "ground_truth", "faces"):
        np.save(folder / f"{name}.npy", getattr(example, name), allow_pickle=False)
    return example


def _mask(frames: int, side: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.int32]]:
    """Shapes (T, side^2, 3) of an expressive mask about 2 high, x right, y up, z to the viewer."""
    across, up = np.meshgrid(np.linspace(-1.0, 1.0, side), np.linspace(1.0, -1.0, side))
    u, v = across.ravel(), up.ravel()
    longitude, latitude = np.radians(80.0) * u, np.radians(75.0) * v
    width = 0.78 - 0.13 * np.clip(-v, 0.0, 1.0) ** 2  # narrower at the chin
    x = width * np.sin(longitude) * np.cos(latitude)
    y = np.sin(latitude) * 1.05
    z = 0.85 * np.cos(longitude) * np.cos(latitude)

    def bump(x0: float, y0: float, across: float, up: float) -> Array:
        value: Array = np.exp(-(((x - x0) / across) ** 2) - ((y - y0) / up) ** 2)
        return value

    nose = bump(0.0, -0.05, 0.11, 0.16) + 0.55 * bump(0.0, 0.16, 0.08, 0.18)
    eyes = bump(-0.3, 0.25, 0.15, 0.1) + bump(0.3, 0.25, 0.15, 0.1)
    brows = bump(-0.3, 0.43, 0.22, 0.08) + bump(0.3, 0.43, 0.22, 0.08)
    cheeks = bump(-0.38, -0.2, 0.2, 0.2) + bump(0.38, -0.2, 0.2, 0.2)
    lips = bump(0.0, -0.38, 0.2, 0.045) + bump(0.0, -0.5, 0.17, 0.045)
    mouth = bump(0.0, -0.44, 0.16, 0.06)
    chin = bump(0.0, -0.78, 0.2, 0.14)
    relief = (
        0.26 * nose
        - 0.13 * eyes
        + 0.06 * brows
        + 0.05 * cheeks
        + 0.06 * lips
        - 0.03 * mouth
        + 0.06 * chin
    )
    rest = np.stack([x, y, z + relief], axis=1)

    zero = np.zeros_like(x)
    below = 1.0 / (1.0 + np.exp((y + 0.44) / 0.05))  # 1 below the mouth's line, 0 above
    corners = bump(-0.24, -0.44, 0.14, 0.12) - bump(0.24, -0.44, 0.14, 0.12)
    modes = np.stack(
        [
            np.stack([zero, -0.28 * below, -0.12 * below - 0.1 * mouth], axis=1),  # jaw
            np.stack(
                [-0.13 * corners, 0.12 * np.abs(corners), -0.06 * np.abs(corners)], axis=1
            ),  # smile
            np.stack([zero, 0.12 * brows, 0.03 * brows], axis=1),  # raised brows
            np.stack([0.1 * np.sign(x) * cheeks, zero, 0.14 * cheeks], axis=1),  # puffed cheeks
            np.stack([0.05 * x, 0.02 * y, 0.07 * z], axis=1),  # breath
        ]
    )
    shapes = rest + np.tensordot(_expressions(frames, len(modes), rng), modes, axes=1)
    return shapes, _grid_faces(side)


def _expressions(frames: int, modes: int, rng: np.random.Generator) -> Array:
    """Smooth weights (T, modes) between about -0.3 and 1."""
    time = np.linspace(0.0, 1.0, frames)[:, None]
    rates = np.array([4.0, 2.0, 2.6, 1.7, 3.1])[:modes]
    phases = rng.uniform(0.0, 2.0 * np.pi, modes)
    slow = rng.uniform(0.0, 2.0 * np.pi, modes)
    waves = 0.5 + 0.5 * np.sin(2.0 * np.pi * rates * time + phases)
    weights: Array = waves * (0.7 + 0.3 * np.sin(2.0 * np.pi * 0.8 * time + slow))
    return weights


def _grid_faces(side: int) -> NDArray[np.int32]:
    """Two triangles (F, 3) for each cell of a row-major grid that starts at the upper left."""
    corner = np.arange(side * side, dtype=np.int32).reshape(side, side)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.stack([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)], axis=2)
    return triangles.reshape(-1, 3)


def _cameras(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Rows x and y (T, 2, 3) of the rotations ``Rz(roll) Rx(pitch) Ry(yaw)``, radians."""
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)

    def matrices(rows: list[list[Array]]) -> Array:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    around_y = matrices(
        [[np.cos(yaw), zero, np.sin(yaw)], [zero, one, zero], [-np.sin(yaw), zero, np.cos(yaw)]]
    )
    around_x = matrices(
        [
            [one, zero, zero],
            [zero, np.cos(pitch), -np.sin(pitch)],
            [zero, np.sin(pitch), np.cos(pitch)],
        ]
    )
    around_z = matrices(
        [[np.cos(roll), -np.sin(roll), zero], [np.sin(roll), np.cos(roll), zero], [zero, zero, one]]
    )
    rotations: Array = around_z @ around_x @ around_y
    return np.ascontiguousarray(rotations[:, :2])


def _project(cameras: Array, shapes: Array, translations: Array) -> Array:
    """W (2T, N) of shapes (T, N, 3) seen by cameras (T, 2, 3)."""
    tracks = cameras @ shapes.transpose(0, 2, 1) + translations[:, :, None]
    return np.ascontiguousarray(tracks.reshape(2 * len(shapes), -1))
