"""Proximal operators of the spectral penalties that the solver minimises.

Each function returns ``argmin_X  penalty(X) + 1/2 ||X - Y||_F^2``. Products with the Gram matrix
of the smaller side take the place of a full singular value decomposition: it is several times
faster for the long thin matrices met here, and singular values below the square root of the
machine precision, which it loses, are set to zero by any useful threshold anyway.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import eigh

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def singular_value_threshold(
    Y: NDArray[np.float64], threshold: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shrink the singular values of a matrix, the proximal operator of the nuclear norm.

    Parameters
    ----------
    Y : ndarray of shape (m, n)
        Any real matrix.
    threshold : float or array_like of shape (min(m, n),)
        Amount taken off each singular value, largest singular value first. A vector gives the
        weighted nuclear norm ``sum_i threshold_i sigma_i(X)``; its proximal operator is this
        shrinkage where the thresholds do not decrease along the vector.

    Returns
    -------
    X : ndarray of shape (m, n)
        ``U max(Sigma - threshold, 0) V^T``.
    singular_values : ndarray of shape (min(m, n),)
        Of `X`, largest first.
    """
    wide = Y.shape[0] <= Y.shape[1]
    gram = Y @ Y.T if wide else Y.T @ Y
    # For matrices of this size numpy's wrapper of the same routine costs a tenth less than SciPy's.
    squares, vectors = np.linalg.eigh(gram)
    values = np.sqrt(np.maximum(squares[::-1], 0.0))
    vectors = vectors[:, ::-1]
    shrunk = np.maximum(values - threshold, 0.0)
    kept = shrunk > 0.0
    vectors = vectors[:, kept]
    left = vectors * (shrunk[kept] / values[kept])
    X = left @ (vectors.T @ Y) if wide else (Y @ left) @ vectors.T
    return X, shrunk


def singular_values(Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the singular values of a matrix, largest first, from its smaller Gram matrix."""
    gram = Y @ Y.T if Y.shape[0] <= Y.shape[1] else Y.T @ Y
    squares = np.linalg.eigvalsh(gram)
    values: NDArray[np.float64] = np.sqrt(np.maximum(squares[::-1], 0.0))
    return values


def eigenvalue_threshold(F: NDArray[np.float64], threshold: float) -> NDArray[np.float64]:
    """Shrink eigenvalues and drop the negative ones: trace penalty on the semi-definite cone.

    Parameters
    ----------
    F : ndarray of shape (n, n)
        Symmetric matrix.
    threshold : float
        Weight of the trace, 0 for the plain projection onto the cone.

    Returns
    -------
    ndarray of shape (n, n)
        The minimiser of ``threshold tr(X) + 1/2 ||X - F||_F^2`` over X >= 0.
    """
    values, vectors = np.linalg.eigh(F)
    kept = values > threshold
    vectors = vectors[:, kept]
    shrunk: NDArray[np.float64] = (vectors * (values[kept] - threshold)) @ vectors.T
    return shrunk


def nearest_semidefinite(F: NDArray[np.float64], rank: int) -> NDArray[np.float64]:
    """Return the semi-definite matrix of at most the given rank nearest to a symmetric matrix.

    Parameters
    ----------
    F : ndarray of shape (n, n)
        Symmetric matrix.
    rank : int
        Largest rank of the result.
    """
    n = len(F)
    values, vectors = eigh(F, subset_by_index=(max(n - rank, 0), n - 1), check_finite=False)
    nearest: NDArray[np.float64] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return nearest
