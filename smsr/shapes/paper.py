"""Shapes as published: the nuclear norm with a penalty that grows (paper, Sec. 3.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr.progress import ignore
from smsr.proximal import singular_value_threshold
from smsr.shapes.estimate import ShapeEstimate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


def published_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    penalty: float = 1.0,
    penalty_growth: float = 1.02,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Minimise the nuclear norm of P S# subject to W = R S by the published schedule.

    The augmented Lagrangian ``||P S#||_* + <Y, W - R S> + mu/2 ||W - R S||_F^2`` is minimised by
    a linearised step, from the planar structure R^+ W on:

        S <- shrink(P(S + R^T (W - R S + Y / mu)), 1 / mu) + mean
        Y <- Y + mu (W - R S),   mu <- rho mu

    The penalty grows whatever the residuals do, so the result depends on the units of W and is not
    the minimum that `smsr.shapes.low_rank.low_rank_shapes` finds. What is left of W - R S goes into
    the image plane.

    Parameters
    ----------
    measurements, rotations, max_iterations, hook
        As for `smsr.shapes.low_rank.low_rank_shapes`.
    penalty : float
        Mu.
    penalty_growth : float
        Rho.
    tolerance : float
        Bound on ``||W - R S|| / ||W||``.
    """
    frames = len(rotations)
    cameras, W = rotations[:, :2], measurements.reshape(frames, 2, -1)
    back = cameras.transpose(0, 2, 1)
    S = back @ W
    Y = np.zeros_like(W)
    gap = W - cameras @ S
    size = float(np.linalg.norm(W))
    residuals: list[float] = []
    for iteration in range(1, max_iterations + 1):
        X = (S + back @ (gap + Y / penalty)).reshape(frames, -1)
        mean = X.mean(axis=0)
        low_rank, _ = singular_value_threshold(X - mean, 1.0 / penalty)
        S = (low_rank + mean).reshape(S.shape)
        gap = W - cameras @ S
        Y += penalty * gap
        penalty *= penalty_growth
        residuals.append(float(np.linalg.norm(gap)) / size)
        hook(iteration / max_iterations, iteration, residuals[-1])
        if residuals[-1] < tolerance:
            break
    return ShapeEstimate(
        shapes=S + back @ gap,
        iterations=len(residuals),
        converged=residuals[-1] < tolerance,
        reason=f"residual {residuals[-1]:.1e} after {len(residuals)} iterations",
        residuals=tuple(residuals),
    )
