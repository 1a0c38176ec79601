"""Shapes of all frames from the measurements and the cameras: nuclear-norm minimisation.

    min ||P S#||_*    subject to    W = R S                                (paper, Sec. 3.3)

S# (T x 3N) holds the coordinates of frame t in row t and P takes off the mean shape. With known
cameras only the depths along the viewing directions are unknown: ``S_t = R_t^T W_t + n_t d_t``.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs

from smsr.adjustment import Adjustment
from smsr.deformation import likely_shapes
from smsr.lengths import Lengths, chosen_points
from smsr.progress import ignore, part_of
from smsr.proximal import singular_value_threshold, singular_values
from smsr.rotations import depths_along, spread_of_views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.options import Options
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
        Whether the last round met its tolerance; refinement to likely depths is not asked.
    reason : str
        Why it stopped, for a person.
    residuals : tuple of float
        Stopping residual at each iteration.
    complexity : float
        See `DepthProblem.complexity`; 0 where it was not measured.
    flicker : float
        See `flicker`; 0 where it was not measured.
    steadiness : float
        Of the likely shapes that take part in these, see `steadiness`, as far as noise lets it
        count; 0 where it was not measured.
    rotations : ndarray of shape (T, 3, 3), optional
        The cameras, where they were adjusted with the shapes.
    """

    shapes: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...] = ()
    complexity: float = 0.0
    flicker: float = 0.0
    steadiness: float = 0.0
    rotations: NDArray[np.float64] | None = None


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
            raise np.linalg.LinAlgError("The motion of the depths is not positive definite.")
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


def estimate_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    options: Options,
    *,
    camera_model: str = "relaxed",
    coherent: bool = False,
    simpler: NDArray[np.float64] | None = None,
    simpler_share: float = 0.0,
    adjustable: NDArray[np.float64] | None = None,
    noise: float = 0.0,
    points: NDArray[np.float64] | None = None,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Find the shapes of all frames in the way that the options ask for.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ..., of unit spectral norm.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    options : Options
        Resolved by `smsr.options.resolve`.
    camera_model : str
        How the cameras were found: 'rigid' says that the object is.
    coherent : bool
        See `reweighted_shapes`.
    simpler : ndarray of shape (T, 3, 3), optional
    simpler_share : float
    adjustable : ndarray of shape (k, T, 3), optional
        See `smsr.cameras.CameraEstimate`.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.
    points : ndarray of shape (N, n), optional
        Some real points in terms of the columns of W, where these are virtual ones.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    share = 0.0 if simpler is None else simpler_share * _trust(noise)
    blended = options.shape_method == "auto" and share < 1.0
    if simpler is not None and simpler_share == 1.0 and not blended:
        found = estimate_shapes(
            measurements,
            simpler,
            options,
            camera_model=camera_model,
            coherent=coherent,
            noise=noise,
            points=points,
            hook=hook,
        )
        return dataclasses.replace(found, shapes=turned_to(found.shapes, simpler, rotations))
    limits: dict[str, Any] = {
        "max_iterations": options.shape_iterations,
        "tolerance": options.shape_tolerance,
        "hook": hook,
    }
    if options.shape_method == "paper":
        return published_shapes(
            measurements,
            rotations,
            penalty=options.penalty,
            penalty_growth=options.penalty_growth,
            **limits,
        )
    if options.shape_method == "nuclear":
        return low_rank_shapes(measurements, rotations, **limits)
    if options.shape_method == "auto" and camera_model == "rigid":
        return rigid_shapes(measurements, rotations)
    limits["motion_weight"] = options.motion_weight
    limits["coherent"] = coherent
    if options.shape_method == "reweighted":
        return reweighted_shapes(measurements, rotations, **limits)

    def solve(
        cameras: NDArray[np.float64],
        weight: float,
        adjustable: NDArray[np.float64] | None = None,
    ) -> ShapeEstimate:
        return believable_shapes(
            measurements,
            cameras,
            weight=weight,
            adjustable=adjustable,
            noise=noise,
            points=points,
            **limits,
        )

    found = solve(rotations, 1.0 - share, adjustable)
    if simpler is None or share == 0.0:
        return found
    if found.rotations is not None:
        rotations = found.rotations
    return with_mean_depth(found, rotations, solve(simpler, share), simpler, share)


