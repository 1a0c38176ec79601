"""How simple the shapes are that some cameras give."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.shapes.problem import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

DIRECTIONS = 18
"""Virtual points that cameras are judged by."""

FLAT = 0.15
"""Flatness of a mean shape below which it is flat, see `flatness`."""

_FRAMES = 200


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
    return on_some_frames(measurements, rotations).complexity()


def on_some_frames(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> DepthProblem:
    """Return the problem that `complexity` is taken of, solved; parameters as there."""
    step = math.ceil(len(rotations) / _FRAMES)
    some = every_frame(measurements, step)[:, :DIRECTIONS]
    return roughly_solved(some, np.ascontiguousarray(rotations[::step]))


def flatness(shapes: NDArray[np.float64]) -> float:
    """Return the extent of the mean of shapes (T, 3, q) across, as a part of its second one."""
    extents = np.linalg.svd(shapes.mean(axis=0), compute_uv=False)
    return float(extents[2:].sum() / max(extents[1], np.finfo(float).tiny))


def roughly_solved(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> DepthProblem:
    """Return the problem of the best shapes, solved as far as cameras are judged by it."""
    problem = DepthProblem(measurements, rotations)
    problem.minimise(60, 3e-4)
    return problem


def every_frame(measurements: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the measurements (2T', N) of every n-th frame."""
    if step == 1:
        return measurements
    points = measurements.shape[1]
    return measurements.reshape(-1, 2, points)[::step].reshape(-1, points)
