"""Cameras from the trace-norm relaxation of the corrective-matrix problem."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from smsr.cameras.constraints import orthonormality_form, symmetric_matrix, symmetric_vector
from smsr.cameras.estimate import CameraEstimate, cameras_from_factor, scaled_motion, usable_rank
from smsr.progress import ignore
from smsr.proximal import eigenvalue_threshold

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.constraints import OrthonormalityForm
    from smsr.progress import StageHook

_RELAXATION = 1.6
_LIGHT = 5e-4  # weight of the trace below which the penalty is its geometric mean with this
_BALANCE_EVERY = 25
_BALANCE = 2.0  # change of the penalty, the root of the ratio of the residuals, that is worth it
_MOST_CHANGE = 5.0


def relaxed_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    basis_size: int = 10,
    trace_weight: float = 1e-3,
    form: OrthonormalityForm | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-6,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras by a convex problem: no start, no rank to guess, no bad minima.

    Minimises over semi-definite F (n x n, n = 3K)

        1/2 sum_t || M'_t F M'_t^T - I_2 ||_F^2 + trace_weight T tr(F)

    by the alternating direction method, then takes the three leading eigenvectors of F. The trace,
    which on the cone is the nuclear norm, replaces the constraint rank F = 3 (paper, Eq. 9).

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
    form : OrthonormalityForm, optional
        The constraints at this basis size or a larger one, where they are known.
    max_iterations : int
        Of the alternating direction method.
    tolerance : float
        Bound on both residuals, relative to ||F||, at which it stops.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    n = usable_rank(values, 3 * basis_size)
    motion = scaled_motion(left, values, n)
    F, residuals = relaxed_factor(
        motion,
        trace_weight=trace_weight,
        form=form,
        max_iterations=max_iterations,
        tolerance=tolerance,
        hook=hook,
    )
    return CameraEstimate(
        rotations=cameras_from_factor(motion, F),
        model="relaxed",
        basis_size=-(-n // 3),
        iterations=len(residuals),
        converged=residuals[-1] < tolerance,
        reason=f"residual {residuals[-1]:.1e} after {len(residuals)} iterations",
        residuals=residuals,
    )


def relaxed_factor(
    motion: NDArray[np.float64],
    *,
    trace_weight: float = 1e-3,
    form: OrthonormalityForm | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-6,
    hook: StageHook = ignore,
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Solve the convex problem of `relaxed_cameras` for F.

    The splitting F = Z gives a linear system with one and the same matrix between changes of the
    penalty and an eigenvalue thresholding. The penalty equal to the weight of the trace thresholds
    eigenvalues at 1, the size that F has for cameras of unit scale, and converges in some tens of
    iterations where accelerated gradient steps need a thousand; a light trace needs a larger one.
    Where one of the residuals runs ahead of the other all the same, it is changed (residual
    balancing).

    Parameters
    ----------
    motion : ndarray of shape (2T, n)
        M', see `smsr.cameras.estimate.scaled_motion`.
    trace_weight, form, max_iterations, tolerance, hook
        As for `relaxed_cameras`.

    Returns
    -------
    F : ndarray of shape (n, n)
        Semi-definite.
    residuals : tuple of float
        Stopping residual in each iteration.
    """
    frames, n = len(motion) // 2, motion.shape[1]
    if form is None:
        form = orthonormality_form(motion, rows="unit")
    form = form.leading(n)
    H, b = form.hessian / frames, form.linear / frames
    penalty = max(trace_weight, math.sqrt(trace_weight * _LIGHT))
    system = cho_factor(H + penalty * np.eye(len(H)), check_finite=False)
    z = symmetric_vector(np.diag((np.arange(n) < 3).astype(np.float64)))
    u = np.zeros_like(z)
    residuals: list[float] = []
    for iteration in range(1, max_iterations + 1):
        f = cho_solve(system, b + penalty * (z - u), check_finite=False)
        x = _RELAXATION * f + (1.0 - _RELAXATION) * z + u
        previous = z
        z = symmetric_vector(eigenvalue_threshold(symmetric_matrix(x), trace_weight / penalty))
        u = x - z
        size = max(float(np.linalg.norm(z)), np.finfo(float).tiny)
        primal = float(np.linalg.norm(f - z)) / size
        dual = float(np.linalg.norm(z - previous)) / size
        residuals.append(max(primal, dual))
        hook(iteration / max_iterations, iteration, residuals[-1])
        if residuals[-1] < tolerance:
            break
        if iteration % _BALANCE_EVERY == 0:
            change = math.sqrt(primal / max(dual, primal / _MOST_CHANGE**2))
            change = max(change, 1.0 / _MOST_CHANGE)
            if not 1.0 / _BALANCE < change < _BALANCE:
                penalty, u = change * penalty, u / change
                system = cho_factor(H + penalty * np.eye(len(H)), check_finite=False)
    return symmetric_matrix(z), tuple(residuals)
