"""Which cameras to take: free ones, unless a simpler motion explains them as well.

Free cameras drift slowly, and nothing in the shapes tells: a turn of the object and one of the
camera look alike. A path of few parameters cannot drift. It is taken where it passes three tests:
it leaves little of the free cameras unexplained, the shapes it gives do not move more, and it lies
in the span of the tracks.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.free import every_frame, free_cameras
from smsr.cameras.paper import published_cameras
from smsr.cameras.rigid import RIGID_REST, rigid_cameras
from smsr.cameras.switched import fit_switched_turn
from smsr.cameras.turn import refine_velocity, with_shake
from smsr.cameras.uniform import fit_uniform_turn
from smsr.progress import ignore, part_of
from smsr.shapes import DepthProblem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.cameras.turn import Turn
    from smsr.options import Options
    from smsr.progress import StageHook

UNEXPLAINED_LIMIT = 0.1
"""Part of the rotation variance of the free cameras that a path may leave unexplained."""

UNEXPLAINED_LITTLE = 0.035
"""Part below which the path may even make the object move somewhat more."""

MOTION_RISE_LIMIT = 0.35
"""By how much more: log of the ratio of ||D S#||^2."""

COHERENT_RISE = 0.03
"""Up to this much more motion is no more, see `CameraEstimate.coherent`."""

CLEARLY_SIMPLER = 0.85
"""Part of the nuclear norm on a path below which free cameras give clearly simpler shapes."""

SPAN_LIMIT = 0.06
"""Most of a path that may lie outside the leading left singular vectors of W, unless more of the
free cameras does."""

FEWEST_FRAMES = 12
"""Paths are fitted to at least so many frames."""

_PATHS: tuple[tuple[str, Callable[[NDArray[np.float64]], Turn | None]], ...] = (
    ("uniform", fit_uniform_turn),
    ("switched", fit_switched_turn),
)
_FRAMES = 400
_DIRECTIONS = 24
_MOTION_WEIGHT = 1.5
_SPAN_DIRECTIONS = 18


def estimate_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    options: Options,
    hook: StageHook = ignore,
    *,
    noise: float = 0.0,
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
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread; 0 for
        none.
    """
    if options.camera_model == "paper":
        return published_cameras(
            left,
            values,
            basis_size=options.basis_size,
            max_iterations=options.camera_iterations,
            hook=hook,
        )
    if options.camera_model == "auto" and looks_rigid(values):
        rigid = rigid_cameras(left, values)
        if rigid is not None:
            return rigid
    free = free_cameras(
        left,
        values,
        basis_size=options.basis_size,
        noise=noise,
        max_iterations=options.camera_iterations,
        tolerance=options.camera_tolerance,
        hook=part_of(hook, 0.0, 0.5),
    )
    if options.camera_model == "relaxed":
        return free
    return with_simple_path(
        free,
        left * values,
        part_of(hook, 0.5, 1.0),
        force=options.camera_model == "uniform",
        denoised=noise > 0.0,
    )


def looks_rigid(values: NDArray[np.float64]) -> bool:
    """Tell whether three directions explain the tracks so well that the object may be rigid."""
    return bool(np.linalg.norm(values[3:]) < RIGID_REST * np.linalg.norm(values))


def with_simple_path(
    free: CameraEstimate,
    measurements: NDArray[np.float64],
    hook: StageHook = ignore,
    *,
    force: bool = False,
    denoised: bool = False,
) -> CameraEstimate:
    """Return cameras on a uniform or switched turn where it explains the free ones, else those.

    Parameters
    ----------
    free : CameraEstimate
        Cameras without a motion model.
    measurements : ndarray of shape (2T, q)
        Virtual points, strongest first.
    hook : callable
        See `smsr.progress.StageHook`.
    force : bool
        Take the uniform turn, without any shake, whatever it explains.
    denoised : bool
        Weak directions of the measurements went with their noise, and part of what spans the
        cameras with them: do not ask that paths lie in the span.

    Returns
    -------
    CameraEstimate
        Its criteria hold, for each path that was fitted, the numbers it was judged by:
        ``uniform_unexplained``, ``uniform_motion_rise``, ``uniform_outside_span`` and the like.
    """
    frames = len(free.rotations)
    if frames < FEWEST_FRAMES and not force:
        return free
    # Paths have few parameters: some of the frames and directions determine them.
    step = math.ceil(frames / _FRAMES)
    trial = _Trial(every_frame(measurements, step)[:, :_DIRECTIONS], free.rotations, step)
    criteria = dict(free.criteria)
    refusals = []
    for name, fit in _PATHS:
        turn = fit(free.rotations)
        if turn is None:
            refusals.append(f"no {name} turn fits")
            continue
        verdict = trial.judge(turn) if not force else trial.accept(turn)
        criteria[f"{name}_unexplained"] = verdict.unexplained
        if verdict.motion_rise is not None:
            criteria[f"{name}_motion_rise"] = verdict.motion_rise
        if verdict.motion_weight is None:
            refusals.append(f"a {name} turn {verdict.reason}")
            continue
        some = refine_velocity(
            verdict.turn.every(step),
            trial.measurements,
            motion_weight=verdict.motion_weight,
            hook=hook,
        )
        turn = dataclasses.replace(verdict.turn, velocity=some.velocity)
        outside = part_outside_span(measurements, turn.rotations)
        criteria[f"{name}_outside_span"] = outside
        limit = max(SPAN_LIMIT, part_outside_span(measurements, free.rotations))
        if outside > limit and not (force or denoised):
            refusals.append(f"a {name} turn lies outside the span of the tracks by {outside:.1%}")
            continue
        speed = math.degrees(float(np.linalg.norm(turn.velocity)))
        return dataclasses.replace(
            free,
            rotations=turn.rotations,
            model=name,
            criteria=criteria,
            coherent=(verdict.motion_rise or 0.0) <= COHERENT_RISE,
            simpler=free.rotations if verdict.free_simplicity < CLEARLY_SIMPLER else None,
            reason=f"a {name} turn of {speed:.2f} degrees a frame {verdict.reason}; {free.reason}",
        )
    return dataclasses.replace(free, criteria=criteria, reason="; ".join([*refusals, free.reason]))


def part_outside_span(measurements: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return how much of the cameras no combination of the leading directions of W explains.

    Where the deformation is a sum of basis shapes, W = R (C kron I_3) B, and the mean shape is one
    of them, the columns of R themselves lie in the column space of W. Wrong cameras do not.

    Parameters
    ----------
    measurements : ndarray of shape (2T, q)
        Virtual points, orthogonal columns, strongest first.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    float
        ``||R - U U^T R|| / ||R||``, U the leading columns at unit length.
    """
    R = rotations[:, :2].reshape(-1, 3)
    # At most half of the dimensions: in more than that anything lies nearly.
    U = measurements[:, : min(_SPAN_DIRECTIONS, len(rotations))]
    U = U / np.linalg.norm(U, axis=0)
    return float(np.linalg.norm(R - U @ (U.T @ R)) / np.linalg.norm(R))


