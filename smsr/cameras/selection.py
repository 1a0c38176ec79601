"""Which cameras to take: free ones, unless a simpler motion explains them as well.

Free cameras drift slowly, and nothing in the low rank of the shapes tells: a turn of the object and
one of the camera look alike. Two things do. Points that rest show the frame of the world, see
`smsr.cameras.rest`; and a path of few parameters cannot drift, see `smsr.cameras.trial`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.cameras.free import free_cameras
from smsr.cameras.halves import FEWEST_POINTS, disagreement_of_halves
from smsr.cameras.likeliest import with_likelier_cameras
from smsr.cameras.paper import published_cameras
from smsr.cameras.rigid import looks_rigid, rigid_cameras
from smsr.cameras.simplicity import every_frame
from smsr.cameras.trial import Trial
from smsr.progress import ignore, part_of
from smsr.shapes.credibility import faded
from smsr.shapes.low_rank import by_turn_speed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.cameras.trial import Path, Verdict
    from smsr.cameras.turn import Turn
    from smsr.options import Options
    from smsr.progress import StageHook

COHERENT_RISE = 0.03
"""Up to this much more motion is no more, see `CameraEstimate.coherent`."""

SIMPLER = (0.8, 0.96)
"""Nuclear norms of the shapes with the free cameras over those on a path: at the first, depths that
the free cameras see are taken, at the second, those seen on the path."""

LEAST_SHARE = 0.5
"""Part of the free cameras' depths that is taken where the camera turns slowly, or on a path less
certain than a uniform one."""

SPAN_LIMIT = 0.06
"""Most of a path that may lie outside the leading left singular vectors of W, unless more of the
free cameras does."""

FEWEST_FRAMES = 12
"""Paths are fitted to at least so many frames."""

_VERY_NOISY, _SIMPLE = 0.1, 0.5
"""Noise that was taken off, as a part of the tracks' spread, from which on the likelihood errs less
than the relaxations do, where these give shapes of a complexity below the second number."""

_UNSURE, _FLAT = 0.4, 0.9
_APART = math.radians(5.0)
_MORE_COMPLEX = 0.05
"""Free cameras of a complexity above the first number may be no surer than they are far from a
uniform turn, by the third at least. Its shapes must stay below the second, and may be the more
complex, by the fourth in the logarithm, the less it is apart beside the doubt."""

_HARDLY = 2.0  # times the doubt; from farther off a refinement hardly leads below it

_FRAMES = 400
_DIRECTIONS = 24
_SPAN_DIRECTIONS = 18


def estimate_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    options: Options,
    hook: StageHook = ignore,
    *,
    points: NDArray[np.float64] | None = None,
    tracks: NDArray[np.float64] | None = None,
    noise: float = 0.0,
    neglected: float = 0.0,
) -> CameraEstimate:
    """Find the cameras of all frames in the way that the options ask for.

    Parameters
    ----------
    left : ndarray of shape (2T, q)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (q,)
        Singular values, largest first.
    options : Options
        Resolved by `smsr.options.resolve`.
    hook : callable
        See `smsr.progress.StageHook`.
    points : ndarray of shape (q, s), optional
        Some real points as combinations of the virtual ones, ``left * values``; without them
        nothing can be known to rest.
    tracks : ndarray of shape (2T, s), optional
        The same points as they were measured, with their noise.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread; 0 for
        none.
    neglected : float
        The same of noise that was left in, see `smsr.noise.VirtualPoints`.
    """
    if options.camera_model == "paper":
        return published_cameras(
            left,
            values,
            basis_size=options.basis_size,
            max_iterations=options.camera_iterations,
            hook=hook,
        )
    if options.camera_model == "auto" and looks_rigid(values, neglected):
        rigid = rigid_cameras(left, values, noise)
        if rigid is not None:
            return rigid
    free = free_cameras(
        left,
        values,
        basis_size=options.basis_size,
        noise=noise,
        relaxations_only=options.camera_model == "relaxed",
        max_iterations=options.camera_iterations,
        tolerance=options.camera_tolerance,
        hook=part_of(hook, 0.0, 0.5),
    )
    if options.camera_model == "relaxed":
        return free
    hook = part_of(hook, 0.5, 1.0)
    if options.camera_model == "uniform":
        return with_uniform_path(free, left * values, hook)
    return with_simple_path(free, left * values, hook, points=points, tracks=tracks, noise=noise)


def _trial(free: CameraEstimate, measurements: NDArray[np.float64]) -> Trial:
    """Return the free cameras on some frames and directions: paths have few parameters."""
    step = math.ceil(len(free.rotations) / _FRAMES)
    some = every_frame(measurements, step)[:, :_DIRECTIONS]
    return Trial(some, free.rotations, step, flat=free.flat)


def with_uniform_path(
    free: CameraEstimate, measurements: NDArray[np.float64], hook: StageHook = ignore
) -> CameraEstimate:
    """Return cameras on a uniform turn, without any shake, whatever it explains.

    Parameters
    ----------
    free, measurements, hook
        As for `with_simple_path`.
    """
    trial = _trial(free, measurements)
    path = trial.uniform()
    verdict = trial.measure(path)
    turn, verdict = trial.refine(path, verdict, hook)
    return _on_path_alone(free, path, turn, verdict, free.criteria)


def with_simple_path(
    free: CameraEstimate,
    measurements: NDArray[np.float64],
    hook: StageHook = ignore,
    *,
    points: NDArray[np.float64] | None = None,
    tracks: NDArray[np.float64] | None = None,
    noise: float = 0.0,
) -> CameraEstimate:
    """Return cameras on a simple path where one explains the free ones.

    A uniform turn is taken, too, where the free ones are so unsure that they do not speak against
    it.

    Otherwise those are returned, turned to the frame in which points rest, if any do. Relaxed ones
    of simple shapes are turned to where they make the tracks likeliest first, where noise is much;
    not before paths are looked for, which are recognised better without.

    Parameters
    ----------
    free : CameraEstimate
        Cameras without a motion model.
    measurements : ndarray of shape (2T, q)
        Virtual points, strongest first.
    hook : callable
        See `smsr.progress.StageHook`.
    points : ndarray of shape (q, s), optional
    tracks : ndarray of shape (2T, s), optional
        See `estimate_cameras`.
    noise : float
        See `estimate_cameras`. Weak directions of the measurements went with it, and part of what
        spans the cameras with them, so it is not asked that paths lie in the span.

    Returns
    -------
    CameraEstimate
        Its criteria hold, for each path that was judged, the numbers it was judged by:
        ``uniform_unexplained``, ``uniform_motion_rise``, ``uniform_outside_span`` and the like;
        and ``halves_disagreement``, see `smsr.cameras.halves`, in degrees, where it was asked.
    """
    if len(free.rotations) < FEWEST_FRAMES:
        return free
    trial = _trial(free, measurements)
    still = free if points is None else _at_rest(free, trial, points)
    criteria, reasons = dict(still.criteria), []
    paths = trial.paths()
    if not paths:
        reasons.append("the cameras keep to no axis")
    for path in paths:
        verdict = trial.judge(path)
        criteria |= _numbers(path, verdict)
        if verdict.motion_weight is None:
            reasons.append(f"{path} {verdict.reason}")
            continue
        turn = path.turn
        if not path.is_loose:
            turn, verdict = trial.refine(path, verdict, hook)
        outside = part_outside_span(measurements, turn.rotations)
        criteria[f"{path.name}_outside_span"] = outside
        limit = max(SPAN_LIMIT, part_outside_span(measurements, free.rotations))
        if outside > limit and noise == 0.0 and not trial.flat:
            reasons.append(f"{path} lies outside the span of the tracks by {outside:.1%}")
            continue
        found = _on_path(free, path, turn, verdict, criteria)
        if path.model != "axis":
            return found
        return _uniform_in_doubt(free, trial, criteria, points, tracks, hook) or found
    uniform = _uniform_in_doubt(free, trial, criteria, points, tracks, hook)
    if uniform is not None:
        return uniform
    simple = free.criteria.get("complexity", 1.0) < _SIMPLE
    if noise >= _VERY_NOISY and simple and free.model == "relaxed":
        still = free = with_likelier_cameras(free, measurements, hook)
        if points is not None:
            still = _at_rest(free, _trial(free, measurements), points)
        criteria |= still.criteria
    reason = "; ".join([*reasons, still.reason])
    return dataclasses.replace(still, criteria=criteria, reason=reason)


def _uniform_in_doubt(
    free: CameraEstimate,
    trial: Trial,
    criteria: dict[str, float],
    points: NDArray[np.float64] | None,
    tracks: NDArray[np.float64] | None,
    hook: StageHook,
) -> CameraEstimate | None:
    """Return cameras on a uniform turn where free ones are no surer than they are far from it."""
    complexity = free.criteria.get("complexity", 0.0)
    if points is None or tracks is None or points.shape[1] < FEWEST_POINTS:
        return None
    # Halves have relaxed cameras, which tell nothing of how sure others are.
    if complexity < _UNSURE or free.model != "relaxed":
        return None
    doubt = disagreement_of_halves(every_frame(tracks, trial.step), points)
    criteria["halves_disagreement"] = math.degrees(doubt)
    path = trial.uniform()
    if so3.angle_between_paths(trial.rotations, path.turn.rotations) >= _HARDLY * doubt:
        return None
    turn, verdict = trial.refine(path, trial.measure(path), hook)
    apart = so3.angle_between_paths(trial.rotations, turn.rotations)
    if not _APART <= apart < doubt or complexity >= _FLAT * verdict.simplicity:
        return None
    if -math.log(verdict.simplicity) * apart >= _MORE_COMPLEX * doubt:
        return None
    verdict = dataclasses.replace(
        verdict,
        reason=f"{verdict.reason}; it is {math.degrees(apart):.0f} degrees from the free cameras, "
        f"and halves of the points disagree by {math.degrees(doubt):.0f} about these",
    )
    return _on_path_alone(free, path, turn, verdict, criteria)


def _at_rest(free: CameraEstimate, trial: Trial, points: NDArray[np.float64]) -> CameraEstimate:
    """Return free cameras, and put those on trial, turned to the frame in which points rest."""
    unrest, trust = trial.come_to_rest(points[:_DIRECTIONS])
    free = dataclasses.replace(free, criteria=dict(free.criteria) | {"unrest": unrest})
    if trust == 0.0:
        return free
    return dataclasses.replace(
        free,
        rotations=trial.rotations,
        simpler=free.rotations,
        simpler_share=1.0,
        reason=f"turned to where points rest, by {trust:.0%} of the way; {free.reason}",
    )


def _numbers(path: Path, verdict: Verdict) -> dict[str, float]:
    """Return what a path was judged by, as criteria."""
    numbers = {f"{path.name}_unexplained": verdict.unexplained}
    if verdict.motion_rise is not None:
        numbers[f"{path.name}_motion_rise"] = verdict.motion_rise
    return numbers


def _on_path(
    free: CameraEstimate,
    path: Path,
    turn: Turn,
    verdict: Verdict,
    criteria: Mapping[str, float],
) -> CameraEstimate:
    """Return the cameras of an accepted path."""
    share = faded(verdict.simplicity, SIMPLER)
    least = LEAST_SHARE
    if path.is_loose:
        least = 1.0
    elif path.is_certain:
        least = by_turn_speed(turn.rotations, LEAST_SHARE, 0.0)
    middle = turn.angles[len(turn.angles) // 2]
    adjustable = None if path.is_loose else turn.by_velocity(middle) / turn.span
    speed = math.degrees(float(np.linalg.norm(turn.velocity)))
    return dataclasses.replace(
        free,
        rotations=turn.rotations,
        model=path.model,
        criteria=criteria,
        coherent=not path.is_loose and (verdict.motion_rise or 0.0) <= COHERENT_RISE,
        simpler=free.rotations,
        simpler_share=max(share, least),
        adjustable=adjustable,
        reason=f"{path}, {speed:.2f} degrees a frame, {verdict.reason}; {free.reason}",
    )


def _on_path_alone(
    free: CameraEstimate,
    path: Path,
    turn: Turn,
    verdict: Verdict,
    criteria: Mapping[str, float],
) -> CameraEstimate:
    """Return the cameras of an accepted path, without any depths that the free ones see."""
    estimate = _on_path(free, path, turn, verdict, dict(criteria) | _numbers(path, verdict))
    return dataclasses.replace(estimate, simpler=None, simpler_share=0.0)


def part_outside_span(measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return how much of the cameras no combination of the leading directions of W explains.

    Where the deformation is a sum of basis shapes, W = R (C kron I_3) B, and the mean shape is one
    of them, the columns of R themselves lie in the column space of W. Wrong cameras do not, nor the
    third column of right ones where the mean shape is flat.

    Parameters
    ----------
    measurements : ndarray of shape (2T, q)
        Virtual points, orthogonal columns, strongest first.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    float
        ``||R - U U^T R|| / ||R||``, U the leading columns at unit length.
    """
    R = rotations[:, :2].reshape(-1, 3)
    # At most half of the dimensions: in more than that anything lies nearly.
    U = measurements[:, : min(_SPAN_DIRECTIONS, len(rotations))]
    U = U / np.linalg.norm(U, axis=0)
    return float(np.linalg.norm(R - U @ (U.T @ R)) / np.linalg.norm(R))
