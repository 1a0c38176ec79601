"""Which cameras to take: free ones, unless a simpler motion explains them as well."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.paper import published_cameras
from smsr.cameras.relaxed import relaxed_cameras
from smsr.cameras.uniform import fit_uniform_turn, refine_uniform_turn, turning_cameras
from smsr.progress import ignore
from smsr.shapes import DepthProblem, minimise_reweighted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.options import Options
    from smsr.progress import StageHook

UNEXPLAINED_LIMIT = 0.10
"""Part of the rotation variance of the free cameras that a uniform turn may leave unexplained."""

ENERGY_LIMIT = 0.25
"""Most that the logarithmic energy may rise from the free cameras to a uniform turn."""

SPAN_LIMIT = 0.06
"""Most of a uniform turn that may lie outside the leading left singular vectors of W, unless more
of the free cameras does."""

_SPAN_DIRECTIONS = 18
_ENERGY_DIRECTIONS = 32
_ENERGY_REST = 0.005  # part of the measurements that energies may leave out


def estimate_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    options: Options,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras of all frames in the way that the options ask for.

    Parameters
    ----------
    left : ndarray of shape (2T, q)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (q,)
        Singular values, largest first.
    options : Options
        Resolved by `smsr.options.resolve`.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    if options.camera_model == "paper":
        return published_cameras(
            left,
            values,
            basis_size=options.basis_size,
            max_iterations=options.camera_iterations,
            hook=hook,
        )
    free = relaxed_cameras(
        left,
        values,
        basis_size=options.basis_size or 10,
        max_iterations=options.camera_iterations,
        tolerance=options.camera_tolerance,
        hook=part_of(hook, 0.0, 0.5),
    )
    if options.camera_model == "relaxed":
        return free
    forced = options.camera_model == "uniform"
    return with_uniform_turn(free, left, values, part_of(hook, 0.5, 1.0), force=forced)


def with_uniform_turn(
    free: CameraEstimate,
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    hook: StageHook = ignore,
    *,
    force: bool = False,
) -> CameraEstimate:
    """Return cameras of constant angular velocity where they explain the free ones, else those.

    Parameters
    ----------
    free : CameraEstimate
        Cameras without a motion model.
    left, values
        As for `estimate_cameras`.
    hook : callable
        See `smsr.progress.StageHook`.
    force : bool
        Take the uniform turn whatever it explains.
    """
    frames = len(free.rotations)
    velocity, middle = fit_uniform_turn(free.rotations)
    turn = turning_cameras(velocity, middle, frames)
    unexplained = unexplained_rotation(free.rotations, turn)
    if unexplained > UNEXPLAINED_LIMIT and not force:
        return _refused(free, f"leaves {unexplained:.0%} of the rotation unexplained")
    leading = (left * values)[:, : _leading_directions(values)]
    before = measure_energy(leading, free.rotations)
    after = measure_energy(leading, turn)
    rise = after.log_energy - before.log_energy
    if rise > ENERGY_LIMIT and not force:
        return _refused(free, f"raises the log energy of the shapes by {rise:.2f}")
    velocity = refine_uniform_turn(
        leading, velocity, middle, motion_weight=after.motion_weight, hook=hook
    )
    turn = turning_cameras(velocity, middle, frames)
    outside = part_outside_span(left, turn)
    if outside > max(SPAN_LIMIT, part_outside_span(left, free.rotations)) and not force:
        return _refused(free, f"lies outside the span of the measurements by {outside:.1%}")
    degrees = math.degrees(float(np.linalg.norm(velocity)))
    return dataclasses.replace(
        free,
        rotations=turn,
        model="uniform",
        reason=f"{free.reason}; a uniform turn of {degrees:.2f} degrees a frame leaves "
        f"{unexplained:.1%} of the rotation unexplained",
    )


def _refused(free: CameraEstimate, why: str) -> CameraEstimate:
    """Return the free cameras with the reason why they were kept."""
    return dataclasses.replace(free, reason=f"{free.reason}; a uniform turn {why}")


def part_outside_span(left: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return how much of the cameras no combination of the leading directions of W explains.

    Where the deformation is a sum of basis shapes, W = R (C kron I_3) B, and the mean shape is one
    of them, the columns of R themselves lie in the column space of W. Wrong cameras do not.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, strongest first.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    float
        ``||R - U U^T R|| / ||R||``, U the leading columns.
    """
    R = rotations[:, :2].reshape(len(left), 3)
    # At most half of the dimensions: in more than that anything lies nearly.
    U = left[:, : min(_SPAN_DIRECTIONS, len(rotations))]
    return float(np.linalg.norm(R - U @ (U.T @ R)) / np.linalg.norm(R))


def _leading_directions(values: NDArray[np.float64]) -> int:
    """Return on how many virtual points energies are measured."""
    squares = values**2
    rest = np.sqrt(np.cumsum(squares[::-1])[::-1] / squares.sum())
    return min(max(int((rest > _ENERGY_REST).sum()), 4), _ENERGY_DIRECTIONS)


def unexplained_rotation(rotations: NDArray[np.float64], model: NDArray[np.float64]) -> float:
    """Return the part of the variance of rotations (T, 3, 3) that a model (T, 3, 3) leaves."""
    variance = float(((rotations - rotations.mean(axis=0)) ** 2).sum())
    return float(((rotations - model) ** 2).sum()) / max(variance, np.finfo(float).tiny)


@dataclass(frozen=True, slots=True)
class Energy:
    """How simple the shapes are that some cameras allow.

    Attributes
    ----------
    log_energy : float
        ``(log ||P S#||_* + 1.5 log ||D S#||_F^2) / 4``, free of units up to a constant.
    motion_weight : float
        Weight lambda of the motion term.
    """

    log_energy: float
    motion_weight: float


def measure_energy(measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> Energy:
    """Measure the best shapes (2T, N) for some cameras (T, 3, 3), roughly converged."""
    problem = DepthProblem(measurements, rotations)
    problem.start_from_least_motion()
    minimise_reweighted(
        problem,
        motion_weight=1.5,
        rounds=3,
        max_iterations=140,
        tolerance=2e-4,
        low_rank=False,
    )
    nuclear = float(problem.spectrum().sum())
    log_energy = math.log(nuclear + 1e-12) + 1.5 * math.log(problem.motion() + 1e-12)
    return Energy(log_energy / 4.0, problem.motion_weight)


def part_of(hook: StageHook, first: float, last: float) -> StageHook:
    """Return a hook that reports into a part of another hook's range."""

    def part(fraction: float, iteration: int, residual: float | None) -> None:
        hook(first + fraction * (last - first), iteration, residual)

    return part
