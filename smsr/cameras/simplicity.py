"""How simple the shapes are that some cameras give."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.shapes import DepthProblem, steadiness

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FRAMES = 200
_DIRECTIONS = 18


def complexity(measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return the nuclear norm of the best shapes for some cameras over that of the tracks.

    With wrong cameras the object has another shape in every frame; with right ones a few basis
    shapes do. Slow drift of the cameras hardly shows in it.

    Parameters
    ----------
    measurements : ndarray of shape (2T, q)
        Virtual points, strongest first.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    return simplest_shapes(measurements, rotations).complexity()


def simplest_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> DepthProblem:
    """Return the problem of the best shapes, solved roughly on some frames and directions."""
    step = math.ceil(len(rotations) / _FRAMES)
    return roughly_solved(
        every_frame(measurements, step)[:, :_DIRECTIONS], np.ascontiguousarray(rotations[::step])
    )


def roughly_solved(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> DepthProblem:
    """Return the problem of the best shapes, solved as far as cameras are judged by it."""
    problem = DepthProblem(measurements, rotations)
    problem.minimise(60, 3e-4)
    return problem


def steadiness_of(problem: DepthProblem) -> float:
    """Return what the steadiness of the best shapes says for their cameras."""
    return steadiness(problem.shapes.reshape(problem.frames, 3, -1), problem.rotations)


def every_frame(measurements: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the measurements (2T', N) of every n-th frame."""
    if step == 1:
        return measurements
    points = measurements.shape[1]
    return measurements.reshape(-1, 2, points)[::step].reshape(-1, points)