def believable_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    weight: float = 1.0,
    adjustable: NDArray[np.float64] | None = None,
    noise: float = 0.0,
    points: NDArray[np.float64] | None = None,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
    **problem: Any,
) -> ShapeEstimate:
    """Find the shapes that some cameras see, with as much depth as can be believed.

    They are simple ones (`reweighted_shapes`), refined to likely depths (`with_likely_depth`), with
    less depth or more where that is doubtful (`credible_depth`, `with_deep_shapes`).

    Parameters
    ----------
    measurements, rotations, max_iterations, tolerance, hook
        As for `low_rank_shapes`.
    weight : float
        Part of the result that the shapes will make: refining a little is not worth the time.
    adjustable, noise, points
        See `estimate_shapes`.
    **problem
        `motion_weight` and `coherent` of `reweighted_shapes`.
    """

    def enter(
        cameras: NDArray[np.float64], adjustable: NDArray[np.float64] | None, *, deep: bool
    ) -> ShapeEstimate:
        refined = weight >= _LITTLE
        first, second = part_of(hook, 0.0, 0.4), part_of(hook, 0.4, 1.0)
        found = reweighted_shapes(
            measurements,
            cameras,
            deep=deep,
            max_iterations=max_iterations,
            # The start of a refinement need not be so exact: five times here move the end by 0.1 %.
            tolerance=_ROUGHLY * tolerance if refined else tolerance,
            hook=first if refined else hook,
            **problem,
        )
        if not refined:
            return found
        return with_likely_depth(
            found,
            cameras,
            noise,
            points=points,
            adjustable=adjustable,
            doubtful=deep,
            max_iterations=max_iterations,
            hook=second,
        )

    found = enter(rotations, adjustable, deep=False)
    if found.rotations is not None:
        rotations = found.rotations
    found = credible_depth(found, rotations)
    if found.complexity < DOUBTFUL or _trust(noise) == 0.0:
        return found
    return with_deep_shapes(found, enter(rotations, None, deep=True), rotations, noise)


def low_rank_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
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
    the minimum that `low_rank_shapes` finds. What is left of W - R S goes into the image plane.

    Parameters
    ----------
    measurements, rotations, max_iterations, hook
        As for `low_rank_shapes`.
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


