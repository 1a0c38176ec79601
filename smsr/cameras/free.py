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
from smsr.cameras.relaxed import relaxed_cameras
from smsr.progress import ignore, part_of
from smsr.shapes import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.progress import StageHook

RELAXATIONS = ((10, 1e-3), (3, 1e-3), (2, 1e-3), (10, 4e-3), (10, 1.6e-2))
"""Basis size and trace weight of the relaxations that are tried; mostly the first is right."""

_CLEAN_WEIGHT = 2.5e-4  # of the first relaxation
_NOISY = 0.02  # noise, as a part of the tracks' spread, from which on its weight is the full one

_LIGHTER = (0.3, 0.1, 0.03)
"""Parts of the first weight that are tried as well, for as long as the shapes get simpler: a heavy
trace makes cameras that turn little stand still, a light one fits noise."""

_NOISIEST = 0.1
"""Noise, as a part of the tracks' spread, from which on simple shapes tell nothing of the trace."""

_CERTAIN = 0.3
"""Complexity below which the first relaxation is right and no other is tried."""

_CLEARLY_LOWER = 0.93
"""Part of the first complexity that another relaxation has to stay below to be taken."""

_CREDIBLE = 0.75
"""Complexity above which another relaxation is taken only if the first one failed grossly (1)."""

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
    max_iterations, tolerance, hook
        As for `smsr.cameras.relaxed.relaxed_cameras`.

    Returns
    -------
    CameraEstimate
        Its criteria are ``complexity``, see there, and ``disagreement``, the largest root mean
        square angle in degrees to the cameras of a relaxation that is nearly as good.
    """
    most = max(1, len(values) // 3)
    share = min(noise / _NOISY, 1.0) ** 2
    first = (RELAXATIONS[0][0], max(_CLEAN_WEIGHT, RELAXATIONS[0][1] * share))
    tried = (first, *((first[0], part * first[1]) for part in _LIGHTER), *RELAXATIONS[1:])
    settings = list(dict.fromkeys((min(K, most), weight) for K, weight in tried))
    if basis_size is not None:
        settings = [(basis_size, RELAXATIONS[0][1])]
    largest = usable_rank(values, 3 * max(K for K, _ in settings))
    form = orthonormality_form(scaled_motion(left, values, largest), unit_scale=True)

    def relax(index: int) -> _Relaxation:
        K, weight = settings[index]
        estimate = relaxed_cameras(
            left,
            values,
            basis_size=K,
            trace_weight=weight,
            form=form,
            max_iterations=max_iterations,
            tolerance=tolerance,
            hook=part_of(hook, index / len(settings), (index + 1) / len(settings)),
        )
        reason = f"relaxation with K = {K} and trace weight {weight:g}: {estimate.reason}"
        return _Relaxation(
            dataclasses.replace(estimate, reason=reason),
            complexity(left * values, estimate.rotations),
        )

    plain = best = relax(0)
    found = [plain]
    lighter, others = range(1, 1 + len(_LIGHTER)), range(1 + len(_LIGHTER), len(settings))
    if basis_size is None and noise < _NOISIEST:
        for index in lighter:
            found.append(relax(index))
            if found[-1].complexity >= best.complexity:
                break
            best = found[-1]
    if basis_size is None and best.complexity >= _CERTAIN:
        for index in others:
            other = relax(index)
            found.append(other)
            if _is_clearly_simpler(other, plain) and other.complexity < best.complexity:
                best = other
            if index == others[0] and _agree(plain, other):
                break
    angles = [
        angle_between(best.estimate.rotations, other.estimate.rotations)
        for other in found
        if other.complexity <= _AS_GOOD * best.complexity
    ]
    return dataclasses.replace(
        best.estimate,
        criteria={"complexity": best.complexity, "disagreement": math.degrees(max(angles))},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Relaxation:
    """Cameras, and the complexity of the shapes they give."""

    estimate: CameraEstimate
    complexity: float


def _agree(first: _Relaxation, second: _Relaxation) -> bool:
    """Tell whether two relaxations of unlike K give much the same credible cameras.

    They fail grossly in different ways, so then neither has failed.
    """
    if first.complexity >= _CREDIBLE or second.complexity < _CLEARLY_LOWER * first.complexity:
        return False
    return angle_between(first.estimate.rotations, second.estimate.rotations) < _AGREEMENT


def _is_clearly_simpler(other: _Relaxation, first: _Relaxation) -> bool:
    """Tell whether a relaxation gives so much simpler shapes than the first that that failed."""
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
    step = math.ceil(len(rotations) / _FRAMES)
    problem = DepthProblem(
        every_frame(measurements, step)[:, :_DIRECTIONS], np.ascontiguousarray(rotations[::step])
    )
    problem.minimise(60, 3e-4)
    return problem.complexity()


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
