"""The frame in which most of an object rests.

Free cameras turn with the object as a whole, for its shapes are simplest then. But feet stand on
the ground, a skull does not move with its mouth: where some points hardly move, they tell a frame
that is nearer to that of the world than the one in which all points move least.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.shapes.credibility import faded

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_ROUNDS = 60
_SETTLED = 1e-4  # change of the mean shape in a round, by its size
_NEAR = 0.02  # of the object's size; what moves less is at rest
_QUIET_PART = 0.1  # of the points
_RESTING = (0.16, 0.22)
_LINE = 1e-3  # second singular value over the first of a mean shape that can be turned about itself


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """How to turn the shape of each frame, so that the points that can rest do.

    Attributes
    ----------
    turns : ndarray of shape (T, 3, 3)
        Q; the shapes at rest are ``Q_t S_t``.
    unrest : float
        How far the quietest tenth of the points moves, relative to all; 1 for points on a line.
    """

    turns: NDArray[np.float64]
    unrest: float

    @property
    def trust(self) -> float:
        """How much of the turns to apply, 0 to 1: all where points rest, nothing where none do."""
        return faded(self.unrest, _RESTING)


def resting_frame(shapes: NDArray[np.float64]) -> Rest:
    """Align the shapes of all frames to a mean shape, by the points that move least.

    A generalised Procrustes analysis (Gower 1975) of rotations and translations that minimises
    ``sum_t sum_n ||Q_t s_tn + c_t - m_n||^(1/2)`` by iteratively reweighted least squares. Small
    distances weigh most, so the points at rest, if there are any, decide.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, N)
        S.
    """
    size = float(np.linalg.norm(shapes, axis=1).mean())
    near = max((_NEAR * size) ** 2, np.finfo(float).tiny)
    turned = shapes
    weights = np.ones((len(shapes), 1, shapes.shape[2]))
    mean = np.zeros_like(shapes[0])
    for _ in range(_MOST_ROUNDS):
        before, mean = mean, (weights * turned).sum(axis=0) / weights.sum(axis=0)
        total = weights.sum(axis=2, keepdims=True)
        centre = (weights * shapes).sum(axis=2, keepdims=True) / total
        centre_of_mean = (weights * mean).sum(axis=2, keepdims=True) / total
        moments = (weights * (mean - centre_of_mean)) @ (shapes - centre).transpose(0, 2, 1)
        turns = so3.nearest_rotations(moments)
        turned = turns @ (shapes - centre) + centre_of_mean
        squares = ((turned - mean) ** 2).sum(axis=1, keepdims=True)
        roots = np.sqrt(squares + near)
        weights = 1.0 / (roots * np.sqrt(roots))  # distance^(1/2 - 2), by roots many times faster
        weights /= weights.mean()
        if np.linalg.norm(mean - before) <= _SETTLED * np.linalg.norm(mean):
            break
    spread = np.linalg.svd(mean - mean.mean(axis=1, keepdims=True), compute_uv=False)
    if spread[1] <= _LINE * spread[0]:
        return Rest(turns, 1.0)
    moved = np.sqrt(squares.mean(axis=(0, 1)))
    overall = max(float(np.sqrt((moved**2).mean())), np.finfo(float).tiny)
    return Rest(turns, float(np.quantile(moved, _QUIET_PART)) / overall)
