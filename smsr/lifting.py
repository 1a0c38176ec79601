"""From the solution on a few virtual points to the shapes of all points.

Every stage of the solver acts on the measurement matrix from the left, so what it did is one
linear map ``S = A (W - mean)`` with A (3T x 2T). A is kept as a product of thin factors: applying
it costs O(T q) per point instead of O(T^2), and A itself is never formed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Lifting:
    """The linear map from centred measurements to shapes, ``S = B (C W) + R^T W``.

    Attributes
    ----------
    outer : ndarray of shape (T, 3, q)
        B.
    inner : ndarray of shape (q, 2T)
        C.
    cameras : ndarray of shape (T, 2, 3) or None
        R of the second term, over the scale of the camera; None where the map has no such term.
    """

    outer: NDArray[np.float64]
    inner: NDArray[np.float64]
    cameras: NDArray[np.float64] | None

    @property
    def frames(self) -> int:
        """T."""
        return len(self.outer)

    def apply(self, measurements: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shapes (T, 3, n) of centred measurements (2T, n)."""
        frames = self.frames
        inside = self.inner @ measurements
        shapes = (self.outer.reshape(3 * frames, -1) @ inside).reshape(frames, 3, -1)
        if self.cameras is not None:
            shapes += self.cameras.transpose(0, 2, 1) @ measurements.reshape(frames, 2, -1)
        return shapes

    def after_division(self, scales: NDArray[np.float64]) -> Lifting:
        """Return the map that divides each frame of the measurements by its scale (T,) first."""
        return Lifting(
            outer=self.outer,
            inner=self.inner / np.repeat(scales, 2),
            cameras=None if self.cameras is None else self.cameras / scales[:, None, None],
        )

    def matrix(self) -> NDArray[np.float64]:
        """Return A (3T, 2T) itself, for small T."""
        return self.apply(np.eye(2 * self.frames)).reshape(3 * self.frames, -1)


def exact_lifting(
    shapes: NDArray[np.float64],
    cameras: NDArray[np.float64],
    left: NDArray[np.float64],
    values: NDArray[np.float64],
) -> Lifting:
    """Return the map that takes the virtual points to their shapes and keeps W = R S exact.

    With P = U U^T the projector on the retained directions,
    ``S = S_q Sigma^-1 U^T W + R^+ (I - P) W``: the rest of the measurements, orthogonal to all
    virtual points, is reconstructed with zero depth.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, q)
        S_q, shapes of the virtual points ``U Sigma``.
    cameras : ndarray of shape (T, 2, 3)
        R.
    left : ndarray of shape (2T, q)
        U, orthonormal columns.
    values : ndarray of shape (q,)
        Sigma > 0.
    """
    frames = len(cameras)
    planar = cameras.transpose(0, 2, 1) @ left.reshape(frames, 2, -1)
    return Lifting(outer=shapes / values - planar, inner=left.T, cameras=cameras)


def smoothed_lifting(
    shapes: NDArray[np.float64],
    cameras: NDArray[np.float64],
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    basis: NDArray[np.float64],
) -> Lifting:
    """Return the map for measurements smoothed by ``W* = H H^T W``: W* = R S exactly.

    ``S = S_q Sigma^-1 U^T W + R^+ H H^T (I - P) W``.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, q)
        S_q, shapes of the virtual points ``H H^T U Sigma``.
    cameras, left, values
        As for `exact_lifting`.
    basis : ndarray of shape (2T, k)
        H, orthonormal columns that span the smooth motion.
    """
    frames = len(cameras)
    planar = cameras.transpose(0, 2, 1) @ basis.reshape(frames, 2, -1)
    rest = basis.T - (basis.T @ left) @ left.T
    return Lifting(
        outer=np.concatenate([shapes / values, planar], axis=2),
        inner=np.concatenate([left.T, rest]),
        cameras=None,
    )


def denoised_lifting(shapes: NDArray[np.float64], coordinates: NDArray[np.float64]) -> Lifting:
    """Return the map for measurements less their noise, ``S = S_q C W``.

    What of the measurements no virtual point stands for is noise and is left out.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, q)
        S_q, shapes of the virtual points.
    coordinates : ndarray of shape (q, 2T)
        C of `smsr.noise.VirtualPoints`.
    """
    return Lifting(outer=shapes, inner=coordinates, cameras=None)
