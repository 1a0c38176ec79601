"""Cameras without a motion model: the relaxation that gives the simplest shapes.

One setting of the relaxed problem is right for nearly every sequence, but where it fails, it fails
grossly, and another setting does not. The nuclear norm of the shapes tells which.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.cameras.constraints import orthonormality_form
from smsr.cameras.estimate import scaled_motion, usable_rank
from smsr.cameras.flat import flat_views, steadier
from smsr.cameras.relaxed import relaxed_cameras
from smsr.cameras.rigid import part_beyond
from smsr.progress import ignore, part_of
from smsr.shapes import DepthProblem, steadiness

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.cameras.flat import FlatViews
    from smsr.progress import StageHook

RELAXATIONS = ((10, 1e-3), (3, 1e-3), (2, 1e-3), (10, 4e-3), (10, 1.6e-2))
"""Basis size and trace weight of the relaxations that are tried; mostly the first is right, with
less weight where there is less noise, or lighter still."""

_CLEAN_WEIGHT = 2.5e-4  # of the first relaxation
_NOISY = 0.02  # noise, as a part of the tracks' spread, from which on its weight is the full one

_LIGHTER = (0.3, 0.1, 0.03)
"""Parts of the first weight that are tried as well, for as long as the shapes get simpler: a heavy
trace makes cameras that turn little stand still, a light one fits noise."""

_STILL = math.radians(3.0)
"""Cameras whose viewing directions spread less than this stand still, and a trace lighter than that
which holds them may yet let them turn."""

_TOO_NOISY = 0.1
"""Noise, as a part of the tracks' spread, from which on simple shapes tell nothing of the trace."""

_CERTAIN = 0.3
"""Complexity below which the first relaxation, or a lighter one, is right and no other is tried."""

_CLEARLY_LOWER = 0.93
"""Part of the first complexity that the others, but for lighter ones, must stay below."""

_CREDIBLE = 0.75
"""Complexity above which those are taken only if the first one failed grossly (1)."""

_NEARLY_RIGID = 0.15
"""Complexity below which no flat mean shape is looked for."""

_CLEARLY_SIMPLER, _FAR_SIMPLER = 0.8, 0.6
_CREDIBLE_FLAT = 0.5
_APART, _APART_IF_CERTAIN, _FAR_APART = np.radians([15.0, 20.0, 20.0]).tolist()
"""Cameras of a flat mean shape are taken where their shapes are simple, and clearly simpler than
those of the relaxations. Where the two nearly agree, the relaxed ones are more accurate. So they
must be apart, the more so where these are certain, whatever reversals there may be; or far apart by
reversals and much simpler."""

_SIMPLE = 0.5
_HARDLY_DEFORMING = 0.03
_STEADY_SHAPES, _UNSTEADY_SHAPES = 0.95, 0.5
"""Complexity from which on, where three directions leave at least the second of the tracks, the
steadiness of the shapes counts as well: above the third with the cameras of a flat mean shape and
below the fourth with relaxed ones, those are taken."""

_FROM_THE_FRONT = math.sin(math.radians(30.0))
"""Tilt of a plane below which the tracks hardly tell which side is up."""

_AGREEMENT = math.radians(6.0)
_AS_GOOD = 1.05  # relaxations of complexities within this factor are equally likely
_FRAMES = 200
_DIRECTIONS = 18


