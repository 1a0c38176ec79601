"""Cameras as published: rank-3 thresholded gradient steps on the corrective matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.constraints import (
    mean_square_length,
    orthonormality_form,
    symmetric_matrix,
    symmetric_vector,
)
from smsr.cameras.estimate import CameraEstimate, cameras_from_factor, scaled_motion, usable_rank
from smsr.cameras.relaxed import relaxed_factor
from smsr.progress import ignore
from smsr.proximal import nearest_semidefinite

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook

LARGEST_BASIS = 10
"""Basis sizes up to this one are tried."""

_GOOD_RESIDUAL = 0.01
_WORTHWHILE_FALL = 0.9


def published_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    basis_size: int | None = None,
    max_iterations: int = 600,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras and the basis size by rank-3 thresholding (paper, Sec. 3.1).

    Larger and larger K are tried, until the orthonormality constraints hold to 1 % or one more
    basis shape no longer lowers their violation by a tenth. Every K starts from the leading block
    of the convex relaxation's solution: the rank constraint has bad local minima.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        Singular values, largest first.
    basis_size : int, optional
        K, where it is known.
    max_iterations : int
        Most gradient steps for each K.
    tolerance : float
        Relative change of F at which the steps stop.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    n = usable_rank(values, 3 * (basis_size or LARGEST_BASIS))
    motion = scaled_motion(left, values, n)
    start, changes = relaxed_factor(motion)
    hook(0.5, len(changes), changes[-1])
    sizes = [n] if basis_size else list(range(min(3, n), n + 1, 3))
    violation, total = np.inf, 0
    found, steps = start, changes
    for index, size in enumerate(sizes, 1):
        F, residual, changes = thresholded_factor(
            motion[:, :size],
            start[:size, :size],
            max_iterations=max_iterations,
            tolerance=tolerance,
        )
        total += len(changes)
        hook(0.5 + 0.5 * index / len(sizes), total, residual)
        if residual > _WORTHWHILE_FALL * violation:
            break
        violation, found, steps = residual, F, changes
        if residual < _GOOD_RESIDUAL:
            break
    size = len(found)
    return CameraEstimate(
        rotations=cameras_from_factor(motion[:, :size], found),
        model="paper",
        basis_size=-(-size // 3),
        iterations=total,
        converged=steps[-1] < tolerance,
        reason=f"constraints violated by {violation:.2%} with {-(-size // 3)} basis shapes",
        residuals=steps,
    )


def thresholded_factor(
    motion: NDArray[np.float64],
    start: NDArray[np.float64],
    *,
    max_iterations: int,
    tolerance: float,
) -> tuple[NDArray[np.float64], float, tuple[float, ...]]:
    """Minimise ``||A vec F||^2`` under rank F = 3 for one basis size.

    Gradient steps ``F - (1/L) A^T A vec F`` (paper, Eq. 10), each followed by the projection on
    semi-definite matrices of rank 3 (Eq. 11). The constraints are homogeneous, so F is scaled back
    after each step to rows of unit length on average.

    Parameters
    ----------
    motion : ndarray of shape (2T, 3K)
        M', the scaled left singular vectors.
    start : ndarray of shape (3K, 3K)
        First F, semi-definite.
    max_iterations : int
        Bound on the steps.
    tolerance : float
        Relative change of F at which to stop.

    Returns
    -------
    F : ndarray of shape (3K, 3K)
        Semi-definite of rank at most 3.
    residual : float
        Root mean square violation of the constraints, relative to rows of unit length.
    residuals : tuple of float
        Relative change in each iteration.
    """
    frames = len(motion) // 2
    form = orthonormality_form(motion, rows="published")
    lipschitz = form.lipschitz()
    lengths = mean_square_length(motion)
    f = symmetric_vector(nearest_semidefinite(start, 3))
    f = _scaled(f, lengths)
    changes: list[float] = []
    for _ in range(max_iterations):
        F = nearest_semidefinite(symmetric_matrix(f - form.gradient(f) / lipschitz), 3)
        new = _scaled(symmetric_vector(F), lengths)
        changes.append(float(np.linalg.norm(new - f) / np.linalg.norm(new)))
        f = new
        if changes[-1] < tolerance:
            break
    return symmetric_matrix(f), (form.residual(f) / (2 * frames)) ** 0.5, tuple(changes)


def _scaled(f: NDArray[np.float64], lengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale svec(F) so that the rows of M' Q have unit length on average."""
    scaled: NDArray[np.float64] = f / max(float(f @ lengths), np.finfo(float).tiny)
    return scaled
