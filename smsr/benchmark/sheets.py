"""Generated sheets: objects that are flat but for their deformation, under the family's paths."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from smsr.benchmark.camera_paths import PATHS, noisy_tracks
from smsr.rotations import exp

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_STEPS = 400  # of the integrals along a bent sheet


def _grid(across: int, down: int, ratio: float) -> Array:
    """Return the points (2, N) of a sheet two units wide."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, across), np.linspace(-ratio, ratio, down))
    return np.stack([x.ravel(), y.ravel()])


def paper(frames: int, rng: np.random.Generator) -> Array:
    """Return a sheet that bends without stretching, about a direction that turns to and fro."""
    time = np.linspace(0.0, 1.0, frames)
    points = _grid(13, 9, 0.7)
    rates, phases = rng.uniform(0.5, 2.0, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    bend, curl, sway = np.sin(2.0 * np.pi * rates[:, None] * time + phases[:, None])
    direction = rng.uniform(0.0, np.pi) + 0.5 * sway
    arc = np.linspace(-1.4, 1.4, _STEPS)
    shapes = np.empty((frames, 3, points.shape[1]))
    for t in range(frames):
        along = np.array([np.cos(direction[t]), np.sin(direction[t])])
        beside = np.array([-along[1], along[0]])
        slope = np.cumsum(0.8 * (bend[t] + 0.7 * curl[t] * arc)) * (arc[1] - arc[0])
        slope -= slope[_STEPS // 2]
        profile = np.cumsum(np.stack([np.cos(slope), np.sin(slope)]), axis=1) * (arc[1] - arc[0])
        profile -= profile[:, _STEPS // 2, None]
        bent, height = (np.interp(along @ points, arc, one) for one in profile)
        shapes[t, :2] = along[:, None] * bent + beside[:, None] * (beside @ points)
        shapes[t, 2] = height
    return shapes


def cloth(frames: int, rng: np.random.Generator) -> Array:
    """Return a square cloth with five standing waves, which also stretches a little."""
    time = np.linspace(0.0, 1.0, frames)
    x, y = points = _grid(12, 12, 1.0)
    shapes = np.zeros((frames, 3, points.shape[1]))
    shapes[:, :2] = points
    for _ in range(5):
        a, b = rng.uniform(1.0, 3.0, 2)
        p, q, r = rng.uniform(0.0, 2.0 * np.pi, 3)
        wave = np.sin(2.0 * np.pi * rng.uniform(0.5, 3.0) * time + p)[:, None, None]
        mode = [0.03 * np.sin(a * x + r), 0.03 * np.cos(b * y + p)]
        shapes += wave * np.stack([*mode, 0.18 * np.sin(a * x + q) * np.sin(b * y + r)])
    return shapes


def flag(frames: int, rng: np.random.Generator) -> Array:
    """Return a flag with waves that run away from its mast."""
    time = np.linspace(0.0, 1.0, frames)[:, None]
    x, y = points = _grid(15, 8, 0.6)
    rate, slant = rng.uniform(2.0, 5.0), rng.uniform(-0.5, 0.5)
    run = 2.0 * np.pi * rate * time - 3.0 * (x + 1.0) + slant * y
    shapes = np.zeros((frames, 3, points.shape[1]))
    shapes[:, :2] = points
    shapes[:, 1] += 0.06 * (x + 1.0) * np.cos(0.7 * run)
    shapes[:, 2] = 0.15 * (x + 1.0) * np.sin(run)
    return shapes


def torn(frames: int, rng: np.random.Generator) -> Array:
    """Return a sheet that is torn in two halves, of which one turns away."""
    time = np.linspace(0.0, 1.0, frames)
    x, y = points = _grid(12, 8, 0.7)
    axis = rng.standard_normal(3)
    angle = np.clip(2.0 * time - 0.6, 0.0, 1.0)
    turned = exp(angle[:, None] * axis / np.linalg.norm(axis))
    shapes = np.empty((frames, 3, points.shape[1]))
    shapes[:, :2] = points
    shapes[:, 2] = 0.1 * np.sin(2.0 * x) + 0.15 * np.sin(2.0 * np.pi * time[:, None] + 2.0 * y)
    left = x < 0.0
    shapes[:, :, left] = turned @ shapes[:, :, left]
    shapes[:, 0, left] -= 0.4 * angle[:, None]
    return shapes


SHEETS: Final[Mapping[str, Callable[[int, np.random.Generator], Array]]] = {
    "paper": paper,
    "cloth": cloth,
    "flag": flag,
    "torn": torn,
}
"""Shapes (T, 3, N) by the number of frames and a random generator."""


def sheet_tracks(
    name: str, path: str, *, noise: float = 0.0, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Make the tracks of a sheet.

    Parameters
    ----------
    name : str
        Of `SHEETS`.
    path : str
        Of `smsr.benchmark.camera_paths.PATHS`.
    noise : float
        Standard deviation, as a part of the largest coordinate.
    seed : int
        Chooses the number of frames, 60 to 199, and everything else.

    Returns
    -------
    W : ndarray of shape (2T, N)
    rotations : ndarray of shape (T, 3, 3)
        True cameras.
    shapes : ndarray of shape (T, 3, N)
        True shapes, centred.
    """
    rng = np.random.default_rng([seed, *name.encode(), *path.encode()])
    frames = int(rng.integers(60, 200))
    shapes = SHEETS[name](frames, rng)
    facing = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    shapes = facing @ (shapes - shapes.mean(axis=2, keepdims=True))
    rotations = PATHS[path](np.arange(frames, dtype=np.float64), rng)
    return noisy_tracks(rotations, shapes, noise, rng), rotations, shapes
