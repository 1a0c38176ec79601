"""Triangular factors of many points, made block by block and joined.

A tall-skinny QR (Demmel, Grigori, Hoemmen, Langou: Communication-optimal parallel and sequential
QR and LU factorizations, SIAM J. Sci. Comput. 34(1), 2012) of the points about their mean, in one
pass: each block is centred on its own mean, and joining two sets accounts for the distance of
their means.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy.linalg.lapack import dgeqrf, dgeqrf_lwork

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

_EPS = float(np.finfo(np.float64).eps)
_CACHE_ENTRIES = 48 * 1024  # in a core's second-level cache
_PRODUCT_ENTRIES = 128 * 1024  # enough for matrix products to run at full speed
_MANY = 64  # times as many points as rows make a sample worthwhile
_WELL_CONDITIONED = 1e6  # a singular value keeps ten digits at the least


class NotUsableError(Exception):
    """A block holds entries that are not finite, or that overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangle:
    """What stays of a set of points.

    Attributes
    ----------
    count : int
        How many points they are.
    mean : ndarray of shape (2T,)
        Their mean, relative to the shift that all sets share.
    rows : ndarray of shape (k, 2T)
        Few rows with the Gram matrix of the points about their mean: those points themselves
        where they are few, otherwise the triangular factor or any other.
    sample : ndarray of shape (2T, s)
        Some of the points themselves, relative to the shift, in their order.
    """

    count: int
    mean: NDArray[np.float64]
    rows: NDArray[np.float64]
    sample: NDArray[np.float64]


def within(points: slice, sampled: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return where in a block of points those of a sample stand, both in their order."""
    first, last = np.searchsorted(sampled, [points.start, points.stop])
    inside: NDArray[np.intp] = sampled[first:last] - points.start
    return inside


def triangle_of(
    points: slice,
    block: NDArray[Any],
    *,
    shift: NDArray[np.float64],
    sampled: NDArray[np.intp],
) -> Triangle:
    """Reduce a block of points.

    Parameters
    ----------
    points : slice
        The numbers of the points.
    block : ndarray of shape (2T, n)
        Of any real type; converted to double precision part by part.
    shift : ndarray of shape (2T,)
        What the coordinates are taken relative to.
    sampled : ndarray of int
        Numbers of the points, in their order, that are kept as they are, too.

    Raises
    ------
    NotUsableError
        NaN or infinity in the block, or overflow.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        triangle = None
        if block.shape[1] >= _MANY * block.shape[0]:
            triangle = _triangle_by_whitening(block, shift)
        if triangle is None:
            triangle = _triangle_by_householder(block, shift)
        return dataclasses.replace(
            triangle,
            sample=block[:, within(points, sampled)].astype(np.float64) - shift[:, None],
        )


def _triangle_by_householder(block: NDArray[Any], shift: NDArray[np.float64]) -> Triangle:
    """Reduce a block by QR factorisations of parts that stay in cache."""
    width, count = block.shape
    step = max(12 * width, _CACHE_ENTRIES // width)
    buffer = np.empty((width, min(step, count)))
    parts = []
    for start in range(0, count, step):
        columns = block[:, start : start + step]
        centred = buffer[:, : columns.shape[1]]
        np.subtract(columns, shift[:, None], out=centred)
        mean = _finite(centred.mean(axis=1))
        centred -= mean[:, None]
        parts.append(Triangle(columns.shape[1], mean, _reduced(centred.T), buffer[:, :0]))
    return merged(parts)


def _triangle_by_whitening(block: NDArray[Any], shift: NDArray[np.float64]) -> Triangle | None:
    """Reduce a block by matrix products alone, which run several times as fast as a QR.

    A sample of the points gives axes V and scales D on which all points have nearly unit
    covariance. Their Gram matrix on these axes is well conditioned, so its Cholesky factor K loses
    no digits, and ``K^T D V^T`` has the rows wanted (Garrison, Ipsen: A randomized preconditioned
    Cholesky-QR algorithm, arXiv:2406.11751, 2024). With V orthogonal the error is that of a
    Householder QR, eps of the largest singular value. None where the sample does not stand for
    the points, so that the Gram matrix is not well conditioned.
    """
    width, count = block.shape
    sample = block[:, :: count // (4 * width)] - shift[:, None]
    centre = _finite(sample.mean(axis=1))
    sample -= centre[:, None]
    _, scales, axes = np.linalg.svd(_reduced(sample.T))
    if not scales[-1] > _EPS * width * scales[0]:
        return None
    whiten = axes / scales[:, None]
    origin = shift + centre
    step = max(width, _PRODUCT_ENTRIES // width)
    centred, white = np.empty((2, width, step))
    gram, total = np.zeros((width, width)), np.zeros(width)
    for start in range(0, count, step):
        columns = block[:, start : start + step]
        size = columns.shape[1]
        np.subtract(columns, origin[:, None], out=centred[:, :size])
        np.matmul(whiten, centred[:, :size], out=white[:, :size])
        gram += white[:, :size] @ white[:, :size].T
        total += white[:, :size].sum(axis=1)
    _finite(total)
    gram -= np.outer(total, total) / count
    spectrum = np.linalg.eigvalsh(gram)
    if not spectrum[0] > spectrum[-1] / _WELL_CONDITIONED:
        return None
    colour = scales[:, None] * axes
    mean = centre + total @ colour / count
    return Triangle(count, mean, np.linalg.cholesky(gram).T @ colour, centred[:, :0])


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values; NaN or infinity in the data has reached their sums."""
    if not np.isfinite(values).all():
        raise NotUsableError
    return values


def _reduced(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return at most as many rows as columns with the same Gram matrix; may overwrite the rows."""
    count, width = rows.shape
    if count <= width:
        return rows.copy()
    # numpy's QR keeps the interpreter's lock, so that threads would wait for each other.
    workspace = int(dgeqrf_lwork(count, width)[0])
    factor = dgeqrf(rows, lwork=workspace, overwrite_a=True)[0]
    return cast("NDArray[np.float64]", np.triu(factor[:width]))


def merged(parts: Iterable[Triangle]) -> Triangle:
    """Join sets of points, in order.

    The rows of a set about the common mean are its rows about its own mean plus a constant. The
    two are orthogonal, so the constant adds one row: the distance of the means times the root of
    the number of points.
    """
    parts = list(parts)
    if len(parts) == 1:
        return parts[0]
    count = sum(part.count for part in parts)
    means = np.array([part.mean for part in parts])
    counts = np.array([part.count for part in parts], dtype=np.float64)
    mean = counts @ means / count
    between = np.sqrt(counts)[:, None] * (means - mean)
    rows = np.concatenate([part.rows for part in parts] + [between])
    sample = np.concatenate([part.sample for part in parts], axis=1)
    return Triangle(count, mean, _reduced(rows), sample)
