"""Distances between points that keep.

Limbs turn but hardly stretch, and so do patches of cloth and skin. Such motion is not simple: the
covariance of a turning limb says nothing about its length. But its length says how it is
foreshortened,

    (z_ti - z_tj)^2 = l_ij^2 - |w_ti - w_tj|^2        (z depth, w in the image),

in whatever frame, whether the camera turned or the object. Which pairs of points keep their
distance is learnt from the shapes found so far: their lengths vary little, both beside the size of
the object and beside how the pair itself moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr.rotations import depths_along

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_POINTS = 64
"""Points whose distances are looked at."""

_MOST_SQUARES = 1_000_000  # frames times pairs
_WEIGHT = 2.0
_STEADY = 0.1  # standard deviation of a length as a part of the size
_STEADY_BY_MOTION = 0.3  # and as a part of that of the difference of the two points
_FLOOR = 0.005  # of the size


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What is known of the depths of each frame beside their prior, as a quadratic.

    Attributes
    ----------
    precision : ndarray of shape (T, q, q)
        Of the depths of each frame.
    force : ndarray of shape (T, q)
        Precision times the depths that are likeliest by this alone.
    support : float
        How far points have a distance to another one that keeps, 0 to 1: the mean over the points
        of the most that one of their lengths is trusted.
    """

    precision: NDArray[np.float64]
    force: NDArray[np.float64]
    support: float


class Lengths:
    """Distances between some points in all frames, as functions of the depths.

    A squared length is taken for normally distributed about its mean, with the variance that it
    has at present. As pairs are not independent, those of a point count together as two. Sizes are
    relative to the root mean square of the coordinates of the points.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, n)
        S of the points to start from.
    directions : ndarray of shape (q, n)
        The points in terms of what the depths are asked for.
    axis : ndarray of shape (T, 3)
        Viewing directions. They tell how a pair moves in the object's frame; its lengths do not
        depend on them, so cameras may turn a little afterwards.
    depths : ndarray of shape (T, q)
        That belong to the shapes. Depth of the points that these do not explain stays.
    noise : float
        Standard deviation of the noise of the tracks, as a part of their spread.
    weight : float
        Of all lengths.
    """

    def __init__(
        self,
        shapes: NDArray[np.float64],
        directions: NDArray[np.float64],
        axis: NDArray[np.float64],
        depths: NDArray[np.float64],
        *,
        noise: float = 0.0,
        weight: float = 1.0,
    ) -> None:
        points = shapes.shape[2]
        self._first, self._second = np.triu_indices(points, 1)
        self._directions = directions
        self._axis = axis
        present = depths_along(axis, shapes)
        self._rest = present - depths @ directions
        planar = shapes - axis[:, :, None] * present[:, None]
        self._mean_planar = planar.mean(axis=0)
        products = np.matmul(planar.transpose(0, 2, 1), planar)
        squares = np.einsum("tnn->tn", products)
        seen = squares[:, :, None] + squares[:, None, :] - 2.0 * products
        self._seen = np.maximum(seen[:, self._first, self._second], 0.0)
        self._differences = self._apart(directions)
        self._size = float((shapes**2).mean())
        self._least = (_FLOOR**2 + noise**2) * self._size
        self._weight = _WEIGHT * weight / points

    def _apart(self, of_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return differences (..., pairs) of what belongs to points (..., n)."""
        # Much faster than by an index.
        first, second = (
            np.take(of_points, which, axis=-1) for which in (self._first, self._second)
        )
        difference: NDArray[np.float64] = first - second
        return difference

    def evidence(self, depths: NDArray[np.float64]) -> Evidence:
        """Return what the lengths say of the depths, near given ones (T, q).

        The squared lengths are linearised (Gauss, Newton). The curvature that this leaves out
        counts by its size: steps stay short where a pair lies in the image plane.
        """
        z = self._rest + depths @ self._directions
        apart = self._apart(z)
        squares = self._seen + apart**2
        level = squares.mean(axis=0)
        squares -= level
        mean = self._mean_planar + self._axis.T @ z / len(z)
        motion = level - (self._apart(mean) ** 2).sum(axis=0)
        tiny = 1e-12 * self._size
        level = np.maximum(level, tiny)
        variance = np.einsum("tm,tm->m", squares, squares) / (4.0 * len(squares) * level)
        trust = _biweight(variance / (_STEADY**2 * self._size))
        trust *= _biweight(variance / (_STEADY_BY_MOTION**2 * np.maximum(motion, tiny)))
        trust[level <= self._least] = 0.0  # points that coincide keep nothing
        of_points = np.zeros(z.shape[1])
        np.maximum.at(of_points, self._first, trust)
        np.maximum.at(of_points, self._second, trust)
        kept = np.flatnonzero(trust)
        weights = self._weight * trust[kept] / ((variance[kept] + self._least) * 4.0 * level[kept])
        squares, slopes = np.take(squares, kept, axis=1), 2.0 * np.take(apart, kept, axis=1)
        curvature = weights * (slopes**2 + 2.0 * np.abs(squares))
        differences = self._differences[:, kept]
        q = len(differences)
        rows, columns = np.triu_indices(q)
        triangle = curvature @ (differences[rows] * differences[columns]).T
        precision = np.empty((len(z), q, q))
        precision[:, rows, columns] = triangle
        precision[:, columns, rows] = triangle
        force = np.matmul(precision, depths[:, :, None])[:, :, 0]
        force -= (weights * slopes * squares) @ differences.T
        return Evidence(precision, force, float(of_points.mean()))


def _biweight(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 1 for 0, 0 from 1 on, and smoothly less between them (Tukey)."""
    weights: NDArray[np.float64] = np.maximum(1.0 - values, 0.0) ** 2
    return weights


def chosen_points(trajectories: NDArray[np.float64], most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Return numbers of some points, all where they are few.

    They are taken evenly from all, sorted by their distance from the mean, so that the order of the
    points does not matter.

    Parameters
    ----------
    trajectories : ndarray of shape (2T, n)
        Of points, less the mean.
    most : int
        Fewer are taken of long sequences.
    """
    frames, points = len(trajectories) // 2, trajectories.shape[1]
    affordable = int((1.0 + np.sqrt(1.0 + 8.0 * _MOST_SQUARES / frames)) / 2.0)
    count = min(points, most, affordable)
    squares = np.einsum("tn,tn->n", trajectories, trajectories)
    order = np.argsort(squares, kind="stable")
    return np.sort(order[np.linspace(0, points - 1, count).astype(np.intp)])
