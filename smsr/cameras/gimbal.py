"""Cameras on a gimbal: a turn about an axis of the world, and a nod about one of their own.

Orbits that rise and fall, drones, pan and tilt heads. ``G_t = exp(e_t n) exp(a_t omega) G_0`` with
the axis n of the nod fixed in the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.cameras.axis import fit_axis, smooth_tilt
from smsr.cameras.paces import fit_swing, polynomials, robust_fit, score

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smsr.cameras.axis import AxisFit

_ROUNDS = 8
_OUTLIER = 0.4  # radians


@dataclass(frozen=True, slots=True, eq=False)
class GimbalFit:
    """A nod, and the turn that is left without it.

    Attributes
    ----------
    nod : ndarray of shape (T, 3)
        Rotation vectors e_t n in the camera frame.
    axis : AxisFit
        Of the cameras ``exp(-nod) G``.
    """

    nod: NDArray[np.float64]
    axis: AxisFit


def fit_gimbal(rotations: NDArray[np.float64], axis: AxisFit) -> GimbalFit:
    """Fit a turn about an axis with a steady or a swinging nod to cameras.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    axis : AxisFit
        The turn that fits them without a nod.
    """
    time = np.linspace(-1.0, 1.0, len(rotations), dtype=np.float64)
    functions: tuple[tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], int], ...] = (
        (lambda angles: robust_fit(polynomials(time, 1), angles), 3),
        (lambda angles: fit_swing(time, angles, 0), 5),
        (lambda angles: fit_swing(time, angles, 1), 6),
    )
    found = [(_fit(rotations, axis, function), number) for function, number in functions]
    best, _ = min(
        found, key=lambda fit: score(float((fit[0].axis.tilt ** 2).sum(axis=1).mean()), fit[1])
    )
    return best


def _fit(
    rotations: NDArray[np.float64],
    axis: AxisFit,
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> GimbalFit:
    """Fit the axis of the world with the nod known, and the nod with the turn known, in turns."""
    for _ in range(_ROUNDS):
        tilt = so3.log(rotations @ axis.rotations.transpose(0, 2, 1))
        smooth = smooth_tilt(tilt)
        weights = 1.0 / np.maximum(1.0, np.linalg.norm(smooth, axis=1) / _OUTLIER)
        about = np.linalg.eigh((smooth * weights[:, None]).T @ smooth)[1][:, 2]
        nod = function(tilt @ about)[:, None] * about
        axis = fit_axis(so3.exp(-nod) @ rotations)
    return GimbalFit(nod, axis)
