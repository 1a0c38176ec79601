"""Cameras that turn about one axis of their own, with a shake from frame to frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import dct, idct
from scipy.optimize import minimize

from smsr import rotations as so3
from smsr.progress import ignore
from smsr.shapes.problem import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """A turn about a fixed axis: ``G_t = exp(s_t) exp(a_t omega) G_0``.

    Attributes
    ----------
    angles : ndarray of shape (T,)
        a, how far the turn has gone, in frames of full velocity.
    velocity : ndarray of shape (3,)
        Omega in the camera frame, radians a frame.
    start : ndarray of shape (3, 3)
        G_0, the camera where a is zero.
    shake : ndarray of shape (T, 3)
        s, rotation vectors of what a steady hand would not have done.
    """

    angles: NDArray[np.float64]
    velocity: NDArray[np.float64]
    start: NDArray[np.float64]
    shake: NDArray[np.float64]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """G (T, 3, 3)."""
        turned: NDArray[np.float64] = so3.exp(self.shake) @ self.steady
        return turned

    @property
    def steady(self) -> NDArray[np.float64]:
        """The same without the shake."""
        turned: NDArray[np.float64] = so3.exp(self.angles[:, None] * self.velocity) @ self.start
        return turned

    @property
    def span(self) -> float:
        """Range of the angles, at least a frame of full velocity."""
        return max(float(np.ptp(self.angles)), 1.0)

    def by_velocity(self, fixed: float = 0.0) -> NDArray[np.float64]:
        """Return how the cameras turn as the velocity changes.

        Parameters
        ----------
        fixed : float
            The angle at which the camera stays.

        Returns
        -------
        ndarray of shape (3, T, 3)
            For each axis of the camera frame the rotation vectors, in the frames of the cameras,
            by a change of one radian a frame.
        """
        gone = (self.angles - fixed)[:, None]
        turned = so3.exp(self.shake) @ (so3.left_jacobian(gone * self.velocity) * gone[:, None])
        fields: NDArray[np.float64] = turned.transpose(2, 0, 1)
        return fields

    def every(self, step: int) -> Turn:
        """Return the turn of every n-th frame."""
        return dataclasses.replace(self, angles=self.angles[::step], shake=self.shake[::step])


def steady_turn(
    angles: NDArray[np.float64], velocity: NDArray[np.float64], start: NDArray[np.float64]
) -> Turn:
    """Return a turn without a shake."""
    return Turn(angles, velocity, start, np.zeros((len(angles), 3)))


_HALF_WIDTH = 4  # cosines on either side that share an estimate of power
_SLOWEST = 8  # cosines whose own power counts
_CHI_MEDIAN = 2.37 / 3.0  # median over mean of a chi-squared variable of three degrees of freedom


def with_shake(turn: Turn, rotations: NDArray[np.float64]) -> tuple[Turn, NDArray[np.float64]]:
    """Add to a turn the part of the cameras' deviation from it that is white in time.

    Free cameras err by a slow drift, and hardly from frame to frame. What deviates at all
    frequencies alike is therefore the camera's own shake; what rises above that floor at low
    frequencies is drift.

    Parameters
    ----------
    turn : Turn
        A fit to the cameras.
    rotations : ndarray of shape (T, 3, 3)
        Free cameras.

    Returns
    -------
    turn : Turn
        With the shake.
    drift : ndarray of shape (T, 3)
        Rotation vectors of the rest.
    """
    deviation = so3.log(rotations @ turn.steady.transpose(0, 2, 1))
    spectrum = dct(deviation, axis=0, norm="ortho")
    frames = len(spectrum)
    energy = (spectrum**2).sum(axis=1)
    floor = float(np.median(energy[frames // 2 :])) / _CHI_MEDIAN
    total = np.concatenate([[0.0], np.cumsum(energy)])
    index = np.arange(frames)
    first = np.maximum(index - _HALF_WIDTH, 0)
    last = np.minimum(index + _HALF_WIDTH + 1, frames)
    power = (total[last] - total[first]) / (last - first)
    power = np.maximum(power, energy * (index < _SLOWEST))
    gain = np.minimum(1.0, np.sqrt(2.0 * floor / np.maximum(power, np.finfo(float).tiny)))
    shake = idct(spectrum * gain[:, None], axis=0, norm="ortho")
    return dataclasses.replace(turn, shake=shake), deviation - shake


def refine_velocity(
    turn: Turn,
    measurements: NDArray[np.float64],
    *,
    motion_weight: float,
    evaluations: int = 30,
    hook: StageHook = ignore,
) -> tuple[Turn, float]:
    """Return the turn at the velocity whose best shape has least energy.

    The energy is ``||P S#||_* + lambda/2 ||D S#||_F^2``, minimised over the shapes with W = R S
    for each velocity and over the velocity by L-BFGS.

    Parameters
    ----------
    turn : Turn
        With a velocity near that.
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ...
    motion_weight : float
        Lambda.
    evaluations : int
        Most evaluations of the energy.
    hook : callable
        See `smsr.progress.StageHook`.

    Returns
    -------
    turn : Turn
        With that velocity.
    gain : float
        Nuclear norm of the best shapes at the given velocity over that at the velocity of least
        energy that was seen.
    """
    problem = DepthProblem(measurements, turn.rotations)
    problem.start_from_least_motion()
    problem.motion_weight = motion_weight
    values: list[tuple[float, float]] = []

    def at(x: NDArray[np.float64]) -> Turn:
        return dataclasses.replace(turn, velocity=turn.velocity + x / turn.span)

    def energy(x: NDArray[np.float64], *_: object) -> tuple[float, NDArray[np.float64]]:
        now = at(x)
        problem.turn_to(now.rotations)
        problem.minimise(60, 3e-4)
        value = problem.value()
        values.append((value, value - 0.5 * motion_weight * problem.motion()))
        hook(min(len(values) / evaluations, 1.0), len(values), problem.residuals[-1])
        gradient = np.tensordot(now.by_velocity(), problem.camera_gradient(), axes=2)
        return value, gradient / turn.span

    found = minimize(
        energy,
        np.zeros(3),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": evaluations, "maxfun": evaluations, "ftol": 1e-5},  # of the energy
    )
    return at(found.x), values[0][1] / max(min(values)[1], np.finfo(float).tiny)
