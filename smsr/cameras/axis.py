"""Cameras that turn about one axis, in whatever way: turntables, orbits, pendulums.

The drift of free cameras has three directions. Where the camera keeps to an axis, two of them are
known to be drift; what is left of the third is told apart by `smsr.cameras.paces`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from smsr import rotations as so3
from smsr.cameras.turn import Turn, steady_turn

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OUTLIER = 0.2  # radians; frames that are tilted more count less
_ROUNDS = 10
_SMOOTHING = 2.0  # frames; the shake of a camera is not its tilt
_LEAST_TURN = math.radians(8.0)  # the drift of free cameras may be as large
_MOST_TILT = 0.25  # of the turn
_NOTABLE_TILT = math.radians(4.5)


@dataclass(frozen=True, slots=True, eq=False)
class AxisFit:
    """A turn about one axis that follows cameras as closely as it can.

    Attributes
    ----------
    axis : ndarray of shape (3,)
        Unit vector in the camera frame.
    start : ndarray of shape (3, 3)
        The camera where the angle is zero.
    angles : ndarray of shape (T,)
        Radians, without jumps.
    tilt : ndarray of shape (T, 3)
        Rotation vectors, in the camera frame, from the turn to the cameras.
    """

    axis: NDArray[np.float64]
    start: NDArray[np.float64]
    angles: NDArray[np.float64]
    tilt: NDArray[np.float64]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """The turn's cameras (T, 3, 3)."""
        return steady_turn(self.angles, self.axis, self.start).steady

    def turn(self, angles: NDArray[np.float64] | None = None) -> Turn:
        """Return the turn, or one by other angles (T,) about the same axis."""
        angles = self.angles if angles is None else angles
        steps = np.diff(angles)
        speed = max(float(np.sqrt((steps**2).mean())), np.finfo(float).tiny)
        return steady_turn(angles / speed, self.axis * speed, self.start)

    def is_followed(self) -> bool:
        """Tell whether there is a turn, and its tilt may be drift: small, or the object's own.

        What the object does by itself lies along few directions as the object sees them, what the
        camera does, as the camera sees them.
        """
        tilt = smooth_tilt(self.tilt)
        mean_square, turned_square = float((tilt**2).sum(axis=1).mean()), float(self.angles.var())
        if turned_square < _LEAST_TURN**2 or mean_square > _MOST_TILT**2 * turned_square:
            return False
        if mean_square < _NOTABLE_TILT**2:
            return True
        of_object = np.einsum("tji,tj->ti", self.rotations, tilt)
        return _anisotropy(tilt) < _anisotropy(of_object - of_object.mean(axis=0))


def smooth_tilt(tilt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a tilt (T, 3) without the shake from frame to frame."""
    return np.asarray(gaussian_filter1d(tilt, _SMOOTHING, axis=0))


def _anisotropy(vectors: NDArray[np.float64]) -> float:
    """Return how far vectors (T, 3) lie along one direction: 0.5 for a plane, 1 for a line."""
    values = np.linalg.eigvalsh(vectors.T @ vectors)
    return float(values[2] / max(values[2] + values[1], np.finfo(float).tiny))


def fit_axis(rotations: NDArray[np.float64]) -> AxisFit:
    """Fit a turn about one axis to cameras.

    The camera sees the axis of its turn in one and the same direction: with b the axis in the
    object frame, all ``G_t b`` are a. Leading singular vectors of the mean of G are that pair.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    weights = np.ones(len(rotations))
    for _ in range(_ROUNDS):
        mean = np.einsum("t,tij->ij", weights, rotations) / weights.sum()
        left, _, right = np.linalg.svd(mean)
        axis, in_object = left[:, 0], right[0]
        cosines = np.clip(rotations @ in_object @ axis, -1.0, 1.0)
        weights = 1.0 / np.maximum(1.0, np.arccos(cosines) / _OUTLIER)
    start = _frame_about(axis) @ _frame_about(in_object).T
    relative = rotations @ start.T
    sines = np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    along = np.einsum("i,tij,j->t", axis, relative, axis)
    cosines = np.trace(relative, axis1=1, axis2=2) - along
    angles = np.unwrap(np.arctan2(sines @ axis, cosines))
    turned = steady_turn(angles, axis, start).steady
    return AxisFit(axis, start, angles, so3.log(rotations @ turned.transpose(0, 2, 1)))


def _frame_about(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation (3, 3) whose third column is a unit vector."""
    other = np.eye(3)[np.abs(direction).argmin()]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first), direction], axis=1)
