"""The reduction that makes the solver's cost independent of the number of points.

Every stage of the solver acts on the measurement matrix W (2T x N) from the left. With a thin
factorisation W = L V^T, V orthonormal, the stages run on the r <= 2T columns of L ("virtual
points") and give the same singular values, norms and iterates as on W. What is left of N is one
pass over W that finds L (`factorise`) and one that writes the shapes ``S = A W`` (`map_back`).
Both stream over chunks of points, so neither W nor S need fit in memory.

L comes from a tall-skinny QR (Demmel, Grigori, Hoemmen, Langou: Communication-optimal parallel and
sequential QR and LU factorizations, SIAM J. Sci. Comput. 34(1), 2012): the triangles of chunks of
W^T are stacked and factored again. The Gram matrix W W^T would be cheaper, and would lose half of
the digits of the small singular values.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from itertools import chain
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from smsr.errors import InputError
from smsr.measurements import (
    CHUNK_BYTES,
    check_values,
    chunk_points,
    constant_measurements,
)
from smsr.progress import ignore
from smsr.sinks import sink_for
from smsr.streaming import blas_threads, checked_chunks, map_chunks, one_blas_thread

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from smsr.lifting import Lifting
    from smsr.measurements import MeasurementSource
    from smsr.progress import StageHook

_CACHE_ENTRIES = 48 * 1024  # float64 entries that stay in a core's second-level cache
_PRODUCT_ENTRIES = 512 * 1024
_SMALL = 512  # up to this size more threads of BLAS only wait for each other
_RANK_TOLERANCE = float(np.finfo(np.float64).eps)
_SINGLE_EPS = float(np.finfo(np.float32).eps)
_SINGLE_ERROR = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RowSpace:
    """The centred measurements without their points: ``W - means = L V^T``, V orthonormal.

    Attributes
    ----------
    means : ndarray of shape (2T,), float64
        Mean of each row of W over the points, the camera's translation t.
    factor : ndarray of shape (2T, r), float64
        L = U diag(singular_values), r the numerical rank; the largest entry of each column of U is
        positive, so that the signs do not depend on the chunks.
    singular_values : ndarray of shape (r,), float64
        Of the centred W, largest first.
    frames, points : int
        T and N.
    """

    means: NDArray[np.float64]
    factor: NDArray[np.float64]
    singular_values: NDArray[np.float64]
    frames: int
    points: int

    @property
    def left(self) -> NDArray[np.float64]:
        """U (2T, r), the left singular vectors of the centred W."""
        vectors: NDArray[np.float64] = self.factor / self.singular_values
        return vectors

    @property
    def translations(self) -> NDArray[np.float64]:
        """The means by frame, t (T, 2)."""
        return self.means.reshape(self.frames, 2)


def factorise(
    source: MeasurementSource,
    *,
    chunk_bytes: int = CHUNK_BYTES,
    workers: int | None = None,
    progress: StageHook = ignore,
) -> RowSpace:
    """Find the row means and the left factor of the centred measurements in one pass.

    Parameters
    ----------
    source : MeasurementSource
        W (2T x N). Single precision is converted block by block.
    chunk_bytes : int
        Size of the chunks that are read.
    workers : int, optional
        Threads; as many as BLAS may use when it is not given. The result does not depend on it.
    progress : StageHook
        Called after each chunk; an exception it raises stops the pass.

    Returns
    -------
    RowSpace
        Singular values below rounding, ``2T eps`` of the largest, are left out with their
        directions.

    Raises
    ------
    NotFinite
        NaN or infinite entries; where and how many.
    ConstantMeasurements
        The points coincide in every frame, up to the rounding of the data.
    InputError
        Entries too large for double precision.
    """
    chunks = checked_chunks(source, _factor_chunk(source, chunk_bytes))
    first = next(chunks)
    # Differences to a point of the data are exact or nearly so: a far translation is gone before
    # anything is added or multiplied, and costs no digits.
    shift = np.array(first[1][:, 0], dtype=np.float64)

    def work(_points: slice, block: NDArray[Any]) -> _Triangle:
        return _triangle(block, shift)

    waiting: list[_Triangle] = []
    triangles = map_chunks(work, chain([first], chunks), workers or blas_threads())
    try:
        for index, (stop, triangle) in enumerate(triangles, 1):
            waiting.append(triangle)
            if sum(len(part.rows) for part in waiting) >= 8 * source.frames:
                waiting = [_merged(waiting)]
            progress(stop / source.points, index, None)
    except _NotUsableError:
        check_values(source)
        raise _too_large() from None
    return _row_space(_merged(waiting), shift, source)


def _factor_chunk(source: MeasurementSource, chunk_bytes: int) -> int:
    """Return the points in a chunk: enough of them, too, that its triangle is smaller."""
    worthwhile = min(4 * source.frames, chunk_points(source, 4 * chunk_bytes))
    return max(chunk_points(source, chunk_bytes), worthwhile)


class _NotUsableError(Exception):
    """A block holds entries that are not finite, or overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class _Triangle:
    """What stays of some points: how many, their mean, and rows whose Gram matrix is theirs.

    The mean is relative to a shift common to all, and the rows (k, 2T) are those of the points
    about their mean, or a triangular factor of them.
    """

    count: int
    mean: NDArray[np.float64]
    rows: NDArray[np.float64]


