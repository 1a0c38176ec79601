"""A camera path that is adjusted to where the tracks are likelier.

Which path the free cameras follow shows well, how fast it goes less so: an object that turns a
little as a whole, from the first frame to the last, adds its turn to the camera's. Simplicity of
the shapes cannot tell the two apart, but a model of the deformation can, for its likelihood counts
small motions as much as large ones. What may change is given as a few fields of rotation vectors.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

SETTLED = math.radians(0.1)
"""A step that is no longer than this is none."""

_SPREAD = math.radians(1.0)  # standard deviation of a change, before anything is known
_CURVATURE = 0.1  # of the log-likelihood of a frame at first, per degree^2
_LEAST_CURVATURE, _MOST_CURVATURE = 0.01, 100.0
_TELLING = math.radians(0.02)  # a step that is shorter says nothing of the curvature
_LONGEST_STEP = math.radians(1.0)
_FARTHEST = math.radians(6.0)


class Adjustment:
    """How far cameras went along each of some fields, and the next step.

    Steps go up the gradient of the log-likelihood, less that of a normal prior, with the curvature
    that the last step showed (Barzilai, Borwein 1988). That the model is learnt anew between steps
    does not count, to first order, as long as it is near the likeliest.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    fields : ndarray of shape (k, T, 3)
        Rotation vectors, in the camera frame, by which a change of one radian turns the cameras;
        about a radian long where they are longest.
    """

    def __init__(self, rotations: NDArray[np.float64], fields: NDArray[np.float64]) -> None:
        self._start = rotations
        self._fields = fields
        self.change = np.zeros(len(fields))
        self._curvature = _per_radian(_CURVATURE)
        self._last: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def rotations(self, part: float = 1.0) -> NDArray[np.float64]:
        """Return the cameras (T, 3, 3) after a part of the change."""
        turns = np.tensordot(part * self.change, self._fields, axes=1)
        turned: NDArray[np.float64] = so3.exp(turns) @ self._start
        return turned

    def step(self, force: NDArray[np.float64]) -> float:
        """Go one step; return its length in radians.

        Parameters
        ----------
        force : ndarray of shape (T, 3)
            Gradient of the log-likelihood by turns of the cameras as they are, in their frames.
        """
        frames = len(force)
        gradient = -np.tensordot(self._fields, force, axes=2) / frames
        if self._last is not None:
            moved, bent = self.change - self._last[0], gradient - self._last[1]
            # Of a short step the gradient tells less than of what was learnt meanwhile.
            if np.linalg.norm(moved) > _TELLING and (rise := float(moved @ bent)) > 0.0:
                low, high = _per_radian(_LEAST_CURVATURE), _per_radian(_MOST_CURVATURE)
                self._curvature = min(max(rise / float(moved @ moved), low), high)
        self._last = self.change, gradient
        prior = 1.0 / (frames * _SPREAD**2)
        step = -(gradient + prior * self.change) / (self._curvature + prior)
        length = float(np.linalg.norm(step))
        step *= min(1.0, _LONGEST_STEP / max(length, np.finfo(float).tiny))
        self.change = np.clip(self.change + step, -_FARTHEST, _FARTHEST)
        return float(np.linalg.norm(self.change - self._last[0]))


def _per_radian(per_degree: float) -> float:
    return per_degree * math.degrees(1.0) ** 2
