"""Shapes of few basis shapes: the nuclear norm, and its reweighting with least motion."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.progress import ignore, part_of
from smsr.shapes.estimate import ShapeEstimate
from smsr.shapes.problem import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


RIGID = 1e-6
"""Part of the size of shapes below which their deformation is none."""

MOST_FLICKER = 2.0
"""Largest value of `flicker`."""

_FIRST_ITERATIONS = 30
_DEEP_FIRST_ITERATIONS = 150
_ROUNDS = 5
_SCALED_ROUNDS = 2
_ITERATIONS_PER_ROUND = 40
_LOG_OFFSETS = (0.15, 0.05)  # eps; the second where coherent cameras turn fast

_RATIO = 15.0
_BY_RATIO = 0.7
_COMMON_HASTE = 0.012  # of a smooth motion with a period of 40 frames
_BY_HASTE = 50.0
_EXCESS = 0.1
_FAST_TURN = (math.radians(1.0), math.radians(2.0))


def low_rank_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Minimise the nuclear norm of P S# subject to W = R S, to convergence.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    max_iterations : int
        Of the augmented-Lagrangian method.
    tolerance : float
        Bound on both residuals relative to ||S||.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    problem = DepthProblem(measurements, rotations)
    problem.start_from_least_motion()
    converged = problem.minimise(max_iterations, tolerance, hook)
    return _estimate(problem, converged)


def reweighted_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    motion_weight: float = 1.0,
    coherent: bool = False,
    deep: bool = False,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Minimise a reweighted nuclear norm and the motion of the shape between frames.

    Minimises ``sum_i log(sigma_i(P S#) + eps sigma_1) + lambda/2 ||D S#||_F^2`` subject to
    W = R S by a few rounds of a weighted nuclear norm, w_i = 1 / (sigma_i + eps sigma_1). The
    problem is not convex. It is entered from flat shapes through the plain nuclear norm, so that
    depth is added only where it makes the shapes simpler; but see
    `smsr.shapes.problem.DepthProblem.start_over_if_simpler`.

    Parameters
    ----------
    measurements, rotations, max_iterations, tolerance, hook
        As for `low_rank_shapes`; the iterations of all rounds together are bounded.
    motion_weight : float
        Lambda relative to ``motion_scale ||P S#||_* / ||D S#||^2``, so it does not depend on
        units, frames or points; 0 for no motion term.
    coherent : bool
        The cameras follow a simple path, and that path made the object move no more: then motion
        that flickers is taken for an error, see `flicker`, and eps is smaller where they turn fast.
    deep : bool
        Enter the problem from the shapes of least motion instead, which have all the depth that
        the minimum of the nuclear norm has.
    """
    problem = DepthProblem(measurements, rotations)
    if deep:
        problem.start_from_least_motion()
    first = min(_DEEP_FIRST_ITERATIONS if deep else _FIRST_ITERATIONS, max_iterations)
    start = part_of(hook, 0.0, 1 / (_ROUNDS + 1))
    converged = problem.minimise(first, tolerance, start)
    left = min(_DEEP_FIRST_ITERATIONS, max_iterations - len(problem.residuals))
    if not deep and left > 0 and problem.start_over_if_simpler():
        converged = problem.minimise(left, tolerance, start)
    complexity = problem.complexity()
    offset = by_turn_speed(rotations, *_LOG_OFFSETS) if coherent else _LOG_OFFSETS[0]
    by_flicker = flicker(problem) if coherent else 0.0
    scale = 0.0
    for index in range(_ROUNDS):
        spectrum, motion = problem.spectrum(), problem.motion()
        nuclear = float(spectrum.sum())
        left = max_iterations - len(problem.residuals)
        if left < 1 or nuclear <= RIGID * float(np.linalg.norm(problem.shapes)):
            break
        if index < _SCALED_ROUNDS and motion_weight > 0.0:
            scale = motion_weight * motion_scale(problem, by_flicker)
        problem.motion_weight = scale * nuclear / max(motion, 1e-12 * nuclear)
        weights = 1.0 / (spectrum + offset * spectrum[0])
        problem.weights = weights * (nuclear / float(weights @ spectrum))
        count = left if index == _ROUNDS - 1 else min(_ITERATIONS_PER_ROUND, left)
        part = part_of(hook, (index + 1) / (_ROUNDS + 1), (index + 2) / (_ROUNDS + 1))
        converged = problem.minimise(count, tolerance, part)
    return dataclasses.replace(
        _estimate(problem, converged), complexity=complexity, flicker=by_flicker
    )