def free_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    basis_size: int | None = None,
    noise: float = 0.0,
    may_be_flat: bool = True,
    max_iterations: int = 500,
    tolerance: float = 1e-6,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras by several relaxations and take the one of the simplest shapes.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        Singular values, largest first.
    basis_size : int, optional
        K, where it is known: then there is one relaxation only.
    noise : float
        Noise that was taken off, as a part of the tracks' spread. The trace shortens the depth
        that cameras see and lets them drift, but steadies them where the tracks are uncertain: the
        less noise, the less weight of the trace in the first relaxation.
    may_be_flat : bool
        Look for a flat mean shape, too, unless K is known.
    max_iterations, tolerance, hook
        As for `smsr.cameras.relaxed.relaxed_cameras`.

    Returns
    -------
    CameraEstimate
        Its criteria are ``complexity``, see there, and ``disagreement``, the largest root mean
        square angle in degrees to the cameras of a relaxation that is nearly as good, 0 where the
        shapes are so simple that the cameras are certain. Of a flat mean shape they are
        ``relaxed_complexity``, that of the best relaxation, ``width_is_determined``, 0 where it is
        as if the object had been seen from the front once, and ``frontal_views``, how often it
        is, instead of the second.
    """
    most = max(1, len(values) // 3)
    share = min(noise / _NOISY, 1.0) ** 2
    (size, full), *rest = ((min(K, most), weight) for K, weight in RELAXATIONS)
    weights = [max(_CLEAN_WEIGHT, full * share)]
    if basis_size is not None:
        size, weights, rest = basis_size, [full], []
    elif noise < _TOO_NOISY:
        weights += [part * weights[0] for part in _LIGHTER]
    ladder = [(size, weight) for weight in weights]
    others = [setting for setting in dict.fromkeys(rest) if setting not in ladder]
    largest = usable_rank(values, 3 * size)
    form = orthonormality_form(scaled_motion(left, values, largest), unit_scale=True)
    measurements = left * values
    found: list[_Relaxation] = []

    def relax(K: int, weight: float) -> _Relaxation:
        count = len(ladder) + len(others)
        estimate = relaxed_cameras(
            left,
            values,
            basis_size=K,
            trace_weight=weight,
            form=form,
            max_iterations=max_iterations,
            tolerance=tolerance,
            hook=part_of(hook, len(found) / count, (len(found) + 1) / count),
        )
        reason = f"relaxation with K = {K} and trace weight {weight:g}: {estimate.reason}"
        estimate = dataclasses.replace(estimate, reason=reason)
        found.append(_Relaxation(estimate, complexity(measurements, estimate.rotations)))
        return found[-1]

    first = best = relax(*ladder[0])
    for setting in ladder[1:]:
        lighter = relax(*setting)
        if lighter.complexity < best.complexity and lighter.estimate.converged:
            best = lighter
        elif so3.spread_of_views(lighter.estimate.rotations) > _STILL:
            break
    doubtful = best.complexity >= _CERTAIN
    for K, weight in others if doubtful else []:
        other = relax(K, weight)
        if _is_clearly_simpler(other, first) and other.complexity < best.complexity:
            best = other
        if (K, weight) == others[0] and size != K and _agree(first, other):
            break
    angles = [
        angle_between(best.estimate.rotations, other.estimate.rotations)
        for other in found
        if doubtful and other.complexity <= _AS_GOOD * best.complexity
    ]
    disagreement = math.degrees(max(angles, default=0.0))
    if may_be_flat and basis_size is None and best.complexity > _NEARLY_RIGID:
        flat = _of_flat_shape(best, left, values)
        if flat is not None:
            return flat
    return dataclasses.replace(
        best.estimate,
        criteria={"complexity": best.complexity, "disagreement": disagreement},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Relaxation:
    """Cameras, and the complexity of the shapes they give."""

    estimate: CameraEstimate
    complexity: float


def _of_flat_shape(
    relaxed: _Relaxation, left: NDArray[np.float64], values: NDArray[np.float64]
) -> CameraEstimate | None:
    """Return the cameras of a flat mean shape where the relaxations failed on one."""
    views = flat_views(left, values)
    if views is None:
        return None
    measurements, before = left * values, relaxed.complexity
    problem = _simplest_shapes(measurements, views.rotations)
    now = problem.complexity()
    if now >= before:
        return None
    simpler = False
    if not _is_the_same(views, relaxed, far_simpler=now < _FAR_SIMPLER * before):
        views = steadier(views)
        problem = _simplest_shapes(measurements, views.rotations)
        now = problem.complexity()
        simpler = now < _CLEARLY_SIMPLER * before and (now < _CREDIBLE_FLAT or before > 1.0)
    if simpler:
        reason = f"give shapes that are {1.0 - now / before:.0%} simpler"
    elif (
        before >= _SIMPLE
        and part_beyond(values) > _HARDLY_DEFORMING
        and _steadiness(problem) > _STEADY_SHAPES
        and _steadiness(_simplest_shapes(measurements, relaxed.estimate.rotations))
        < _UNSTEADY_SHAPES
    ):
        reason = "explain the shake of the tracks better"
    else:
        return None
    return dataclasses.replace(
        relaxed.estimate,
        rotations=views.rotations,
        model="flat",
        flat=True,
        basis_size=1,
        criteria={
            "complexity": now,
            "relaxed_complexity": before,
            "width_is_determined": float(views.determined),
            "frontal_views": float(len(views.frontal_frames(_FROM_THE_FRONT))),
        },
        reason=f"the mean shape is flat, and cameras that see it as a plane {reason} than those "
        f"of the best {relaxed.estimate.reason}",
    )


def _is_the_same(views: FlatViews, relaxed: _Relaxation, *, far_simpler: bool) -> bool:
    """Tell whether views of a plane nearly agree with relaxed cameras, which then are better."""
    cameras = relaxed.estimate.rotations
    limit = _APART if relaxed.complexity >= _CERTAIN else _APART_IF_CERTAIN
    if angle_between(cameras, views.nearest_to(cameras).rotations) >= limit:
        return False
    return not far_simpler or angle_between(cameras, views.rotations) < _FAR_APART


def _steadiness(problem: DepthProblem) -> float:
    """Return what the steadiness of the best shapes says for their cameras."""
    return steadiness(problem.shapes.reshape(problem.frames, 3, -1), problem.rotations)


def _agree(first: _Relaxation, second: _Relaxation) -> bool:
    """Tell whether two relaxations of unlike K give much the same credible cameras.

    They fail grossly in different ways, so then neither has failed.
    """
    if first.complexity >= _CREDIBLE or second.complexity < _CLEARLY_LOWER * first.complexity:
        return False
    return angle_between(first.estimate.rotations, second.estimate.rotations) < _AGREEMENT


def _is_clearly_simpler(other: _Relaxation, first: _Relaxation) -> bool:
    """Tell whether a relaxation gives so much simpler shapes that the first has failed."""
    clear = other.complexity < _CLEARLY_LOWER * first.complexity
    return clear and (other.complexity < _CREDIBLE or first.complexity > 1.0)


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
    return _simplest_shapes(measurements, rotations).complexity()


def _simplest_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> DepthProblem:
    """Return the problem of the best shapes, solved roughly on some frames and directions."""
    step = math.ceil(len(rotations) / _FRAMES)
    problem = DepthProblem(
        every_frame(measurements, step)[:, :_DIRECTIONS], np.ascontiguousarray(rotations[::step])
    )
    problem.minimise(60, 3e-4)
    return problem


def every_frame(measurements: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the measurements (2T', N) of every n-th frame."""
    if step == 1:
        return measurements
    points = measurements.shape[1]
    return measurements.reshape(-1, 2, points)[::step].reshape(-1, points)


def angle_between(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the root mean square angle of two camera paths (T, 3, 3), the object frames aligned.

    Of the two mirror images of the second path the nearer one counts.
    """
    angles = []
    for other in (second, so3.mirror(second)):
        turn = so3.mean_rotation(first.transpose(0, 2, 1) @ other)
        angles.append(float(np.sqrt((so3.angles_between(first @ turn, other) ** 2).mean())))
    return min(angles)
