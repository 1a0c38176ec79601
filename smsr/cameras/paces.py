"""How the angle of a turn may go on in time: simple functions, of few parameters.

The angle of free cameras about the axis of their turn is the camera's angle and the object's own
turn. A camera that is led by a machine, or by a steady hand, follows a function that can be named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import legvander

if TYPE_CHECKING:
    from numpy.typing import NDArray

COST_OF_A_PARAMETER = 0.55
"""By how much one parameter more has to lower the log of what is left unexplained."""

FLOOR = 0.02
"""Radians; what follows the cameras more closely than this is not better for it."""

_ROUNDS = 8
_OUTLIER = 2.0  # of the residual's spread
_CYCLES = np.arange(0.4, 8.0, 0.05)  # of a swing, over the whole sequence
_FEWEST_PER_CYCLE = 4.0  # frames
_FINER = np.linspace(-0.05, 0.05, 21)
_FRAMES = 400  # as many tell the frequency of a swing
_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """A function of time fitted to the angles of a turn.

    Attributes
    ----------
    name : str
        Of the kind of turn.
    angles : ndarray of shape (T,)
        Radians.
    parameters : int
        Beyond the two of a constant velocity.
    """

    name: str
    angles: NDArray[np.float64]
    parameters: int


def score(unexplained: float, parameters: int) -> float:
    """Return an information criterion of a mean square: what has the lowest is most likely."""
    return math.log(unexplained + FLOOR**2) + COST_OF_A_PARAMETER * parameters


def fit_paces(angles: NDArray[np.float64]) -> list[Pace]:
    """Fit a changing velocity, an easing in and out, and swings to angles (T,)."""
    time = np.linspace(-1.0, 1.0, len(angles), dtype=np.float64)
    return [
        Pace("accelerated", robust_fit(polynomials(time, 2), angles), 1),
        Pace("eased", robust_fit(polynomials(time, 3), angles), 2),
        Pace("swinging", fit_swing(time, angles, 0), 2),
        Pace("swinging", fit_swing(time, angles, 1), 3),
    ]


def polynomials(time: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the Legendre polynomials (T, degree + 1) at times within -1 and 1."""
    return np.asarray(legvander(time, degree), np.float64)


def robust_fit(basis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return combinations of basis functions that are nearest to values by Huber's loss.

    Parameters
    ----------
    basis : ndarray of shape (..., T, k)
        One or several sets of functions.
    values : ndarray of shape (T,)

    Returns
    -------
    ndarray of shape (..., T)
    """
    weights = np.ones(basis.shape[:-1])
    fitted = values
    for _ in range(_ROUNDS):
        fitted = _nearest(basis, values, weights)
        off = np.abs(values - fitted)
        spread = 1.4826 * np.median(off, axis=-1, keepdims=True)
        weights = 1.0 / np.maximum(1.0, off / np.maximum(_OUTLIER * spread, np.finfo(float).tiny))
    return fitted


def _nearest(
    basis: NDArray[np.float64], values: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weighted least-squares fits (..., T), by normal equations: k is small."""
    weighted = np.swapaxes(basis * weights[..., None], -1, -2)
    gram = weighted @ basis
    ridge = _EPS * np.trace(gram, axis1=-2, axis2=-1)[..., None, None] * np.eye(basis.shape[-1])
    fitted: NDArray[np.float64] = (
        basis @ np.linalg.solve(gram + ridge, (weighted @ values)[..., None])
    )[..., 0]
    return fitted


def fit_swing(
    time: NDArray[np.float64], angles: NDArray[np.float64], degree: int
) -> NDArray[np.float64]:
    """Fit a sine, of the best frequency, on top of a polynomial to angles (T,)."""

    def bases(time: NDArray[np.float64], cycles: NDArray[np.float64]) -> NDArray[np.float64]:
        phases = np.pi * cycles[:, None] * time
        straight = np.broadcast_to(polynomials(time, degree), (*phases.shape, degree + 1))
        waves = np.stack([np.sin(phases), np.cos(phases)], axis=-1)
        return np.concatenate([straight, waves], axis=-1)

    step = -(-len(angles) // _FRAMES)
    some_time, some = time[::step], angles[::step]
    cycles = _CYCLES[max(_CYCLES[0], len(angles) / _FEWEST_PER_CYCLE) >= _CYCLES]
    tried = bases(some_time, cycles)
    rest = ((some - _nearest(tried, some, np.ones(tried.shape[:-1]))) ** 2).sum(axis=-1)
    cycles = cycles[rest.argmin()] + _FINER
    rest = np.abs(some - robust_fit(bases(some_time, cycles), some)).sum(axis=-1)
    return robust_fit(bases(time, cycles[rest.argmin()][None])[0], angles)
