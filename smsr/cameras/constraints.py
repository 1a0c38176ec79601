"""Orthonormality of the cameras as a quadratic form that does not depend on the frames.

With ``M'_t`` the two rows (m_u, m_v) of the scaled left singular vectors at frame t and F = Q Q^T,
the rows of ``M'_t Q`` are orthonormal up to scale exactly if

    m_u F m_u^T = m_v F m_v^T    and    m_u F m_v^T = 0                     (paper, Eqs. 5 to 8),

linear in F. F is symmetric, so it is described by n (n + 1) / 2 coordinates, off-diagonal entries
times sqrt(2), which keeps inner products: <F, G> = svec(F) . svec(G). All constraints of all
frames are then one matrix ``A^T A`` of that size, built once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@lru_cache(maxsize=32)
def _upper_triangle(
    n: int,
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Return rows, columns and weights of the coordinates of symmetric matrices."""
    rows, columns = np.triu_indices(n)
    return rows, columns, np.where(rows == columns, 1.0, math.sqrt(2.0))


def symmetric_vector(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coordinates (..., n (n + 1) / 2) of symmetric matrices (..., n, n)."""
    rows, columns, weights = _upper_triangle(F.shape[-1])
    vector: NDArray[np.float64] = F[..., rows, columns] * weights
    return vector


def symmetric_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric matrix (n, n) of coordinates (n (n + 1) / 2,)."""
    n = (math.isqrt(8 * len(vector) + 1) - 1) // 2
    rows, columns, weights = _upper_triangle(n)
    F = np.zeros((n, n))
    F[rows, columns] = vector / weights
    F[columns, rows] = F[rows, columns]
    return F


@dataclass(frozen=True, slots=True, eq=False)
class OrthonormalityForm:
    """The quadratic ``1/2 f^T H f - b^T f + c/2`` of f = svec(F).

    Attributes
    ----------
    hessian : ndarray of shape (p, p), p = n (n + 1) / 2
        H = A^T A.
    linear : ndarray of shape (p,)
        b, zero for the homogeneous constraints.
    constant : float
        c, the value of ``||A f - a||^2`` at f = 0.
    """

    hessian: NDArray[np.float64]
    linear: NDArray[np.float64]
    constant: float

    def lipschitz(self) -> float:
        """Return the largest eigenvalue of H, the Lipschitz constant of the gradient."""
        return _largest_eigenvalue(self.hessian)

    def gradient(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``H f - b``."""
        gradient: NDArray[np.float64] = self.hessian @ f - self.linear
        return gradient

    def leading(self, n: int) -> OrthonormalityForm:
        """Return the form of the first n columns of the motion matrix."""
        whole = (math.isqrt(8 * len(self.linear) + 1) - 1) // 2
        if n == whole:
            return self
        rows, columns = np.triu_indices(whole)
        inside = np.flatnonzero((rows < n) & (columns < n))
        hessian = np.ascontiguousarray(self.hessian[np.ix_(inside, inside)])
        return OrthonormalityForm(hessian, self.linear[inside], self.constant)

    def residual(self, f: NDArray[np.float64]) -> float:
        """Return ``||A f - a||^2``, at least 0."""
        return max(float(f @ (self.hessian @ f) - 2.0 * self.linear @ f) + self.constant, 0.0)


def frame_products(
    motion: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return svec of m_u m_u^T, m_v m_v^T and the symmetric part of m_u m_v^T, each (T, p).

    Parameters
    ----------
    motion : ndarray of shape (2T, n)
        M', rows u1, v1, u2, ...
    """
    u, v = motion[0::2], motion[1::2]
    uu = symmetric_vector(u[:, :, None] * u[:, None, :])
    vv = symmetric_vector(v[:, :, None] * v[:, None, :])
    cross = u[:, :, None] * v[:, None, :]
    uv = symmetric_vector(0.5 * (cross + cross.transpose(0, 2, 1)))
    return uu, vv, uv


def mean_square_length(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector (p,) whose product with svec(F) is the mean squared row length of M' Q."""
    return symmetric_vector(motion.T @ motion) / len(motion)


_FRAMES_AT_ONCE = 512


Rows: TypeAlias = Literal["unit", "equal", "published"]
"""What is asked of the two rows of a camera, see `orthonormality_form`."""


def orthonormality_form(motion: NDArray[np.float64], *, rows: Rows) -> OrthonormalityForm:
    """Gather the orthonormality constraints of all frames.

    Parameters
    ----------
    motion : ndarray of shape (2T, n)
        M', the scaled left singular vectors of the measurements.
    rows : {"unit", "equal", "published"}
        'unit' asks for unit length, ``m_u F m_u^T = m_v F m_v^T = 1``: one and the same shape
        coefficient in every frame. 'equal' asks for equal length only (paper, Eq. 8), and gives a
        homogeneous form. So does 'published', where a difference of the lengths counts twice as
        much beside the angle: it depends on how the image is rotated.

    Returns
    -------
    OrthonormalityForm
        The squared distance of the Gram matrix of each frame from the identity, or from the nearest
        multiple of it.
    """
    n = motion.shape[1]
    p = n * (n + 1) // 2
    hessian = np.zeros((p, p))
    linear = np.zeros(p)
    constant = 0.0
    for first in range(0, len(motion), 2 * _FRAMES_AT_ONCE):
        uu, vv, uv = frame_products(motion[first : first + 2 * _FRAMES_AT_ONCE])
        hessian += 2.0 * uv.T @ uv
        if rows == "unit":
            hessian += uu.T @ uu + vv.T @ vv
            linear += uu.sum(axis=0) + vv.sum(axis=0)
            constant += 2.0 * len(uu)
        else:
            weight = 0.5 if rows == "equal" else 1.0
            hessian += weight * (uu - vv).T @ (uu - vv)
    return OrthonormalityForm(hessian, linear, constant)


def _largest_eigenvalue(H: NDArray[np.float64]) -> float:
    """Power iteration from a fixed start; 2 % above the estimate, so a safe step length."""
    x = np.ones(len(H)) + np.arange(len(H)) / len(H)
    value = 0.0
    for _ in range(60):
        x = H @ (x / max(float(np.linalg.norm(x)), 1e-300))
        value = float(np.linalg.norm(x))
    return 1.02 * value
