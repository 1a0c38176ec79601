"""What every way of finding the cameras returns."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

STILL = math.radians(3.0)
"""Cameras whose viewing directions spread less than this stand still."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """Cameras of all frames, in any object frame.

    Attributes
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    model : str
        How they were found: 'relaxed', 'flat', 'shaken', 'uniform', 'switched', 'accelerated',
        'eased', 'swinging', 'axis', 'gimbal', 'rigid' or 'paper'.
    basis_size : int
        K, the number of column triplets of the corrective matrix.
    iterations : int
        Of the solver.
    converged : bool
        Whether it met its tolerance.
    reason : str
        Why it stopped and why this model was taken, for a person.
    residuals : tuple of float
        Stopping residual at each iteration.
    criteria : mapping
        Numbers that the choice was based on, see `smsr.cameras.free` and
        `smsr.cameras.selection`.
    flat : bool
        Whether the mean shape is flat, see `smsr.cameras.flat`.
    coherent : bool
        Whether a simple path of the camera made the object move no more.
    simpler : ndarray of shape (T, 3, 3), optional
        The free cameras, where `rotations` follow a path or a resting frame instead. They turn with
        the object, so its shapes are simpler to them.
    simpler_share : float
        How much of the depths that they see is to be taken, 0 to 1.
    adjustable : ndarray of shape (k, T, 3), optional
        What of a path is not sure, see `smsr.shapes.adjustment`: rotation vectors in the
        frame of each camera, by which it turns where the velocity changes by one radian over the
        range of the turn. The middle camera stays.
    """

    rotations: NDArray[np.float64]
    model: str
    basis_size: int
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...] = ()
    criteria: Mapping[str, float] = field(default_factory=dict)
    flat: bool = False
    coherent: bool = False
    simpler: NDArray[np.float64] | None = None
    simpler_share: float = 0.0
    adjustable: NDArray[np.float64] | None = None


def scaled_motion(
    left: NDArray[np.float64], values: NDArray[np.float64], rank: int
) -> NDArray[np.float64]:
    """Return M' (2T, rank) = U Sigma^(1/2), scaled so that a rigid object has F near the identity.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the measurements, rank <= r.
    values : ndarray of shape (r,)
        Singular values, largest first.
    rank : int
        Columns to keep.
    """
    motion = left[:, :rank] * np.sqrt(values[:rank])
    scale = np.sqrt((motion[:, :3] ** 2).sum() / len(motion))
    scaled: NDArray[np.float64] = motion / scale
    return scaled


def corrective_matrix(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Q (n, 3) of F = Q Q^T (n, n), of the three leading eigenvectors; (n, n) for n < 3."""
    values, vectors = np.linalg.eigh(F)
    Q: NDArray[np.float64] = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 1e-12))
    return Q


def cameras_from_factor(motion: NDArray[np.float64], F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations (T, 3, 3) from F = Q Q^T: the cameras nearest to M' Q.

    Parameters
    ----------
    motion : ndarray of shape (2T, n)
        M'.
    F : ndarray of shape (n, n)
        Semi-definite; Q is made of its three leading eigenvectors.
    """
    Q = corrective_matrix(F)
    rows = np.zeros((len(motion), 3))
    rows[:, -Q.shape[1] :] = motion @ Q
    return so3.complete(so3.nearest_cameras(rows.reshape(-1, 2, 3)))


def usable_rank(values: NDArray[np.float64], limit: int) -> int:
    """Return how many singular directions carry signal: a multiple of 3 where there are 3.

    Parameters
    ----------
    values : ndarray of shape (r,)
        Singular values, largest first.
    limit : int
        Upper bound, a multiple of 3.
    """
    rank = min(limit, int((values > 1e-9 * values[0]).sum()))
    return rank - rank % 3 if rank > 3 else rank
