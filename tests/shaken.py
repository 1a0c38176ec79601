"""A slowly changing shape seen by a camera held in the hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr.benchmark.camera_paths import handheld

if TYPE_CHECKING:
    from numpy.typing import NDArray


def shaken(
    frames: int = 120, points: int = 40, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return W (2T, N), the cameras (T, 3, 3) and the shapes (T, 3, N)."""
    rng = np.random.default_rng(seed)
    rotations = handheld(np.arange(frames, dtype=np.float64), rng)
    time = np.arange(frames) / frames
    weights = np.stack([np.ones(frames), 0.2 * np.cos(6.3 * time), 0.15 * np.sin(9.4 * time)])
    shapes = np.tensordot(weights, rng.standard_normal((3, 3, points)), axes=(0, 0))
    shapes -= shapes.mean(axis=2, keepdims=True)
    return (rotations[:, :2] @ shapes).reshape(2 * frames, points), rotations, shapes
