"""Smoothing of the measurements by a low-rank shape model with smooth coefficients.

With known cameras the low-rank model reads W = M B, M = R (C kron I_3), and the coefficients of
each basis shape vary smoothly in time: C = Omega_d X, the first d cosines. Fitting X and replacing
W by its projection ``W* = M M^+ W`` removes what no smooth motion of the object explains
(paper, Sec. 3.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import dct, idct

from smsr.progress import ignore

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


@dataclass(frozen=True, slots=True, eq=False)
class SmoothMotion:
    """The space of measurements that a smooth motion of the object can give.

    Attributes
    ----------
    basis : ndarray of shape (2T, m), m <= 3K
        H, orthonormal columns that span M; the smoothed measurements are ``H H^T W``.
    coefficients : ndarray of shape (d, K)
        X.
    iterations : int
        Gauss-Newton steps.
    converged : bool
        Whether the last step no longer changed the residual by much.
    reason : str
        Why it stopped, for a person.
    residuals : tuple of float
        ``||W - W*|| / ||W||`` at each iteration.
    """

    basis: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...]

    def apply(self, measurements: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``W* = H H^T W`` (2T, N)."""
        smoothed: NDArray[np.float64] = self.basis @ (self.basis.T @ measurements)
        return smoothed


def from_cosines(X: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Return Omega_d X (T, K), trajectories from the first coefficients (d, K) of their cosines."""
    trajectories: NDArray[np.float64] = idct(X, n=frames, axis=0, norm="ortho")
    return trajectories


def to_cosines(trajectories: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return Omega_d^T C (d, K), the first coefficients of the cosines of trajectories (T, K)."""
    coefficients: NDArray[np.float64] = dct(trajectories, axis=0, norm="ortho")[:count]
    return coefficients


def motion_matrix(
    cameras: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return M = R (C kron I_3) (2T, 3K) of cameras (T, 2, 3) and coefficients C (T, K)."""
    product = weights[:, None, :, None] * cameras[:, :, None, :]
    return product.reshape(2 * len(cameras), -1)


class Linearisation:
    """The fit at one X: its residual and the directions in which it changes.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W.
    cameras : ndarray of shape (T, 2, 3)
        R.
    X : ndarray of shape (d, K)
        Coefficients.

    Notes
    -----
    By variable projection the residual is ``E = (I - M M^+) W``. Its derivative along dX is
    ``-(I - M M^+) dM B`` with B = M^+ W, up to a term within the span of M, which is orthogonal to
    E: the gradient is exact and the Hessian that of Gauss-Newton in Kaufman's form
    (BIT Numerical Mathematics 15, 1975).
    """

    def __init__(
        self,
        measurements: NDArray[np.float64],
        cameras: NDArray[np.float64],
        X: NDArray[np.float64],
    ) -> None:
        frames = len(cameras)
        left, values, right = np.linalg.svd(
            motion_matrix(cameras, from_cosines(X, frames)), full_matrices=False
        )
        self._cosines = len(X)
        rank = int((values > 1e-10 * values[0]).sum())
        self.basis = left[:, :rank]
        inside = self.basis.T @ measurements
        self.residual = measurements - self.basis @ inside
        shapes = right[:rank].T @ (inside / values[:rank, None])  # B
        # What frame t would measure of each basis shape: (T, K, 2N).
        seen = cameras[:, None] @ shapes.reshape(1, X.shape[1], 3, -1)
        self._seen = seen.reshape(frames, X.shape[1], -1)

    def forward(self, dX: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change (2T, N) of the modelled measurements along dX, outside their span."""
        change = (from_cosines(dX, len(self._seen))[:, None, :] @ self._seen).reshape(
            self.residual.shape
        )
        outside: NDArray[np.float64] = change - self.basis @ (self.basis.T @ change)
        return outside

    def adjoint(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the adjoint (d, K) of `forward` for a residual that is outside the span."""
        each = self._seen @ residual.reshape(len(self._seen), -1, 1)
        return to_cosines(each[:, :, 0], self._cosines)


_INNER_STEPS = 40
_INNER_TOLERANCE = 0.05


def smooth_trajectories(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    basis_size: int,
    cosines: int,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
    hook: StageHook = ignore,
) -> SmoothMotion:
    """Fit a smooth low-rank motion to the measurements.

    Minimises ``||W - M(X) M(X)^+ W||_F^2`` over X by damped Gauss-Newton steps, each solved
    roughly by conjugate gradients, from X = [I_K; 0].

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    basis_size : int
        K.
    cosines : int
        d, at least K and at most T.
    max_iterations : int
        Most Gauss-Newton steps.
    tolerance : float
        Relative decrease of the squared residual at which it stops.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    cameras = rotations[:, :2]
    X = np.eye(cosines, basis_size)
    size = max(float(np.linalg.norm(measurements)), np.finfo(float).tiny)
    now = Linearisation(measurements, cameras, X)
    cost = float(np.linalg.norm(now.residual)) / size
    residuals = [cost]
    damping, converged = 1e-3, cost < 1e-12
    for iteration in range(1, max_iterations + 1):
        if converged:
            break
        step = _damped_step(now, damping)
        trial = Linearisation(measurements, cameras, X + step)
        trial_cost = float(np.linalg.norm(trial.residual)) / size
        if trial_cost < cost:
            converged = cost**2 - trial_cost**2 < tolerance * cost**2
            X, now, cost = X + step, trial, trial_cost
            damping /= 5.0
        else:
            damping *= 10.0
            converged = damping > 1e6
        residuals.append(cost)
        hook(iteration / max_iterations, iteration, cost)
    return SmoothMotion(
        basis=now.basis,
        coefficients=X,
        iterations=len(residuals) - 1,
        converged=converged,
        reason=f"{cost:.1e} of the measurements is no smooth motion of {basis_size} basis shapes",
        residuals=tuple(residuals),
    )


def _damped_step(fit: Linearisation, damping: float) -> NDArray[np.float64]:
    """Solve ``(J^T J + damping D) dX = J^T E`` by conjugate gradients, D the mean of J^T J."""
    gradient = fit.adjoint(fit.residual)
    scale = float((fit.forward(gradient) ** 2).sum()) / max(
        float((gradient**2).sum()), np.finfo(float).tiny
    )
    x = np.zeros_like(gradient)
    r = gradient
    p = r
    rr = first = float((r * r).sum())
    for _ in range(_INNER_STEPS):
        if rr <= _INNER_TOLERANCE**2 * first:
            break
        Ap = fit.adjoint(fit.forward(p)) + damping * scale * p
        a = rr / float((p * Ap).sum())
        x = x + a * p
        r = r - a * Ap
        rr, before = float((r * r).sum()), rr
        p = r + (rr / before) * p
    return x
