"""The augmented-Lagrangian solver for depths that make the shapes simple.

    min ||P S#||_*    subject to    W = R S                                (paper, Sec. 3.3)

S# (T x 3N) holds the coordinates of frame t in row t and P takes off the mean shape. With known
cameras only the depths along the viewing directions are unknown: ``S_t = R_t^T W_t + n_t d_t``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs

from smsr.errors import NumericalFailure
from smsr.progress import ignore
from smsr.proximal import singular_value_threshold, singular_values
from smsr.rotations import depths_along
from smsr.shapes.estimate import planar_shapes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


class DepthProblem:
    """The augmented-Lagrangian solver for the depths, kept between rounds of reweighting.

    Minimises ``sum_i w_i sigma_i(P S#) + lambda/2 ||D S#||_F^2`` subject to W = R S, where D takes
    differences of consecutive frames. The splitting S = Z gives the steps

        Z <- shrink(P(S + Y), w / mu) + mean(S + Y)
        S <- the S with W = R S nearest to Z - Y (with lambda, the one of least motion near it)
        Y <- Y + S - Z

    with over-relaxation where the problem is convex, and with mu doubled or halved where one of
    the two residuals has run ahead of the other (residual balancing), so that the result does not
    depend on the units.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction, T >= 2.
    """

    FIRST_PENALTY = 10.0  # relative to 1 / sigma_1(P S#)
    RELAXATION = 1.6
    BALANCE_EVERY = 10
    BALANCE_RATIO = 5.0
    STALLED = 0.9
    CLEARLY_SIMPLER = 0.65  # part of a nuclear norm
    LEAST_PENALTY = 1e-3  # relative to the first

    def __init__(self, measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> None:
        self.frames = len(rotations)
        self.measurements = measurements
        self.weights: NDArray[np.float64] | float = 1.0
        self.motion_weight = 0.0
        self.penalty = 0.0
        self.residuals: list[float] = []
        # Tridiagonal D^T D, as the depths see it once the cameras are known.
        self._diagonal = np.full(self.frames, 2.0)
        self._diagonal[[0, -1]] = 1.0
        points = measurements.shape[1]
        self._look_along(rotations, np.zeros((self.frames, points)))
        self.dual = np.zeros_like(self.shapes)

    def _look_along(self, rotations: NDArray[np.float64], depths: NDArray[np.float64]) -> None:
        """Set cameras and depths (T, N)."""
        self.rotations = rotations
        self.axis = np.ascontiguousarray(rotations[:, 2])
        self.planar = planar_shapes(self.measurements, rotations)
        self.shapes = self._with_depths(depths)
        self._off_diagonal = -np.einsum("tj,tj->t", self.axis[:-1], self.axis[1:])
        self._planar_motion = self._along_axis(self._second_difference(self.planar))

    def turn_to(self, rotations: NDArray[np.float64]) -> None:
        """Change the cameras, keeping depths and multipliers as each camera sees them."""
        depths = self._along_axis(self.shapes.reshape(self.frames, 3, -1))
        seen = self.rotations @ self.dual.reshape(self.frames, 3, -1)
        self._look_along(rotations, depths)
        self.dual = (rotations.transpose(0, 2, 1) @ seen).reshape(self.frames, -1)

    def _second_difference(self, S: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return D^T D S."""
        differences = np.zeros((self.frames + 1, *S.shape[1:]))
        differences[1:-1] = S[1:] - S[:-1]
        result: NDArray[np.float64] = differences[:-1] - differences[1:]
        return result

    def _along_axis(self, S: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depths (T, N) of shapes (T, 3, N)."""
        return depths_along(self.axis, S)

    def _with_depths(self, depths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shapes (T, 3N) with W = R S and the given depths (T, N)."""
        shapes = self.planar + self.axis[:, :, None] * depths[:, None, :]
        return shapes.reshape(self.frames, -1)

    def _tridiagonal_factor(
        self, penalty: float, motion_weight: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Factor ``penalty I + motion_weight n^T D^T D n``, for `dpttrs`."""
        diagonal, off_diagonal, failed = dpttrf(
            penalty + motion_weight * self._diagonal, motion_weight * self._off_diagonal
        )
        if failed:
            raise NumericalFailure("The motion of the depths is not positive definite.")
        return diagonal, off_diagonal

    def start_from_least_motion(self) -> None:
        """Set the depths that move the shape least from frame to frame."""
        factor = self._tridiagonal_factor(1e-6, 1.0)
        self.shapes = self._with_depths(dpttrs(*factor, -self._planar_motion)[0])
        self.dual = np.zeros_like(self.shapes)
        self.penalty = 0.0

    def start_over_if_simpler(self) -> bool:
        """Start from least motion where that alone is clearly simpler than the present shapes.

        Iterations from flat shapes take long where the object is much deeper than wide, as along a
        limb, and reweighting would keep shapes half flat that are so still.
        """
        present, nuclear = (self.shapes, self.dual, self.penalty), float(self.spectrum().sum())
        self.start_from_least_motion()
        if float(self.spectrum().sum()) < self.CLEARLY_SIMPLER * nuclear:
            return True
        self.shapes, self.dual, self.penalty = present
        return False

    def spectrum(self) -> NDArray[np.float64]:
        """Return the singular values of P S#, largest first."""
        return singular_values(self.shapes - self.shapes.mean(axis=0))

    def complexity(self) -> float:
        """Return the nuclear norm of the shapes over that of the tracks, taken for flat shapes.

        Depth that is right makes the shapes simpler than the tracks; where this number is near 1,
        depth explains nothing.
        """
        flat = self.measurements.reshape(self.frames, -1)
        of_tracks = float(singular_values(flat - flat.mean(axis=0)).sum())
        return float(self.spectrum().sum()) / max(of_tracks, np.finfo(float).tiny)

    def image_motion(self) -> float:
        """Return ||D W||_F^2, as seen in the image."""
        flat = self.measurements.reshape(self.frames, -1)
        return float((np.diff(flat, axis=0) ** 2).sum())

    def motion(self) -> float:
        """Return ||D S#||_F^2."""
        return float((np.diff(self.shapes, axis=0) ** 2).sum())

    def value(self) -> float:
        """Return the present value of the objective."""
        nuclear = float((self.weights * self.spectrum()).sum())
        return nuclear + 0.5 * self.motion_weight * self.motion()

    def camera_gradient(self) -> NDArray[np.float64]:
        """Return the derivative (T, 3) of the minimum by turns ``G_t <- exp(phi_t) G_t``.

        By the envelope theorem the shapes, being optimal, contribute nothing: only the multipliers
        and the motion term see the cameras.
        """
        S = self.shapes.reshape(self.frames, 3, -1)
        force = self.penalty * self.dual.reshape(S.shape)
        force = force + self.motion_weight * self._second_difference(S)
        force = self.rotations @ force
        force[:, 2] = 0.0  # vanishes at the optimum: the depths are free
        seen = self.rotations @ S
        gradient: NDArray[np.float64] = np.cross(force, seen, axis=1).sum(axis=2)
        return gradient

    def _penalty_change(self, primal: float, dual: float, convex: bool) -> float:
        """Return the factor on the penalty that brings the residuals together."""
        if not convex:
            # With too small a penalty the iterates circle: raise it while nothing is gained.
            before = self.residuals[-self.BALANCE_EVERY :][0]
            stalled = max(primal, dual) > self.STALLED * before
            return 2.0 if stalled or primal > self.BALANCE_RATIO * dual else 1.0
        if primal > self.BALANCE_RATIO * dual:
            return 2.0
        return 0.5 if dual > self.BALANCE_RATIO * primal else 1.0

    def minimise(self, max_iterations: int, tolerance: float, hook: StageHook = ignore) -> bool:
        """Iterate from the present state; return whether both residuals met the tolerance."""
        if self.penalty == 0.0:
            size = 1e-9 * float(np.linalg.norm(self.shapes))
            largest = max(float(self.spectrum()[0]), size, np.finfo(float).tiny)
            self.penalty = self.FIRST_PENALTY / largest
        S, Y = self.shapes, self.dual
        Z = S
        factor = self._tridiagonal_factor(self.penalty, self.motion_weight)
        # Reweighting gives small singular values large weights, and over-relaxed steps may cycle.
        convex = np.ndim(self.weights) == 0
        first_penalty = self.penalty
        relaxation = self.RELAXATION if convex else 1.0
        for iteration in range(1, max_iterations + 1):
            X = S + Y
            if relaxation != 1.0:
                X += (relaxation - 1.0) * (S - Z)
            mean = X.mean(axis=0)
            Z, _ = singular_value_threshold(X - mean, self.weights / self.penalty)
            Z += mean
            Y = X - Z
            target = self._along_axis((Z - Y).reshape(self.frames, 3, -1))
            if self.motion_weight > 0.0:
                right = self.penalty * target - self.motion_weight * self._planar_motion
                target, _ = dpttrs(*factor, right)
            previous, S = S, self._with_depths(target)
            size = max(float(np.linalg.norm(S)), np.finfo(float).tiny)
            primal = float(np.linalg.norm(S - Z)) / size
            dual = float(np.linalg.norm(S - previous)) / size
            self.residuals.append(max(primal, dual))
            hook(iteration / max_iterations, len(self.residuals), self.residuals[-1])
            if self.residuals[-1] < tolerance:
                break
            if iteration % self.BALANCE_EVERY == 0:
                change = self._penalty_change(primal, dual, convex)
                # Of a rigid object no singular value is left to balance against.
                if self.penalty * change < self.LEAST_PENALTY * first_penalty:
                    change = 1.0
                self.penalty *= change
                Y = Y / change
                factor = self._tridiagonal_factor(self.penalty, self.motion_weight)
        self.shapes, self.dual = S, Y
        return self.residuals[-1] < tolerance
