from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smsr import rotations as so3
from smsr.trajectories import (
    Linearisation,
    from_cosines,
    motion_matrix,
    smooth_trajectories,
    to_cosines,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def problem(
    frames: int = 24, points: int = 15, basis_size: int = 2, cosines: int = 6, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Return W of a smooth low-rank shape, its rotations and X."""
    rng = np.random.default_rng(seed)
    rotations = so3.exp(np.cumsum(0.1 * rng.standard_normal((frames, 3)), axis=0))
    X = np.eye(cosines, basis_size) + 0.2 * rng.standard_normal((cosines, basis_size))
    B = rng.standard_normal((3 * basis_size, points))
    M = motion_matrix(rotations[:, :2], from_cosines(X, frames))
    return M @ B, rotations, X


def test_cosines_are_orthonormal_and_the_first_is_constant() -> None:
    omega = from_cosines(np.eye(7), 20)
    np.testing.assert_allclose(omega.T @ omega, np.eye(7), atol=1e-14)
    np.testing.assert_allclose(omega[:, 0], 20**-0.5)
    time = (np.arange(20) + 0.5) / 20
    np.testing.assert_allclose(omega[:, 3], np.sqrt(2 / 20) * np.cos(3 * np.pi * time), atol=1e-14)
    C = np.random.default_rng(0).standard_normal((20, 4))
    np.testing.assert_allclose(to_cosines(C, 7), omega.T @ C, atol=1e-14)


def test_motion_matrix_is_cameras_times_weighted_shapes() -> None:
    rng = np.random.default_rng(0)
    R = Rotation.random(5, random_state=0).as_matrix()[:, :2]
    C, B = rng.standard_normal((5, 3)), rng.standard_normal((3, 3, 8))
    W = motion_matrix(R, C) @ B.reshape(9, 8)
    np.testing.assert_allclose(W.reshape(5, 2, 8), R @ np.tensordot(C, B, axes=1), atol=1e-13)


def test_linearised_residual_agrees_with_finite_differences() -> None:
    W, rotations, X = problem()
    rng = np.random.default_rng(5)
    X = X + 0.1 * rng.standard_normal(X.shape)
    now = Linearisation(W, rotations[:, :2], X)
    for _ in range(3):
        dX = rng.standard_normal(X.shape)
        h = 1e-6
        ahead = Linearisation(W, rotations[:, :2], X + h * dX).residual
        behind = Linearisation(W, rotations[:, :2], X - h * dX).residual
        derivative = (ahead - behind) / (2 * h)
        # Kaufman's form leaves out what lies within the span of M.
        outside = derivative - now.basis @ (now.basis.T @ derivative)
        np.testing.assert_allclose(now.forward(dX), -outside, atol=1e-7)


def test_gradient_is_exact() -> None:
    W, rotations, X = problem()
    rng = np.random.default_rng(6)
    X = X + 0.1 * rng.standard_normal(X.shape)

    def cost(X: Array) -> float:
        residual = Linearisation(W, rotations[:, :2], X).residual
        return 0.5 * float((residual**2).sum())

    now = Linearisation(W, rotations[:, :2], X)
    gradient = -now.adjoint(now.residual)
    for index in np.ndindex(X.shape):
        step = np.zeros_like(X)
        step[index] = 1e-6
        slope = (cost(X + step) - cost(X - step)) / 2e-6
        assert gradient[index] == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_forward_and_adjoint_belong_together() -> None:
    W, rotations, X = problem()
    now = Linearisation(W, rotations[:, :2], X + 0.1)
    rng = np.random.default_rng(7)
    dX, E = rng.standard_normal(X.shape), rng.standard_normal(W.shape)
    E = E - now.basis @ (now.basis.T @ E)
    assert (now.forward(dX) * E).sum() == pytest.approx((dX * now.adjoint(E)).sum())


def test_smooth_motion_is_found_exactly() -> None:
    W, rotations, _ = problem()
    motion = smooth_trajectories(
        W, rotations, basis_size=2, cosines=6, max_iterations=200, tolerance=1e-12
    )
    assert motion.converged
    assert motion.residuals[-1] < 1e-6
    np.testing.assert_allclose(motion.apply(W), W, atol=1e-5)


def test_smoothing_is_an_orthogonal_projection_and_takes_noise_away() -> None:
    W, rotations, _ = problem(frames=60, cosines=8)
    rng = np.random.default_rng(1)
    noisy = W + 0.05 * np.abs(W).max() * rng.standard_normal(W.shape)
    motion = smooth_trajectories(noisy, rotations, basis_size=2, cosines=8)
    smooth = motion.apply(noisy)
    np.testing.assert_allclose(motion.apply(smooth), smooth, atol=1e-12)
    np.testing.assert_allclose(motion.basis.T @ (noisy - smooth), 0.0, atol=1e-12)
    assert np.linalg.norm(smooth - W) < 0.5 * np.linalg.norm(noisy - W)


def test_residuals_never_rise() -> None:
    W, rotations, _ = problem(seed=3)
    rng = np.random.default_rng(2)
    W = W + 0.1 * rng.standard_normal(W.shape)
    motion = smooth_trajectories(W, rotations, basis_size=3, cosines=6)
    assert (np.diff(motion.residuals) <= 0.0).all()
    assert motion.iterations == len(motion.residuals) - 1


def test_still_cameras_and_zero_residual_do_not_break_it() -> None:
    W, _, _ = problem(points=4)
    still = np.broadcast_to(np.eye(3), (24, 3, 3))
    motion = smooth_trajectories(W, still, basis_size=3, cosines=24)
    assert np.isfinite(motion.basis).all()
    assert np.isfinite(motion.apply(W)).all()
