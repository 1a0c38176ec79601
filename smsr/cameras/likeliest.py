"""Cameras turned, frame by frame, to where they make the tracks likeliest.

The simplest shapes do not tell of a camera that turns by some degrees only, and with a little noise
they lead it astray. If it shakes, as one that is held in the hand, the tracks tell all the same: no
object moves to and fro from frame to frame as its image does then. The Gaussian model of the
deformation (`smsr.shapes.deformation`), in which consecutive shapes are alike, puts a number on it,
and the cameras follow its gradient together with the depths. Relaxed cameras that turn slowly must
not be left to it: what the object does as slowly is then as likely the camera's. They may where
noise has put them off by more than that, and so may those of a flat mean shape, off by what the
object bends.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded

from smsr import rotations as so3
from smsr.cameras.estimate import STILL
from smsr.cameras.simplicity import DIRECTIONS, FLAT, complexity, flatness, roughly_solved
from smsr.progress import ignore, part_of
from smsr.shapes.credibility import steadiness
from smsr.shapes.deformation import (
    as_seen,
    condition,
    first_model,
    learnt,
    least_variance,
    likely_shapes,
    log_likelihood,
    turning_force,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.progress import StageHook
    from smsr.shapes.deformation import Deformation

FROM_FAR = ((0.03, 100), (0.01, 30), (0.005, 20), (0.0025, 20))
"""Floors of the model, and rounds with each, that lead from cameras which may be off by tens of
degrees: a high one lets them go far, a low one tells small errors."""

FROM_NEAR = ((0.01, 40), (0.005, 20), (0.0025, 20))
"""The same from cameras that are nearly right."""

_FRAMES_IN_ALL_ROUNDS = 1000
_FEWEST_ROUNDS = 10
_ROUNDS_WITHOUT_TURNS = 5  # until the model has left the shapes that it was learnt from first
_LONGEST_STEP = math.radians(3.0)
_LENGTHENED = 2.0  # steps from near; from far, longer ones would follow noise
_LEAST_CURVATURE = 1e-3  # of the mean one

_JUDGED_FRAMES = 400
_JUDGING_FLOOR, _JUDGING_ROUNDS, _JUDGING_TOLERANCE = 0.01, 15, 5e-4
_FAR_AROUND = math.radians(75.0)  # widest angle between views of a camera that turns slowly
_ROUGH = 0.35  # second over first differences of the tracks, squared
_SLOWLY = 0.9  # correlation of consecutive shapes
_STEADY = 0.7  # steadiness of shapes from which on their cameras need no help
_STEADIER = 0.05
_AS_LIKELY = 0.05  # log-likelihood by coordinate
_CREDIBLE, _CREDIBLE_BY_NOISE = 0.15, 1.0  # steadiness below which likelier cameras are none


def likeliest_cameras(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    stages: Sequence[tuple[float, int]],
    hook: StageHook = ignore,
    *,
    lengthened: float = 1.0,
) -> NDArray[np.float64]:
    """Turn the cameras of all frames, each by itself, to where they make the tracks likelier.

    Each stage starts from the simplest shapes. In each of its rounds, the depths given the tracks
    are found, the cameras take a Newton step up the expected log-likelihood, and the model is
    learnt anew.

    Parameters
    ----------
    measurements : ndarray of shape (2T, q)
        Virtual points, strongest first, T >= 2; the first 18 count.
    rotations : ndarray of shape (T, 3, 3)
        Cameras to start from, completed by the viewing direction.
    stages : sequence of pairs
        Floor of the model, see `smsr.shapes.deformation.likely_shapes`, and number of rounds,
        which is reduced for more than 1000 frames.
    hook : callable
        See `smsr.progress.StageHook`.
    lengthened : float
        Factor on the steps, up to 2.

    Returns
    -------
    ndarray of shape (T, 3, 3)
    """
    some = np.ascontiguousarray(measurements[:, :DIRECTIONS])
    seen = some.reshape(len(rotations), 2, -1)
    part = min(1.0, _FRAMES_IN_ALL_ROUNDS / len(rotations))
    schedule = [(floor, max(min(r, _FEWEST_ROUNDS), round(part * r))) for floor, r in stages]
    count, done = sum(rounds for _, rounds in schedule), 0
    for floor, rounds in schedule:
        problem = roughly_solved(some, np.ascontiguousarray(rotations))
        shapes = problem.shapes.reshape(len(rotations), 3, -1)
        axis, planar = as_seen(rotations, seen)
        variance = least_variance(shapes, floor)
        model = first_model(shapes, axis, variance)
        for iteration in range(1, rounds + 1):
            posterior = condition(model, planar, axis)
            longest = None
            if iteration > _ROUNDS_WITHOUT_TURNS:
                shapes = planar + axis[:, :, None] * posterior.depths[:, None]
                force = turning_force(model, planar, rotations, posterior)
                turns = lengthened * _newton_step(model, rotations, shapes, force)
                longest = float(np.linalg.norm(turns, axis=1).max())
                turns *= min(1.0, _LONGEST_STEP / max(longest, np.finfo(float).tiny))
                rotations = so3.exp(turns) @ rotations
                axis, planar = as_seen(rotations, seen)
            shapes = planar + axis[:, :, None] * posterior.depths[:, None]
            model = learnt(model, shapes, axis, posterior, variance)
            done += 1
            hook(done / count, done, longest)
    return rotations


def with_likelier_cameras(
    estimate: CameraEstimate, measurements: NDArray[np.float64], hook: StageHook = ignore
) -> CameraEstimate:
    """Return cameras that are nearly right turned to where they make the tracks likeliest.

    Parameters
    ----------
    estimate : CameraEstimate
        Its reason is extended, and its complexity replaced.
    measurements, hook
        As for `likeliest_cameras`.
    """
    rotations = likeliest_cameras(
        measurements, estimate.rotations, FROM_NEAR, hook, lengthened=_LENGTHENED
    )
    return dataclasses.replace(
        estimate,
        rotations=rotations,
        criteria=dict(estimate.criteria) | {"complexity": complexity(measurements, rotations)},
        reason=f"{estimate.reason}; turned to where they make the tracks likeliest",
    )


def _newton_step(
    deformation: Deformation,
    rotations: NDArray[np.float64],
    shapes: NDArray[np.float64],
    force: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the turns (T, 3) of the cameras that the gradient (T, 3) leads to.

    The curvature is that of the log-density of the shapes with their depths held at the mean. Free
    depths would make it less, so steps up to twice as long are safe.
    """
    frames, _, points = shapes.shape
    seen = rotations @ shapes
    moved = np.stack([-np.cross(axis, seen, axisb=1, axisc=1) for axis in np.eye(3)], axis=1)
    moved = rotations.transpose(0, 2, 1)[:, None] @ moved
    moved = moved.reshape(frames, 3, 3 * points)
    here, ahead = deformation.temporal_precision(frames)
    pull = moved @ deformation.precision
    own = here[:, None, None] * (pull @ moved.transpose(0, 2, 1))
    following = ahead * (pull[:-1] @ moved[1:].transpose(0, 2, 1))
    own += _LEAST_CURVATURE * float(np.trace(own.mean(axis=0))) * np.eye(3)
    # Lower diagonals of the block-tridiagonal matrix, as LAPACK wants them.
    bands = np.zeros((6, 3 * frames))
    for i in range(3):
        for j in range(3):
            if i >= j:
                bands[i - j, j::3] = own[:, i, j]
            bands[3 + i - j, j::3][: frames - 1] += following[:, j, i]
    turns: NDArray[np.float64] = solveh_banded(bands, force.ravel(), lower=True).reshape(frames, 3)
    return turns


