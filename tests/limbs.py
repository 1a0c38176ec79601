"""A body with limbs, for tests: not simple, but of lengths that keep."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def turning(frames: int, degrees: float) -> Array:
    """Return cameras (T, 3, 3) of so many degrees a frame."""
    angles = np.radians(degrees) * np.arange(frames)[:, None]
    return so3.exp(angles * np.array([0.1, 1.0, 0.2]))


def limbs(frames: int, count: int = 4, seed: int = 0) -> Array:
    """Return shapes (T, 3, N) of a trunk with rigid limbs that swing each in its own way."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames)
    trunk = rng.standard_normal((3, 6))
    parts = [np.broadcast_to(trunk, (frames, 3, 6))]
    for _ in range(count):
        limb = 0.7 * rng.standard_normal((3, 5))
        limb[:, 0] = 0.0
        swing = rng.uniform(0.6, 1.1) * np.sin(times / rng.uniform(4, 9) + rng.uniform(0, 6))
        turns = so3.exp(swing[:, None] * so3.exp(rng.standard_normal(3)[None])[0, 0])
        parts.append(turns @ limb + trunk[:, rng.integers(6), None])
    shapes = np.concatenate(parts, axis=2)
    centred: Array = shapes - shapes.mean(axis=2, keepdims=True)
    return centred
