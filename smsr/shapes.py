"""Shapes of all frames from the measurements and the cameras: nuclear-norm minimisation.

    min ||P S#||_*    subject to    W = R S                                (paper, Sec. 3.3)

S# (T x 3N) holds the coordinates of frame t in row t and P takes off the mean shape. With known
cameras only the depths along the viewing directions are unknown: ``S_t = R_t^T W_t + n_t d_t``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from smsr.progress import ignore
from smsr.proximal import singular_value_threshold, singular_values

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


@dataclass(frozen=True, slots=True, eq=False)
class ShapeEstimate:
    """Shapes of all frames.

    Attributes
    ----------
    shapes : ndarray of shape (T, 3, N)
        S, with ``R_t S_t = W_t`` to rounding.
    iterations : int
        Of the solver, all rounds together.
    converged : bool
        Whether the last round met its tolerance.
    reason : str
        Why it stopped, for a person.
    residuals : tuple of float
        Stopping residual at each iteration.
    """

    shapes: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...] = ()


def planar_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shapes (T, 3, N) of zero depth, R^+ W.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    frames = len(rotations)
    planar: NDArray[np.float64] = rotations[:, :2].transpose(0, 2, 1) @ measurements.reshape(
        frames, 2, -1
    )
    return planar


class DepthProblem:
    """The augmented-Lagrangian solver for the depths, kept between rounds of reweighting.

    Minimises ``sum_i w_i sigma_i(P S#) + lambda/2 ||D S#||_F^2`` subject to W = R S, where D takes
    differences of consecutive frames. The splitting S = Z gives the steps

        Z <- shrink(P(S + Y), w / mu) + mean(S + Y)
        S <- the S with W = R S nearest to Z - Y (with lambda, the one of least motion near it)
        Y <- Y + S - Z

    with over-relaxation, and with mu doubled or halved where one of the two residuals has run
    ahead of the other (residual balancing), so that the result does not depend on the units.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """

    RELAXATION = 1.6
    BALANCE_EVERY = 10
    BALANCE_RATIO = 5.0

    def __init__(self, measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> None:
        self.frames = len(rotations)
        self.axis = np.ascontiguousarray(rotations[:, 2])
        self.planar = planar_shapes(measurements, rotations)
        self.shapes = self.planar.reshape(self.frames, -1)
        self.dual = np.zeros_like(self.shapes)
        self.weights: NDArray[np.float64] | float = 1.0
        self.motion_weight = 0.0
        self.penalty = 0.0
        self.residuals: list[float] = []
        # Tridiagonal D^T D seen by the depths, and its action on the planar part.
        self._diagonal = np.full(self.frames, 2.0)
        self._diagonal[[0, -1]] = 1.0
        self._off_diagonal = -np.einsum("tj,tj->t", self.axis[:-1], self.axis[1:])
        self._planar_motion = self._along_axis(self._second_difference(self.planar))

    def _second_difference(self, S: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return D^T D S."""
        differences = np.zeros((self.frames + 1, *S.shape[1:]))
        differences[1:-1] = S[1:] - S[:-1]
        result: NDArray[np.float64] = differences[:-1] - differences[1:]
        return result

    def _along_axis(self, S: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depths (T, N) of shapes (T, 3, N)."""
        depths: NDArray[np.float64] = np.matmul(self.axis[:, None, :], S)[:, 0]
        return depths

    def _with_depths(self, depths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shapes (T, 3N) with W = R S and the given depths (T, N)."""
        shapes = self.planar + self.axis[:, :, None] * depths[:, None, :]
        return shapes.reshape(self.frames, -1)

    def _banded_factor(self, penalty: float, motion_weight: float) -> NDArray[np.float64]:
        """Factor ``penalty I + motion_weight n^T D^T D n`` (tridiagonal)."""
        banded = np.zeros((2, self.frames))
        banded[1] = penalty + motion_weight * self._diagonal
        banded[0, 1:] = motion_weight * self._off_diagonal
        return cholesky_banded(banded, check_finite=False)

    def start_from_least_motion(self) -> None:
        """Set the depths that move the shape least from frame to frame."""
        factor = self._banded_factor(1e-6, 1.0)
        depths = cho_solve_banded((factor, False), -self._planar_motion, check_finite=False)
        self.shapes = self._with_depths(depths)
        self.dual[:] = 0.0

    def spectrum(self) -> NDArray[np.float64]:
        """Return the singular values of P S#, largest first."""
        return singular_values(self.shapes - self.shapes.mean(axis=0))

    def motion(self) -> float:
        """Return ||D S#||_F^2."""
        return float((np.diff(self.shapes, axis=0) ** 2).sum())

    def minimise(self, max_iterations: int, tolerance: float, hook: StageHook) -> bool:
        """Iterate from the present state; return whether both residuals met the tolerance."""
        if self.penalty == 0.0:
            self.penalty = 10.0 / max(float(self.spectrum()[0]), 1e-300)
        S, Y = self.shapes, self.dual
        Z = S
        factor = self._banded_factor(self.penalty, self.motion_weight)
        for iteration in range(1, max_iterations + 1):
            relaxed = self.RELAXATION * S + (1.0 - self.RELAXATION) * Z if iteration > 1 else S
            X = relaxed + Y
            mean = X.mean(axis=0)
            Z, _ = singular_value_threshold(X - mean, self.weights / self.penalty)
            Z += mean
            Y = X - Z
            target = self._along_axis((Z - Y).reshape(self.frames, 3, -1))
            if self.motion_weight > 0.0:
                right = self.penalty * target - self.motion_weight * self._planar_motion
                target = cho_solve_banded((factor, False), right, check_finite=False)
            previous, S = S, self._with_depths(target)
            size = max(float(np.linalg.norm(S)), 1e-300)
            primal = float(np.linalg.norm(S - Z)) / size
            dual = float(np.linalg.norm(S - previous)) / size
            self.residuals.append(max(primal, dual))
            hook(iteration / max_iterations, len(self.residuals), self.residuals[-1])
            if self.residuals[-1] < tolerance:
                break
            if iteration % self.BALANCE_EVERY == 0 and not (
                1.0 / self.BALANCE_RATIO <= primal / max(dual, 1e-300) <= self.BALANCE_RATIO
            ):
                change = 2.0 if primal > dual else 0.5
                self.penalty *= change
                Y = Y / change
                factor = self._banded_factor(self.penalty, self.motion_weight)
        self.shapes, self.dual = S, Y
        return self.residuals[-1] < tolerance


def low_rank_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    max_iterations: int = 1000,
    tolerance: float = 1e-5,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Minimise the nuclear norm of P S# subject to W = R S, to convergence.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    max_iterations : int
        Of the augmented-Lagrangian method.
    tolerance : float
        Bound on both residuals relative to ||S||.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    problem = DepthProblem(measurements, rotations)
    problem.start_from_least_motion()
    converged = problem.minimise(max_iterations, tolerance, hook)
    return _estimate(problem, converged)


def _estimate(problem: DepthProblem, converged: bool) -> ShapeEstimate:
    """Freeze what a solver has reached."""
    count = len(problem.residuals)
    return ShapeEstimate(
        shapes=problem.shapes.reshape(problem.frames, 3, -1),
        iterations=count,
        converged=converged,
        reason=f"residual {problem.residuals[-1]:.1e} after {count} iterations",
        residuals=tuple(problem.residuals),
    )