@dataclass(frozen=True, slots=True, eq=False)
class ShakenCameras:
    """Cameras of which the shake of the tracks tells.

    Attributes
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Completed by the viewing direction.
    start : int
        Which of the cameras to start from led there, 0 the judged ones.
    disagreement : float
        Largest root mean square angle to where the others led, if that is nearly as likely.
    axes : ndarray of shape (3, 3)
        Principal axes of the mean shape as columns, the longest first.
    flatness : float
        Of the mean shape, see `smsr.cameras.simplicity.flatness`.
    steadiness : float
        Of their shapes, see `smsr.shapes.credibility.steadiness`,
    former_steadiness : float
        and of those of the cameras that were judged.
    """

    rotations: NDArray[np.float64]
    start: int
    disagreement: float
    axes: NDArray[np.float64]
    flatness: float
    steadiness: float
    former_steadiness: float


def shaken_cameras(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    more: Callable[[], Sequence[NDArray[np.float64]]] = tuple,
    noise: float = 0.0,
    hook: StageHook = ignore,
) -> ShakenCameras | None:
    """Return the likeliest cameras where the tracks are shaken and some cameras do not explain it.

    Parameters
    ----------
    measurements : ndarray of shape (2T, q)
        Virtual points, strongest first.
    rotations : ndarray of shape (T, 3, 3)
        Cameras to judge and to start from.
    more : callable
        Returns further cameras to start from; called only where there is a reason to start.
    noise : float
        As a part of the tracks' spread: what is left of it shakes the tracks, too.
    hook : callable
        See `smsr.progress.StageHook`.

    Returns
    -------
    ShakenCameras or None
        None where the tracks are smooth, the object is as hasty as the camera, the shapes of the
        given cameras are steady already, or the likeliest ones stand still or give no steadier
        shapes; and where the given ones go far around, unless the mean shape is flat, of which they
        are wrong.
    """
    if not _are_rough(measurements, len(rotations)):
        return None
    before = _Judged.of(measurements, rotations)
    if before.steadiness >= _STEADY or before.correlation < _SLOWLY:
        return None
    starts, found = [rotations, *more()], []
    for i, start in enumerate(starts):
        part = part_of(hook, i / len(starts), (i + 1) / len(starts))
        turned = likeliest_cameras(measurements, start, FROM_FAR, part)
        found.append((_Judged.of(measurements, turned), i, turned))
    best, which, likeliest = max(found, key=lambda one: one[0].log_likelihood)
    if so3.spread_of_views(likeliest) < STILL:
        return None
    credible = _CREDIBLE + _CREDIBLE_BY_NOISE * noise
    if best.steadiness < max(before.steadiness + _STEADIER, credible):
        return None
    flat = flatness(best.shapes)
    if flat >= FLAT and so3.spread_of_views(rotations) >= _FAR_AROUND:
        return None
    return ShakenCameras(
        rotations=likeliest,
        start=which,
        disagreement=max(
            so3.angle_between_paths(likeliest, other)
            for judged, _, other in found
            if judged.log_likelihood > best.log_likelihood - _AS_LIKELY
        ),
        axes=np.linalg.svd(best.shapes.mean(axis=0))[0],
        flatness=flat,
        steadiness=best.steadiness,
        former_steadiness=before.steadiness,
    )


