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
from smsr.cameras.estimate import STILL, scaled_motion, usable_rank
from smsr.cameras.flat import FlatViews, flat_views, steadier
from smsr.cameras.likeliest import shaken_cameras, with_likelier_cameras
from smsr.cameras.relaxed import relaxed_cameras
from smsr.cameras.rigid import part_beyond
from smsr.cameras.simplicity import FLAT, complexity, flatness, on_some_frames
from smsr.progress import ignore, part_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.progress import StageHook

RELAXATIONS = ((10, 1e-3), (3, 1e-3), (2, 1e-3), (10, 4e-3), (10, 1.6e-2))
"""Basis size and trace weight of the relaxations that are tried; mostly the first is right, with
less weight where there is less noise, or lighter still."""

_CLEAN_WEIGHT = 2.5e-4  # of the first relaxation
_NOISY = 0.02  # noise, as a part of the tracks' spread, from which on its weight is the full one

_LIGHTER = (0.3, 0.1, 0.03)
"""Parts of the first weight that are tried as well, for as long as the shapes get simpler: a heavy
trace makes cameras that turn little stand still, and one lighter than that which holds them may
still let them turn; a light one fits noise."""

_TOO_NOISY = 0.1
"""Noise, as a part of the tracks' spread, from which on simple shapes tell nothing of the trace,
and cameras of flat shapes are better left as they are."""

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
reversals and much simpler. Much simpler, too, where the mean shape turns out not to be so flat,
unless noise is what makes it thick."""

_SIMPLE = 0.5
_HARDLY_DEFORMING = 0.03
"""Complexity, and part of the tracks that three directions leave, below which a camera that shakes
is no reason to look further: relaxed cameras of simple shapes and nearly rigid ones are right."""

_RELAXATIONS = 0.6  # part of the progress, where others may follow

_FROM_THE_FRONT = math.sin(math.radians(30.0))
"""Tilt of a plane below which the tracks hardly tell which side is up."""

_AGREEMENT = math.radians(6.0)
_AS_GOOD = 1.05  # relaxations of complexities within this factor are equally likely


def free_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    basis_size: int | None = None,
    noise: float = 0.0,
    relaxations_only: bool = False,
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
    relaxations_only : bool
        Look neither for a flat mean shape nor for a camera that shakes, as where K is known.
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
        is, instead of the second. Of a camera that shakes ``disagreement`` is the angle to where
        another start leads, if that is nearly as likely, and there are ``relaxed_complexity``,
        ``steadiness``, see `smsr.shapes.credibility.steadiness`, ``relaxed_steadiness`` and, where
        the mean shape is flat, ``frontal_views``.
    """
    most = max(1, len(values) // 3)
    heavy = min(noise / _NOISY, 1.0) ** 2
    (size, full), *rest = ((min(K, most), weight) for K, weight in RELAXATIONS)
    weights = [max(_CLEAN_WEIGHT, full * heavy)]
    if basis_size is not None:
        size, weights, rest = basis_size, [full], []
    elif noise < _TOO_NOISY:
        weights += [part * weights[0] for part in _LIGHTER]
    ladder = [(size, weight) for weight in weights]
    others = [setting for setting in dict.fromkeys(rest) if setting not in ladder]
    largest = usable_rank(values, 3 * size)
    form = orthonormality_form(scaled_motion(left, values, largest), rows="unit")
    measurements = left * values
    tried: list[_Relaxation] = []

    plain = relaxations_only or basis_size is not None
    share = 1.0 if plain else _RELAXATIONS

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
            hook=part_of(hook, share * len(tried) / count, share * (len(tried) + 1) / count),
        )
        reason = f"relaxation with K = {K} and trace weight {weight:g}: {estimate.reason}"
        estimate = dataclasses.replace(estimate, reason=reason)
        tried.append(_Relaxation(estimate, complexity(measurements, estimate.rotations)))
        return tried[-1]

    first = best = relax(*ladder[0])
    for setting in ladder[1:]:
        lighter = relax(*setting)
        if lighter.complexity < best.complexity and lighter.estimate.converged:
            best = lighter
        elif so3.spread_of_views(lighter.estimate.rotations) > STILL:
            break
    doubtful = best.complexity >= _CERTAIN
    for K, weight in others if doubtful else []:
        other = relax(K, weight)
        if _is_clearly_simpler(other, first) and other.complexity < best.complexity:
            best = other
        if (K, weight) == others[0] and size != K and _agree(first, other):
            break
    angles = [
        so3.angle_between_paths(best.estimate.rotations, other.estimate.rotations)
        for other in tried
        if doubtful and other.complexity <= _AS_GOOD * best.complexity
    ]
    disagreement = math.degrees(max(angles, default=0.0))
    criteria = {"complexity": best.complexity, "disagreement": disagreement}
    found = dataclasses.replace(best.estimate, criteria=criteria)
    if plain or best.complexity <= _NEARLY_RIGID:
        return found
    return _beyond_relaxations(found, best, left, values, noise, part_of(hook, _RELAXATIONS, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Relaxation:
    """Cameras, and the complexity of the shapes they give."""

    estimate: CameraEstimate
    complexity: float


def _beyond_relaxations(
    found: CameraEstimate,
    relaxed: _Relaxation,
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    noise: float,
    hook: StageHook,
) -> CameraEstimate:
    """Return the cameras of a flat mean shape, or that shake, where the relaxed ones failed."""
    measurements = left * values
    views = flat_views(left, values)
    shaken = _of_shaken_camera(views, relaxed, measurements, noise, part_of(hook, 0.0, 0.8))
    if shaken is not None:
        return shaken
    flat = None if views is None else _of_flat_shape(views, relaxed, measurements, noise)
    if flat is None or noise >= _TOO_NOISY:
        return flat or found
    return with_likelier_cameras(flat, measurements, part_of(hook, 0.8, 1.0))


def _of_flat_shape(
    views: FlatViews, relaxed: _Relaxation, measurements: NDArray[np.float64], noise: float
) -> CameraEstimate | None:
    """Return the cameras of a flat mean shape where the relaxations failed on one."""
    before = relaxed.complexity
    now = complexity(measurements, views.rotations)
    if now >= before or _is_the_same(views, relaxed, far_simpler=now < _FAR_SIMPLER * before):
        return None
    views = steadier(views)
    problem = on_some_frames(measurements, views.rotations)
    now, flat = problem.complexity(), flatness(problem.shapes.reshape(problem.frames, 3, -1))
    clearly = _CLEARLY_SIMPLER if flat < FLAT or noise >= _TOO_NOISY else _FAR_SIMPLER
    if now >= clearly * before or (now >= _CREDIBLE_FLAT and before <= 1.0):
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
            "frontal_views": _frontal_views(views),
        },
        reason="the mean shape is flat, and cameras that see it as a plane give shapes that are "
        f"{1.0 - now / before:.0%} simpler than those of the best {relaxed.estimate.reason}",
    )