@dataclass(frozen=True, slots=True, eq=False)
class _Verdict:
    """What became of a path; without a motion weight it was refused."""

    turn: Turn
    unexplained: float
    reason: str
    motion_rise: float | None = None
    motion_weight: float | None = None
    free_simplicity: float = 1.0  # nuclear norm with the free cameras over that on the path


class _Trial:
    """The free cameras that paths are judged against.

    Parameters
    ----------
    measurements : ndarray of shape (2T', q)
        Virtual points in every n-th frame.
    rotations : ndarray of shape (T, 3, 3)
        Free cameras of all frames.
    step : int
        n.
    """

    def __init__(
        self, measurements: NDArray[np.float64], rotations: NDArray[np.float64], step: int
    ) -> None:
        self.measurements = measurements
        self.rotations = rotations
        self.step = step
        self._free_motion: float | None = None
        self._free_nuclear = 0.0

    def judge(self, turn: Turn) -> _Verdict:
        """Add to a path the shake of the cameras and put it to the tests."""
        turn, drift = with_shake(turn, self.rotations)
        spread = float(((self.rotations - self.rotations.mean(axis=0)) ** 2).sum())
        # ||G - H||_F^2 is twice the squared angle between G and H, to second order.
        unexplained = 2.0 * float((drift**2).sum()) / max(spread, np.finfo(float).tiny)
        reason = f"leaves {unexplained:.1%} of the rotation unexplained"
        if unexplained > UNEXPLAINED_LIMIT:
            return _Verdict(turn, unexplained, reason)
        verdict = self.accept(turn, unexplained)
        rise = verdict.motion_rise or 0.0
        if rise <= (MOTION_RISE_LIMIT if unexplained <= UNEXPLAINED_LITTLE else 0.0):
            return verdict
        return dataclasses.replace(verdict, motion_weight=None)

    def accept(self, turn: Turn, unexplained: float = 0.0) -> _Verdict:
        """Measure the shapes that a path gives, and accept it."""
        tiny = np.finfo(float).tiny
        if self._free_motion is None:
            free = self._solve(self.rotations[:: self.step])
            self._free_motion = max(free.motion(), tiny)
            self._free_nuclear = float(free.spectrum().sum())
        problem = self._solve(turn.every(self.step).rotations)
        motion = max(problem.motion(), tiny)
        gain = max(0.0, math.log(max(problem.image_motion(), tiny) / motion))
        rise = math.log(motion / self._free_motion)
        nuclear = float(problem.spectrum().sum())
        return _Verdict(
            turn,
            unexplained,
            f"leaves {unexplained:.1%} of the rotation unexplained and changes the motion of the "
            f"object by {math.expm1(rise):+.0%}",
            rise,
            _MOTION_WEIGHT * gain * nuclear / motion,
            self._free_nuclear / max(nuclear, tiny),
        )

    def _solve(self, rotations: NDArray[np.float64]) -> DepthProblem:
        """Return the best shapes for some cameras."""
        problem = DepthProblem(self.measurements, rotations)
        problem.start_from_least_motion()
        problem.minimise(120, 1e-4)
        return problem