def _are_rough(measurements: NDArray[np.float64], frames: int) -> bool:
    """Tell whether the tracks go to and fro from frame to frame."""
    seen = measurements.reshape(frames, -1)
    first, second = (float((np.diff(seen, n=order, axis=0) ** 2).sum()) for order in (1, 2))
    return second > _ROUGH * first


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """Simplest shapes of some cameras in a row, and what the model learnt from them says."""

    shapes: NDArray[np.float64]
    steadiness: float
    correlation: float
    log_likelihood: float

    @classmethod
    def of(cls, measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> _Judged:
        first = max(0, (len(rotations) - _JUDGED_FRAMES) // 2)
        rotations = np.ascontiguousarray(rotations[first : first + _JUDGED_FRAMES])
        seen = measurements[2 * first :][: 2 * len(rotations), :DIRECTIONS]
        problem = roughly_solved(np.ascontiguousarray(seen), rotations)
        shapes = problem.shapes.reshape(len(rotations), 3, -1)
        model = likely_shapes(
            shapes,
            rotations,
            floor=_JUDGING_FLOOR,
            max_iterations=_JUDGING_ROUNDS,
            tolerance=_JUDGING_TOLERANCE,
        ).deformation
        axis, planar = as_seen(rotations, rotations[:, :2] @ shapes)
        return cls(
            shapes,
            steadiness(shapes, rotations),
            model.correlation,
            log_likelihood(model, planar, axis),
        )