def motion_scale(problem: DepthProblem, by_flicker: float = 0.0) -> float:
    """Return how strongly least motion is asked for, given the shapes found so far.

    Least motion settles what the camera's turn leaves open, and does harm where the object itself
    moves. So it is asked for in two cases: where the image moves much more than the shape, which
    then is the camera's doing; and, with coherent cameras, where the estimated motion changes its
    direction from frame to frame as the tracks do not.

    Parameters
    ----------
    problem : DepthProblem
        With the shapes.
    by_flicker : float
        Weight of the second case, see `flicker`.
    """
    motion = max(problem.motion(), np.finfo(float).tiny)
    ratio = max(problem.image_motion() / motion, np.finfo(float).tiny)
    by_ratio = _BY_RATIO * max(0.0, math.log(ratio / _RATIO))
    return max(by_ratio, by_flicker * max(0.0, math.log(ratio)))


def flicker(problem: DepthProblem) -> float:
    """Return how much of the estimated motion is flicker of the depths, as a weight from 0 to 2.

    Haste is how much of a step is undone or turned aside by the next, 0 in a steady motion. Taken
    as the median over the frames, it passes over abrupt moments, which a real object may have.
    Depths that are more hasty than the motion across the viewing direction, which the tracks bear
    out, flicker; where they are not, the object itself is hasty. All of this counts where the
    camera turns so fast that neighbouring frames see depth from different sides.

    Parameters
    ----------
    problem : DepthProblem
        With shapes found by the nuclear norm alone.
    """
    frames = problem.frames
    steps = np.diff(problem.shapes, axis=0).reshape(frames - 1, 3, -1)
    axes = problem.axis[1:] + problem.axis[:-1]
    axes = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), np.finfo(float).tiny)
    depths = np.matmul(axes[:, None], steps)
    across = _haste(steps - axes[:, :, None] * depths)
    excess = (_haste(depths) - across) / max(across, np.finfo(float).tiny)
    sure = min(max(excess / _EXCESS, 0.0), 1.0)
    slope = by_turn_speed(problem.rotations, 0.0, _BY_HASTE)
    return sure * min(MOST_FLICKER, slope * max(0.0, _haste(steps) - _COMMON_HASTE))


def _haste(steps: NDArray[np.float64]) -> float:
    """Return the haste of a motion (T - 1, ...), see `flicker`."""
    if len(steps) < 2:
        return 0.0
    steps = steps.reshape(len(steps), -1)
    squares = (steps**2).sum(axis=1)
    sizes = np.maximum(0.5 * (squares[1:] + squares[:-1]), np.finfo(float).tiny)
    return float(np.median(1.0 - (steps[1:] * steps[:-1]).sum(axis=1) / sizes))


def by_turn_speed(rotations: NDArray[np.float64], slow: float, fast: float) -> float:
    """Return a value between two, by how fast cameras (T, 3, 3) turn from frame to frame.

    A camera that turns fast, beside the object's own motion, sees depth from different sides in
    neighbouring frames, and the tracks bear out more of it.
    """
    turns = np.diff(rotations, axis=0)
    speed = math.sqrt(float((turns**2).sum(axis=(1, 2)).mean()) / 2.0)
    return float(np.interp(speed, _FAST_TURN, (slow, fast)))


def _estimate(problem: DepthProblem, converged: bool) -> ShapeEstimate:
    """Freeze what a solver has reached."""
    count = len(problem.residuals)
    return ShapeEstimate(
        shapes=problem.shapes.reshape(problem.frames, 3, -1),
        iterations=count,
        converged=converged,
        reason=f"residual {problem.residuals[-1]:.1e} after {count} iterations",
        residuals=tuple(problem.residuals),
    )
