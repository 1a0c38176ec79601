"""Procrustes alignment: the orthogonal matrix that carries one point set onto another.

Reflections are allowed everywhere: one orthographic camera cannot tell a shape from its mirror
image in depth. Scale and translation are never fitted; centre the points first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Real = TypeVar("Real", bound="np.floating[Any]")


def orthogonal_factor(cross_moments: NDArray[Real]) -> NDArray[Real]:
    """Return the orthogonal matrices Q that maximise ``trace(Q^T M)``.

    Parameters
    ----------
    cross_moments : ndarray of shape (..., d, d)
        M, the sum over points of ``g x^T`` for corresponding centred points g and x.

    Returns
    -------
    ndarray of shape (..., d, d)
        Q with ``g ~ Q x`` in the least-squares sense; its determinant is 1 or -1. Where M has not
        full rank the best Q is not unique and one of them is returned.
    """
    left, _, right = np.linalg.svd(cross_moments)
    factor: NDArray[Real] = left @ right
    return factor


def procrustes(source: NDArray[Real], target: NDArray[Real]) -> NDArray[Real]:
    """Return the orthogonal matrix that carries `source` best onto `target`.

    Parameters
    ----------
    source, target : ndarray of shape (..., N, d)
        Corresponding points, centred. Leading axes are separate problems, so (T, N, 3) arrays give
        one alignment for each frame.

    Returns
    -------
    ndarray of shape (..., d, d)
        Q minimising ``||target - source @ Q^T||_F``, reflections allowed (Schönemann 1966).
    """
    return orthogonal_factor(np.swapaxes(target, -1, -2) @ source)


def procrustes_sequence(source: NDArray[Real], target: NDArray[Real]) -> NDArray[Real]:
    """Return the one orthogonal matrix that aligns a whole sequence.

    Parameters
    ----------
    source, target : ndarray of shape (T, N, d)
        Corresponding points, centred in each frame.

    Returns
    -------
    ndarray of shape (d, d)
        Q minimising the sum over frames of ``||target_t - source_t @ Q^T||_F^2``.
    """
    moments: NDArray[Real] = np.einsum("tni,tnj->ij", target, source)
    return orthogonal_factor(moments)
