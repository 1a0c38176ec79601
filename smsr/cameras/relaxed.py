"""Cameras from the trace-norm relaxation of the corrective-matrix problem."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.constraints import orthonormality_form, symmetric_matrix, symmetric_vector
from smsr.cameras.estimate import CameraEstimate, cameras_from_factor, scaled_motion, usable_rank
from smsr.progress import ignore
from smsr.proximal import eigenvalue_threshold

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


def relaxed_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    basis_size: int = 10,
    trace_weight: float = 1e-3,
    max_iterations: int = 600,
    tolerance: float = 1e-7,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras by a convex problem: no start, no rank to guess, no bad minima.

    Minimises over semi-definite F (n x n, n = 3K)

        1/2 sum_t || M'_t F M'_t^T - I_2 ||_F^2 + trace_weight T tr(F)

    by accelerated proximal gradient steps with adaptive restart, then takes the three leading
    eigenvectors of F. The trace, which on the cone is the nuclear norm, replaces the constraint
    rank F = 3 (paper, Eq. 9).

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        Singular values, largest first.
    basis_size : int
        Largest K; fewer are used where the measurements have rank below 3K.
    trace_weight : float
        Weight of the trace relative to the number of frames.
    max_iterations : int
        Of the proximal gradient method.
    tolerance : float
        Relative change of F at which it stops.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    frames = len(left) // 2
    n = usable_rank(values, 3 * basis_size)
    motion = scaled_motion(left, values, n)
    form = orthonormality_form(motion, unit_scale=True)
    step = 1.0 / form.lipschitz
    F = np.zeros((n, n))
    F[:3, :3] = np.eye(min(n, 3))
    f = symmetric_vector(F)
    ahead, momentum = f, 1.0
    residuals: list[float] = []
    for iteration in range(1, max_iterations + 1):
        F = symmetric_matrix(ahead - step * form.gradient(ahead))
        new = symmetric_vector(eigenvalue_threshold(F, trace_weight * frames * step))
        moved = new - f
        if (ahead - new) @ moved > 0.0:  # the momentum points uphill: restart
            momentum, ahead = 1.0, new
        else:
            grown = (1.0 + math.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
            ahead, momentum = new + (momentum - 1.0) / grown * moved, grown
        f = new
        residuals.append(float(np.linalg.norm(moved) / max(float(np.linalg.norm(f)), 1e-300)))
        hook(iteration / max_iterations, iteration, residuals[-1])
        if residuals[-1] < tolerance:
            break
    converged = residuals[-1] < tolerance
    return CameraEstimate(
        rotations=cameras_from_factor(motion, symmetric_matrix(f)),
        model="relaxed",
        basis_size=-(-n // 3),
        iterations=len(residuals),
        converged=converged,
        reason=f"relative change {residuals[-1]:.1e} after {len(residuals)} iterations",
        residuals=tuple(residuals),
    )
