"""Cameras as published: rank-3 thresholded gradient steps on the corrective matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.constraints import orthonormality_form, symmetric_matrix, symmetric_vector
from smsr.progress import ignore
from smsr.proximal import nearest_semidefinite

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


def thresholded_factor(
    motion: NDArray[np.float64], *, max_iterations: int, tolerance: float, hook: StageHook = ignore
) -> tuple[NDArray[np.float64], float, tuple[float, ...]]:
    """Minimise ``||A vec F||^2`` under rank F = 3 for one basis size.

    Gradient steps ``F - (1/L) A^T A vec F`` (paper, Eq. 10), each followed by the projection on
    semi-definite matrices of rank 3 (Eq. 11). The constraints are homogeneous, so F is scaled back
    after each step to rows of unit length on average.

    Parameters
    ----------
    motion : ndarray of shape (2T, 3K)
        M', the scaled left singular vectors.
    max_iterations : int
        Bound on the steps.
    tolerance : float
        Relative change of F at which to stop.
    hook : callable
        See `smsr.progress.StageHook`.

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
    form = orthonormality_form(motion, unit_scale=False)
    lengths = symmetric_vector(motion.T @ motion) / len(motion)
    F = np.zeros((motion.shape[1], motion.shape[1]))
    F[:3, :3] = np.eye(min(3, len(F)))
    f = symmetric_vector(F)
    f /= f @ lengths
    changes: list[float] = []
    for iteration in range(1, max_iterations + 1):
        F = nearest_semidefinite(symmetric_matrix(f - form.gradient(f) / form.lipschitz), 3)
        new = symmetric_vector(F)
        new /= new @ lengths
        changes.append(float(np.linalg.norm(new - f) / np.linalg.norm(new)))
        f = new
        hook(iteration / max_iterations, iteration, changes[-1])
        if changes[-1] < tolerance:
            break
    return symmetric_matrix(f), (form.residual(f) / (2 * frames)) ** 0.5, tuple(changes)