def _triangle(block: NDArray[Any], shift: NDArray[np.float64]) -> _Triangle:
    """Reduce a block (2T, n), by parts that stay in cache."""
    width, count = block.shape
    step = max(4 * width, _CACHE_ENTRIES // width)
    buffer = np.empty((width, min(step, count)))
    parts = []
    with np.errstate(invalid="ignore", over="ignore"):
        for start in range(0, count, step):
            columns = block[:, start : start + step]
            centred = buffer[:, : columns.shape[1]]
            np.subtract(columns, shift[:, None], out=centred)
            mean = centred.mean(axis=1)
            if not np.isfinite(mean).all():
                raise _NotUsableError
            centred -= mean[:, None]
            parts.append(_Triangle(columns.shape[1], mean, _reduced(centred.T)))
    return _merged(parts)


def _reduced(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return at most as many rows as columns with the same Gram matrix."""
    if rows.shape[0] <= rows.shape[1]:
        return rows.copy()
    return cast("NDArray[np.float64]", np.linalg.qr(rows, mode="r"))


def _merged(parts: Iterable[_Triangle]) -> _Triangle:
    """Join sets of points.

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
    return _Triangle(count, mean, _reduced(rows))


def _row_space(total: _Triangle, shift: NDArray[np.float64], source: MeasurementSource) -> RowSpace:
    """Turn the triangle of all points into the factor, by its singular value decomposition."""
    if not np.isfinite(total.rows).all():
        raise _too_large()
    with one_blas_thread() if min(total.rows.shape) <= _SMALL else nullcontext():
        _, values, right = np.linalg.svd(total.rows, full_matrices=False)
    means = shift + total.mean
    spread = float(np.linalg.norm(values)) / np.sqrt(2 * source.frames * source.points)
    single = np.dtype(source.dtype).kind == "f" and np.dtype(source.dtype).itemsize <= 4
    precision = np.finfo(source.dtype if single else np.float64).eps
    if spread <= 4 * precision * float(np.abs(means).max()):
        raise constant_measurements()
    tolerance = _RANK_TOLERANCE * max(32, 2 * source.frames)
    rank = int(np.count_nonzero(values > tolerance * values[0]))
    left = right[:rank].T
    left *= np.sign(np.take_along_axis(left, np.abs(left).argmax(axis=0)[None], axis=0))
    return RowSpace(
        means=means,
        factor=left * values[:rank],
        singular_values=values[:rank],
        frames=source.frames,
        points=source.points,
    )


def _too_large() -> InputError:
    return InputError(
        "Entries of the measurements are too large for the solver's arithmetic. Scale them down; "
        "pixels are a good unit."
    )


def map_back(
    source: MeasurementSource,
    rowspace: RowSpace,
    A: NDArray[np.float64] | Lifting,
    out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None = None,
    *,
    chunk_bytes: int = CHUNK_BYTES,
    workers: int | None = None,
    progress: StageHook = ignore,
) -> NDArray[np.floating[Any]]:
    """Write the shapes of all points, ``S = A (W - means)``, in one pass.

    Parameters
    ----------
    source : MeasurementSource
        W (2T x N), the one that was factorised.
    rowspace : RowSpace
        Of the source.
    A : ndarray of shape (3T, 2T), or Lifting
        The linear map that the solver found, whole or in factors.
    out : ndarray of shape (T, N, 3), path or None
        Array to fill; or a folder, in which ``shapes.npy`` is written, float32 little endian in C
        order; or nothing, for a new array of the source's precision (float32 or float64).
    chunk_bytes : int
        Size of the chunks that are read.
    workers : int, optional
        Threads; as many as BLAS may use when it is not given.
    progress : StageHook
        Called after each chunk; an exception it raises stops the pass and removes the file.

    Returns
    -------
    ndarray of shape (T, N, 3)
        S: `out`, the new array, or a read-only map of the file.

    Raises
    ------
    InputError
        Shapes too large for the single precision of `out`.
    OSError
        The file cannot be written: the disk is full, for one.

    Notes
    -----
    For single-precision output the product runs in single precision where the rounding of the
    terms, known from A and L, stays below 1e-6 of the shapes; otherwise in double.
    """
    frames, points = source.frames, source.points
    sink = sink_for(out, frames, points, _result_dtype(source.dtype))
    operator = _Operator.of(A)
    if sink.dtype == np.float32:
        _check_single_range(operator, rowspace)
        if _single_precision_serves(operator, rowspace):
            operator = operator.astype(np.dtype(np.float32))
    size = min(points, chunk_points(source, chunk_bytes))
    workers = workers or blas_threads()
    spaces: SimpleQueue[_Workspace] = SimpleQueue()
    for _ in range(workers):
        spaces.put(_Workspace(operator, size, sink.dtype))

    def work(points: slice, block: NDArray[Any]) -> None:
        space = spaces.get()
        try:
            target = sink.target(points)
            if target is None:
                target = space.shapes[:, : block.shape[1]]
            space.fill(target, block, rowspace.means)
            sink.write(points, target)
        finally:
            spaces.put(space)

    try:
        done = map_chunks(work, checked_chunks(source, size), workers)
        for index, (stop, _) in enumerate(done, 1):
            progress(stop / points, index, None)
    except BaseException:
        sink.discard()
        raise
    return sink.finish()


def _result_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the precision of shapes from measurements of this type."""
    narrow = np.dtype(dtype).itemsize <= np.dtype(np.float32).itemsize and dtype.kind == "f"
    return np.dtype(np.float32 if narrow else np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Operator:
    """A as ``outer @ inner + R^T``, or as one matrix, in one precision."""

    factors: tuple[NDArray[np.floating[Any]], ...]
    cameras: NDArray[np.floating[Any]] | None

    @classmethod
    def of(cls, A: NDArray[np.float64] | Lifting) -> _Operator:
        """Take the form of A with the least work for each point."""
        if isinstance(A, np.ndarray):
            return cls((A,), None)
        frames, _, inside = A.outer.shape
        # R^T on each frame is so thin a product that it takes as long as 85 terms of a fat one.
        thin = 85 * frames * (A.cameras is not None)
        if 6 * frames**2 <= 5 * frames * inside + thin:
            return cls((A.matrix(),), None)
        return cls((A.outer.reshape(3 * frames, inside), A.inner), A.cameras)

    def astype(self, dtype: np.dtype[Any]) -> _Operator:
        """Return the operator in another precision."""
        cameras = None if self.cameras is None else self.cameras.astype(dtype)
        return _Operator(tuple(factor.astype(dtype) for factor in self.factors), cameras)

    def absolute(self) -> _Operator:
        """Return the operator of absolute values, which bounds the rounding of the product."""
        cameras = None if self.cameras is None else np.abs(self.cameras)
        return _Operator(tuple(np.abs(factor) for factor in self.factors), cameras)

    def __call__(
        self,
        columns: NDArray[np.floating[Any]],
        buffers: Sequence[NDArray[np.floating[Any]]] | None = None,
    ) -> NDArray[np.floating[Any]]:
        """Apply to columns (2T, n); the result (3T, n) lies in the last of the buffers."""
        result = columns
        for position, factor in enumerate(reversed(self.factors)):
            out = None if buffers is None else buffers[position][:, : columns.shape[1]]
            result = np.matmul(factor, result, out=out)
        if self.cameras is not None:
            frames = len(self.cameras)
            result.reshape(frames, 3, -1)[...] += self.cameras.transpose(0, 2, 1) @ columns.reshape(
                frames, 2, -1
            )
        return result


class _Workspace:
    """Buffers of one thread, and what it does with them."""

    def __init__(self, operator: _Operator, size: int, dtype: np.dtype[Any]) -> None:
        precision = operator.factors[0].dtype
        rows, columns = operator.factors[0].shape[0], operator.factors[-1].shape[1]
        self.operator = operator
        self.step = min(size, max(256, _PRODUCT_ENTRIES // (rows + columns)))
        self.centred = np.empty((columns, self.step), precision)
        self.products = [
            np.empty((len(factor), self.step), precision) for factor in reversed(operator.factors)
        ]
        self.shapes = np.empty((rows // 3, size, 3), dtype)

    def fill(
        self,
        target: NDArray[np.floating[Any]],
        block: NDArray[Any],
        means: NDArray[np.float64],
    ) -> None:
        """Put the shapes of a block (2T, n) into the target (T, n, 3)."""
        frames = len(target)
        for start in range(0, block.shape[1], self.step):
            columns = block[:, start : start + self.step]
            centred = self.centred[:, : columns.shape[1]]
            # The difference is taken in double precision whatever it is stored in.
            np.subtract(columns, means[:, None], out=centred, casting="same_kind")
            axes = self.operator(centred, self.products).reshape(frames, 3, -1).transpose(1, 0, 2)
            # Three strided copies: several times as fast as one assignment of the transpose.
            np.stack(tuple(axes), axis=-1, out=target[:, start : start + self.step])


def _row_norms(rowspace: RowSpace) -> NDArray[np.float64]:
    """Return the norm of each row of the centred measurements, (2T, 1)."""
    norms: NDArray[np.float64] = np.linalg.norm(rowspace.factor, axis=1, keepdims=True)
    return norms


def _single_precision_serves(operator: _Operator, rowspace: RowSpace) -> bool:
    """Tell whether a single-precision product keeps the shapes to `_SINGLE_ERROR`.

    Terms of a sum may be far larger than the sum, where A undoes a direction in which W is weak.
    """
    terms = float(np.linalg.norm(operator.absolute()(_row_norms(rowspace))))
    shapes = float(np.linalg.norm(operator(rowspace.factor)))
    return _SINGLE_EPS * terms <= _SINGLE_ERROR * shapes


def _check_single_range(operator: _Operator, rowspace: RowSpace) -> None:
    """Refuse shapes that would overflow single precision."""
    largest = float(np.linalg.norm(operator(rowspace.factor), axis=1).max())
    if largest > np.finfo(np.float32).max:
        raise _too_large()
