"""Cameras of an object that does not deform: the metric upgrade of the rank-3 factorisation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.constraints import frame_products, symmetric_matrix
from smsr.cameras.estimate import CameraEstimate, cameras_from_factor, scaled_motion

if TYPE_CHECKING:
    from numpy.typing import NDArray

RIGID_REST = 0.002
"""An object is taken for rigid where three directions leave less than this part of the tracks, or
noise may have left the rest. More is deformation, however little, and seen well by the cameras and
shapes of deforming objects."""

_MISFIT, _MISFIT_BY_REST = 0.01, 3.0
"""Root mean square of what the constraints of orthonormal rows may miss by, also as a multiple of
noise or of what three directions leave: noise misses by less than once as much. A flat object that
deforms has three directions as well, but they are not those of a rigid one; nor are those of a
rigid one that comes nearer."""

_MOST_REST = 0.02  # that noise may have left
_ABOVE_NOISE = 1.2


def looks_rigid(values: NDArray[np.float64], neglected: float = 0.0) -> bool:
    """Tell whether three directions explain the tracks so well that the object may be rigid.

    Parameters
    ----------
    values : ndarray of shape (r,)
        Singular values of the centred measurements, largest first.
    neglected : float
        Standard deviation of noise that was left in, as a part of the tracks' spread.
    """
    limit = min(max(RIGID_REST, _ABOVE_NOISE * neglected), _MOST_REST)
    return part_beyond(values) < limit


def part_beyond(values: NDArray[np.float64], count: int = 3) -> float:
    """Return which part of the norm of the tracks their first singular directions leave."""
    return float(np.linalg.norm(values[count:]) / np.linalg.norm(values))


def rigid_cameras(
    left: NDArray[np.float64], values: NDArray[np.float64], noise: float = 0.0
) -> CameraEstimate | None:
    """Find the cameras of a rigid object by linear least squares (Tomasi and Kanade).

    Unlike the relaxed problem it has no weight on the trace, which shortens the depth of an object
    that turns little; it is exact for a rigid object and of no use for any other.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        Singular values, largest first.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.

    Returns
    -------
    CameraEstimate or None
        None where the measurements do not determine the upgrade, for a flat object or a camera that
        does not turn, or do not fit it.
    """
    if len(values) < 3 or len(left) < 6:
        return None
    motion = scaled_motion(left, values, 3)
    uu, vv, uv = frame_products(motion)
    constraints = np.concatenate([uu, vv, np.sqrt(2.0) * uv])
    lengths = np.repeat([1.0, 0.0], [2 * len(uu), len(uv)])
    solution, _, rank, _ = np.linalg.lstsq(constraints, lengths, rcond=1e-6)
    F = symmetric_matrix(solution)
    strengths = np.linalg.eigvalsh(F)
    if rank < 6 or strengths[0] <= 1e-6 * strengths[-1]:
        return None
    misfit = math.sqrt(((constraints @ solution - lengths) ** 2).sum() / len(uu))
    if misfit > max(_MISFIT, _MISFIT_BY_REST * max(part_beyond(values), noise)):
        return None
    return CameraEstimate(
        rotations=cameras_from_factor(motion, F),
        model="rigid",
        basis_size=1,
        iterations=0,
        converged=True,
        reason="three directions explain the tracks, so the object is taken for rigid",
    )