def reweighted_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    motion_weight: float = 1.0,
    coherent: bool = False,
    deep: bool = False,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Minimise a reweighted nuclear norm and the motion of the shape between frames.

    Minimises ``sum_i log(sigma_i(P S#) + eps sigma_1) + lambda/2 ||D S#||_F^2`` subject to
    W = R S by a few rounds of a weighted nuclear norm, w_i = 1 / (sigma_i + eps sigma_1). The
    problem is not convex. It is entered from flat shapes through the plain nuclear norm, so that
    depth is added only where it makes the shapes simpler; but see
    `DepthProblem.start_over_if_simpler`.

    Parameters
    ----------
    measurements, rotations, max_iterations, tolerance, hook
        As for `low_rank_shapes`; the iterations of all rounds together are bounded.
    motion_weight : float
        Lambda relative to ``motion_scale ||P S#||_* / ||D S#||^2``, so it does not depend on
        units, frames or points; 0 for no motion term.
    coherent : bool
        The cameras follow a simple path, and that path made the object move no more: then motion
        that flickers is taken for an error, see `flicker`, and eps is smaller where they turn fast.
    deep : bool
        Enter the problem from the shapes of least motion instead, which have all the depth that
        the minimum of the nuclear norm has.
    """
    problem = DepthProblem(measurements, rotations)
    if deep:
        problem.start_from_least_motion()
    first = min(_DEEP_FIRST_ITERATIONS if deep else _FIRST_ITERATIONS, max_iterations)
    start = part_of(hook, 0.0, 1 / (_ROUNDS + 1))
    converged = problem.minimise(first, tolerance, start)
    left = min(_DEEP_FIRST_ITERATIONS, max_iterations - len(problem.residuals))
    if not deep and left > 0 and problem.start_over_if_simpler():
        converged = problem.minimise(left, tolerance, start)
    complexity = problem.complexity()
    offset = by_turn_speed(rotations, *_LOG_OFFSETS) if coherent else _LOG_OFFSETS[0]
    by_flicker = flicker(problem) if coherent else 0.0
    scale = 0.0
    for index in range(_ROUNDS):
        spectrum, motion = problem.spectrum(), problem.motion()
        nuclear = float(spectrum.sum())
        left = max_iterations - len(problem.residuals)
        if left < 1 or nuclear <= _RIGID * float(np.linalg.norm(problem.shapes)):
            break
        if index < _SCALED_ROUNDS and motion_weight > 0.0:
            scale = motion_weight * motion_scale(problem, by_flicker)
        problem.motion_weight = scale * nuclear / max(motion, 1e-12 * nuclear)
        weights = 1.0 / (spectrum + offset * spectrum[0])
        problem.weights = weights * (nuclear / float(weights @ spectrum))
        count = left if index == _ROUNDS - 1 else min(_ITERATIONS_PER_ROUND, left)
        part = part_of(hook, (index + 1) / (_ROUNDS + 1), (index + 2) / (_ROUNDS + 1))
        converged = problem.minimise(count, tolerance, part)
    return dataclasses.replace(
        _estimate(problem, converged), complexity=complexity, flicker=by_flicker
    )


_FIRST_ITERATIONS = 30
_DEEP_FIRST_ITERATIONS = 150
_ROUNDS = 5
_SCALED_ROUNDS = 2
_ITERATIONS_PER_ROUND = 40
_LOG_OFFSETS = (0.15, 0.05)  # eps; the second where coherent cameras turn fast
_RIGID = 1e-6

_RATIO = 15.0
_BY_RATIO = 0.7
_COMMON_HASTE = 0.012  # of a smooth motion with a period of 40 frames
_BY_HASTE = 50.0
_MOST_BY_HASTE = 2.0
_EXCESS = 0.1
_FAST_TURN = (math.radians(1.0), math.radians(2.0))


def motion_scale(problem: DepthProblem, by_flicker: float = 0.0) -> float:
    """Return how strongly least motion is asked for, given the shapes found so far.

    Least motion settles what the camera's turn leaves open, and does harm where the object itself
    moves. So it is asked for in two cases: where the image moves much more than the shape, which
    then is the camera's doing; and, with coherent cameras, where the estimated motion changes its
    direction from frame to frame as the tracks do not.

    Parameters
    ----------
    problem : DepthProblem
        With the shapes.
    by_flicker : float
        Weight of the second case, see `flicker`.
    """
    motion = max(problem.motion(), np.finfo(float).tiny)
    ratio = max(problem.image_motion() / motion, np.finfo(float).tiny)
    by_ratio = _BY_RATIO * max(0.0, math.log(ratio / _RATIO))
    return max(by_ratio, by_flicker * max(0.0, math.log(ratio)))


def flicker(problem: DepthProblem) -> float:
    """Return how much of the estimated motion is flicker of the depths, as a weight from 0 to 2.

    Haste is how much of a step is undone or turned aside by the next, 0 in a steady motion. Taken
    as the median over the frames, it passes over abrupt moments, which a real object may have.
    Depths that are more hasty than the motion across the viewing direction, which the tracks bear
    out, flicker; where they are not, the object itself is hasty. All of this counts where the
    camera turns so fast that neighbouring frames see depth from different sides.

    Parameters
    ----------
    problem : DepthProblem
        With shapes found by the nuclear norm alone.
    """
    frames = problem.frames
    steps = np.diff(problem.shapes, axis=0).reshape(frames - 1, 3, -1)
    axes = problem.axis[1:] + problem.axis[:-1]
    axes = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), np.finfo(float).tiny)
    depths = np.matmul(axes[:, None], steps)
    across = _haste(steps - axes[:, :, None] * depths)
    excess = (_haste(depths) - across) / max(across, np.finfo(float).tiny)
    sure = min(max(excess / _EXCESS, 0.0), 1.0)
    slope = by_turn_speed(problem.rotations, 0.0, _BY_HASTE)
    return sure * min(_MOST_BY_HASTE, slope * max(0.0, _haste(steps) - _COMMON_HASTE))


def _haste(steps: NDArray[np.float64]) -> float:
    """Return the haste of a motion (T - 1, ...), see `flicker`."""
    if len(steps) < 2:
        return 0.0
    steps = steps.reshape(len(steps), -1)
    squares = (steps**2).sum(axis=1)
    sizes = np.maximum(0.5 * (squares[1:] + squares[:-1]), np.finfo(float).tiny)
    return float(np.median(1.0 - (steps[1:] * steps[:-1]).sum(axis=1) / sizes))


def by_turn_speed(rotations: NDArray[np.float64], slow: float, fast: float) -> float:
    """Return a value between two, by how fast cameras (T, 3, 3) turn from frame to frame.

    A camera that turns fast, beside the object's own motion, sees depth from different sides in
    neighbouring frames, and the tracks bear out more of it.
    """
    turns = np.diff(rotations, axis=0)
    speed = math.sqrt(float((turns**2).sum(axis=(1, 2)).mean()) / 2.0)
    return float(np.interp(speed, _FAST_TURN, (slow, fast)))


def rigid_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> ShapeEstimate:
    """Return one and the same depth for all frames: the least-squares fit of a rigid shape.

    Parameters
    ----------
    measurements, rotations
        As for `low_rank_shapes`.

    Returns
    -------
    ShapeEstimate
        What the rigid shape does not explain of W stays in the image plane, so W = R S holds.
    """
    rigid = np.linalg.lstsq(rotations[:, :2].reshape(-1, 3), measurements, rcond=None)[0]
    axis = rotations[:, 2]
    return ShapeEstimate(
        shapes=planar_shapes(measurements, rotations) + axis[:, :, None] * (axis @ rigid)[:, None],
        iterations=0,
        converged=True,
        reason="one shape for all frames",
    )


def faded(value: float, limits: tuple[float, float]) -> float:
    """Return 1 up to the first limit, 0 from the second on, and evenly less between them."""
    low, high = limits
    return min(max((high - value) / (high - low), 0.0), 1.0)


LIKELY = (0.6, 0.9)
"""Complexities between which the likely depths lose their part, unless the shapes are steady."""

_ROUGHLY = 5.0  # times the tolerance, for the start of a refinement
_LITTLE = 0.25  # part of the depths below which refining it is not worth the time
_LIKELY_NOISE = 0.4  # part of the tracks' spread
_LIKELY_DIRECTIONS = 24
_LIKELY_FLOOR = 0.0008
_FLOOR_BY_NOISE = 0.07
_LIKELY_SHRINKAGE = 0.07
_LIKELY_TOLERANCE = 5e-4
_LEAST_ROUNDS = 20
_MOST_ROUNDS = 60
_FRAMES_IN_ALL_ROUNDS = 60_000


def with_likely_depth(
    estimate: ShapeEstimate,
    rotations: NDArray[np.float64],
    noise: float = 0.0,
    *,
    points: NDArray[np.float64] | None = None,
    adjustable: NDArray[np.float64] | None = None,
    doubtful: bool = False,
    max_iterations: int = 1000,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Return the shapes with depths that are likelier under a Gaussian model of the deformation.

    See `smsr.deformation` and `smsr.lengths`. The depths count less where depth is doubtful and
    where noise was taken off (what is left of it looks like deformation). Of motion that flickered
    the Gaussian model knows nothing: there lengths count more, and where none keep, depths less.

    Parameters
    ----------
    estimate : ShapeEstimate
        With its complexity and flicker, T >= 2.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.
    points : ndarray of shape (q, n), optional
        Some real points in terms of the q that the shapes have; without it, these are real.
    adjustable : ndarray of shape (k, T, 3), optional
        What may change of the cameras, see `smsr.adjustment`. They do as far as the depths count.
    doubtful : bool
        Do this for doubtful depths, too: how steady the shapes become then may remove the doubt.
    max_iterations : int
        Of all, those that the estimate took included.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    part, certain = faded(estimate.complexity, LIKELY), max(1.0 - noise / _LIKELY_NOISE, 0.0)
    # The more frames there are, the surer is each round, and the longer it takes.
    rounds = max(_LEAST_ROUNDS, min(_MOST_ROUNDS, _FRAMES_IN_ALL_ROUNDS // len(rotations)))
    rounds = min(rounds, max_iterations - estimate.iterations)
    if certain == 0.0 or (part == 0.0 and not doubtful) or rounds < 1:
        return estimate
    # Directions that carry little of the tracks have hardly any depth, and cost as much as others.
    seen = (rotations[:, :2] @ estimate.shapes).reshape(2 * len(rotations), -1)
    _, values, right = np.linalg.svd(seen, full_matrices=False)
    count = min(_LIKELY_DIRECTIONS, int((values > 1e-9 * values[0]).sum()))
    directions = right[:count].T
    some = estimate.shapes @ directions
    flat = some.reshape(len(some), -1)
    if np.linalg.norm(flat - flat.mean(axis=0)) <= _RIGID * np.linalg.norm(flat):
        return estimate
    chosen = chosen_points(seen if points is None else seen @ points)
    lengths = Lengths(
        estimate.shapes[:, :, chosen] if points is None else estimate.shapes @ points[:, chosen],
        directions[chosen].T if points is None else directions.T @ points[:, chosen],
        rotations[:, 2],
        depths_along(rotations[:, 2], some),
        noise=noise,
        weight=1.0 + estimate.flicker,
    )
    adjustment = None if adjustable is None else Adjustment(rotations, adjustable)
    likely = likely_shapes(
        some,
        rotations,
        lengths=lengths,
        adjustment=adjustment,
        floor=_LIKELY_FLOOR + _FLOOR_BY_NOISE * noise,
        shrinkage=_LIKELY_SHRINKAGE,
        max_iterations=rounds,
        tolerance=_LIKELY_TOLERANCE,
        hook=hook,
    )
    likely_cameras = rotations if adjustment is None else adjustment.rotations()
    steady = steadiness(likely.shapes, likely_cameras)
    part = max(part, steady) * certain
    part *= 1.0 - (1.0 - likely.support) * estimate.flicker / _MOST_BY_HASTE
    shapes, others, adjusted = estimate.shapes, likely.shapes, None
    if adjustment is not None:
        adjusted = adjustment.rotations(part)
        shapes, some = (turned_to(each, rotations, adjusted) for each in (shapes, some))
        others = turned_to(others, likely_cameras, adjusted)
    return dataclasses.replace(
        estimate,
        shapes=shapes + part * (others - some) @ directions.T,
        steadiness=steady * _trust(noise),
        rotations=adjusted,
        iterations=estimate.iterations + likely.iterations,
        reason=f"{estimate.reason}; {part:.0%} of depths as a Gaussian deformation has them, "
        f"{likely.support:.0%} of points with lengths that keep",
    )


_STEADY = (1.0, 3.0)  # ratios of second differences between which shapes become sure
_UNSTEADY = (0.1, 0.25)  # products of both ratios between which they stop to be wrong


def steadiness(shapes: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return what the steadiness of the shapes says for them: 1 for sure, 0 nothing, -1 against.

    A camera held in the hand shakes, and an object rarely does: where the tracks, and flat shapes,
    have much larger second differences in time, depth explains the shake, which wrong depth cannot.
    (Flat ones too, for they explain as much of a roll about the viewing direction.) Where the
    product of the ratios of first and of second differences is far below 1, most of the motion is
    that of the depths, which the tracks cannot have told.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, N)
        S.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    seen = rotations[:, :2] @ shapes
    flat = planar_shapes(seen.reshape(-1, seen.shape[2]), rotations)
    ratios = []
    for order in (1, 2):
        tracks, without, moved = (
            float((np.diff(each, n=order, axis=0) ** 2).sum()) for each in (seen, flat, shapes)
        )
        least = min(tracks, without)
        # Two frames have no second differences, and an object at rest has none either.
        ratios.append(least / moved if moved > 0.0 else 1.0)
    motion, shake = ratios
    low, high = _STEADY
    sure = min(math.log(max(shake, low) / low) / math.log(high / low), 1.0)
    return sure - faded(motion * shake, _UNSTEADY)


DOUBTFUL = 0.6
"""Complexity above which the way into the problem decides on the depth."""

_DEEP = (0.7, 0.85)  # complexities between which unsteady deep shapes lose their part
_DEEPEST_BY_WIDTH = 1.25
_NOISIEST = 0.15  # part of the tracks' spread
_FEW_VIEWS = (math.radians(30.0), math.radians(45.0))  # widest angles between viewing directions


def _trust(noise: float) -> float:
    """Return how far the simplicity of shapes can be trusted: noise makes wrong depths simple."""
    return max(1.0 - (noise / _NOISIEST) ** 2, 0.0)


def with_deep_shapes(
    estimate: ShapeEstimate,
    deep: ShapeEstimate,
    rotations: NDArray[np.float64],
    noise: float = 0.0,
) -> ShapeEstimate:
    """Return shapes between those entered from flat and those entered from deep ones.

    Where the camera turns little, the nuclear norm hardly changes between the two, and one has too
    little depth and the other often too much. Deep shapes count as far as they make the shapes
    simpler or are steadier than the tracks, and with little more depth than the object is wide;
    where the camera hardly turns, all depth is taken back if they are far less steady.

    Parameters
    ----------
    estimate, deep : ShapeEstimate
        Entered from flat shapes and from those of least motion.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    noise : float
        As a part of the tracks' spread: the more there was, the less does simplicity say.
    """
    part = max(faded(deep.complexity, _DEEP) * _trust(noise), deep.steadiness)
    doubt = faded(spread_of_views(rotations), _FEW_VIEWS)
    keep = 1.0 + doubt * min(deep.steadiness, 0.0)
    if part == 0.0 and keep == 1.0:
        return estimate
    seen = rotations @ deep.shapes
    depth = math.sqrt(float((seen[:, 2] ** 2).mean()))
    image = seen[:, :2].transpose(1, 0, 2).reshape(2, -1)
    width = float(np.linalg.norm(image, 2)) / math.sqrt(seen[:, 2].size)
    width *= _DEEPEST_BY_WIDTH
    depths = min(1.0, width / max(depth, np.finfo(float).tiny)) * seen[:, 2]
    axis = rotations[:, 2]
    present = depths_along(axis, estimate.shapes)
    change = keep * (present + part * (depths - present)) - present
    reason = f"{estimate.reason}; {part:.0%} of shapes with full depth: {deep.reason}"
    if keep < 1.0:
        reason += f"; {keep:.0%} of the depth was kept, for likely depths move more than the tracks"
    return dataclasses.replace(
        estimate,
        shapes=estimate.shapes + axis[:, :, None] * change[:, None],
        steadiness=deep.steadiness,
        iterations=estimate.iterations + deep.iterations,
        converged=estimate.converged and deep.converged,
        reason=reason,
    )


def turned_to(
    shapes: NDArray[np.float64], others: NDArray[np.float64], rotations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return shapes (T, 3, N) so that cameras see them as they were seen by others (T, 3, 3)."""
    turned: NDArray[np.float64] = rotations.transpose(0, 2, 1) @ (others @ shapes)
    return turned


def with_mean_depth(
    estimate: ShapeEstimate,
    rotations: NDArray[np.float64],
    other: ShapeEstimate,
    others: NDArray[np.float64],
    share: float = 0.5,
) -> ShapeEstimate:
    """Return shapes with a mean of the depths that two sets of cameras see.

    An object that turns as a whole looks simpler to cameras that turn with it. Their depths may
    then be the better ones, though their path is not the camera's. Complexity and steadiness are
    means, too.

    Parameters
    ----------
    estimate : ShapeEstimate
        Found with `rotations`.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    other : ShapeEstimate
        Found with `others`.
    others : ndarray of shape (T, 3, 3)
        Other cameras for the same tracks.
    share : float
        Weight of the other depths, 0 to 1.
    """
    turned = turned_to(other.shapes, others, rotations)
    return dataclasses.replace(
        estimate,
        shapes=estimate.shapes + share * (turned - estimate.shapes),
        complexity=estimate.complexity + share * (other.complexity - estimate.complexity),
        steadiness=estimate.steadiness + share * (other.steadiness - estimate.steadiness),
        iterations=estimate.iterations + other.iterations,
        converged=estimate.converged and other.converged,
        reason=f"{estimate.reason}; free cameras, {share:.0%} of their depths: {other.reason}",
    )


FLAT = (0.85, 0.95)
"""Complexities between which depth is faded out."""

_DEEPEST = 2.0


def credible_depth(estimate: ShapeEstimate, rotations: NDArray[np.float64]) -> ShapeEstimate:
    """Return the shapes with no more depth than the tracks bear out.

    Depth is faded out where it makes the shapes no simpler than the flat tracks are, and bounded
    to twice the extent in the image, beyond which it comes from cameras that hardly turn.

    Parameters
    ----------
    estimate : ShapeEstimate
        With its complexity.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    seen = rotations @ estimate.shapes
    depth, image = (seen[:, 2] ** 2).mean(), (seen[:, :2] ** 2).mean()
    ratio = math.sqrt(depth / max(image, np.finfo(float).tiny))
    keep = faded(estimate.complexity, FLAT)
    keep *= min(1.0, _DEEPEST / max(ratio, np.finfo(float).tiny))
    if keep == 1.0:
        return estimate
    excess = (1.0 - keep) * seen[:, 2]
    shapes = estimate.shapes - rotations[:, 2][:, :, None] * excess[:, None]
    return dataclasses.replace(
        estimate, shapes=shapes, reason=f"{estimate.reason}; {keep:.0%} of the depth was kept"
    )


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


def basis_size_of(shapes: NDArray[np.float64], tolerance: float = 0.01) -> int:
    """Return how many basis shapes span shapes (T, 3, N) up to a part of their norm.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, N)
        S.
    tolerance : float
        Part of ||S#||_F that may be left out.
    """
    squares = singular_values(shapes.reshape(len(shapes), -1)) ** 2
    rest = np.cumsum(squares[::-1])[::-1]
    return max(1, int((rest > tolerance**2 * rest[0]).sum()))