def _of_shaken_camera(
    views: FlatViews | None,
    relaxed: _Relaxation,
    measurements: NDArray[np.float64],
    noise: float,
    hook: StageHook,
) -> CameraEstimate | None:
    """Return the likeliest cameras where the relaxed ones leave a shake of the tracks unexplained.

    From these and those of a plane, since each may be far off.
    """
    deforming = part_beyond(np.linalg.norm(measurements, axis=0))
    if relaxed.complexity < _SIMPLE or deforming < _HARDLY_DEFORMING:
        return None

    def of_plane() -> list[NDArray[np.float64]]:
        return [] if views is None else [steadier(views).rotations]

    shaken = shaken_cameras(measurements, relaxed.estimate.rotations, of_plane, noise, hook)
    if shaken is None:
        return None
    criteria = {
        "complexity": complexity(measurements, shaken.rotations),
        "relaxed_complexity": relaxed.complexity,
        "disagreement": math.degrees(shaken.disagreement),
        "steadiness": shaken.steadiness,
        "relaxed_steadiness": shaken.former_steadiness,
    }
    flat = shaken.flatness < FLAT
    if flat:
        criteria["frontal_views"] = _frontal_views(FlatViews.of(shaken.rotations, shaken.axes))
    start = "those that see the object as a plane, not from those" if shaken.start > 0 else "those"
    return dataclasses.replace(
        relaxed.estimate,
        rotations=shaken.rotations,
        model="shaken",
        flat=flat,
        criteria=criteria,
        reason="the tracks shake as those of a camera that is held in the hand, and are likeliest "
        f"for cameras reached from {start} of the best {relaxed.estimate.reason}",
    )


def _frontal_views(views: FlatViews) -> float:
    """Return after how many views from the front the plane may be reversed."""
    return float(len(views.frontal_frames(_FROM_THE_FRONT)))


def _is_the_same(views: FlatViews, relaxed: _Relaxation, *, far_simpler: bool) -> bool:
    """Tell whether views of a plane nearly agree with relaxed cameras, which then are better."""
    cameras = relaxed.estimate.rotations
    limit = _APART if relaxed.complexity >= _CERTAIN else _APART_IF_CERTAIN
    if so3.angle_between_paths(cameras, views.nearest_to(cameras).rotations) >= limit:
        return False
    return not far_simpler or so3.angle_between_paths(cameras, views.rotations) < _FAR_APART


def _agree(first: _Relaxation, second: _Relaxation) -> bool:
    """Tell whether two relaxations of unlike K give much the same credible cameras.

    They fail grossly in different ways, so then neither has failed.
    """
    if first.complexity >= _CREDIBLE or second.complexity < _CLEARLY_LOWER * first.complexity:
        return False
    return so3.angle_between_paths(first.estimate.rotations, second.estimate.rotations) < _AGREEMENT


def _is_clearly_simpler(other: _Relaxation, first: _Relaxation) -> bool:
    """Tell whether a relaxation gives so much simpler shapes that the first has failed."""
    clear = other.complexity < _CLEARLY_LOWER * first.complexity
    return clear and (other.complexity < _CREDIBLE or first.complexity > 1.0)
