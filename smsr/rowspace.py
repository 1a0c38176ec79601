"""The reduction that makes the solver's cost independent of the number of points.

Every stage of the solver acts on the measurement matrix W (2T x N) from the left. With a thin
factorisation W = L V^T, V orthonormal, the stages run on the r <= 2T columns of L ("virtual
points") and give the same singular values, norms and iterates as on W. What is left of N is one
pass over W that finds L (`factorise`) and one that writes the shapes ``S = A W`` (`map_back`).
Both stream over chunks of points, so neither W nor S need fit in memory.

L comes from a tall-skinny QR: the triangles of chunks of W^T are stacked and factored again. The
Gram matrix W W^T would be cheaper, and would lose half of the digits of the small singular values.
"""

from __future__ import annotations

import dataclasses
import math
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from smsr.errors import InputError
from smsr.mapping import Operator, Workspace, single_precision_serves
from smsr.measurements import (
    CHUNK_BYTES,
    RemoteSource,
    check_values,
    chunk_points,
    constant_measurements,
)
from smsr.progress import ignore
from smsr.sinks import sink_for
from smsr.streaming import blas_threads, checked_chunks, few_blas_threads, map_chunks
from smsr.triangles import NotUsableError, Triangle, merged, triangle_of

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smsr.lifting import Lifting
    from smsr.measurements import MeasurementSource
    from smsr.progress import StageHook

_EPS = float(np.finfo(np.float64).eps)
_LARGEST = 1e150  # so that squares stay finite
_SMALLEST = 1e-150  # so that they stay above zero

SAMPLE = 512
"""Most points that are kept as they are."""


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
    sample : ndarray of shape (2T, s), float64
        Some points of the centred W, chosen blindly: `SAMPLE`, or all where they are fewer.
    """

    means: NDArray[np.float64]
    factor: NDArray[np.float64]
    singular_values: NDArray[np.float64]
    frames: int
    points: int
    sample: NDArray[np.float64]

    @property
    def left(self) -> NDArray[np.float64]:
        """U (2T, r), the left singular vectors of the centred W."""
        vectors: NDArray[np.float64] = self.factor / self.singular_values
        return vectors

    @property
    def spread(self) -> float:
        """Root mean square of the centred W."""
        positions = 2 * self.frames * self.points
        return math.sqrt(float((self.singular_values**2).sum()) / positions)

    def leading(self, count: int) -> RowSpace:
        """Return the space of the strongest directions, at most so many."""
        return dataclasses.replace(
            self, factor=self.factor[:, :count], singular_values=self.singular_values[:count]
        )

    def divided(self, scales: NDArray[np.float64]) -> RowSpace:
        """Return the space of W with each frame divided by its scale (T,)."""
        rows = 1.0 / np.repeat(scales, 2)
        with few_blas_threads(self.factor):
            left, values, _ = np.linalg.svd(rows[:, None] * self.factor, full_matrices=False)
        rank = _rank(values, len(left))
        return dataclasses.replace(
            self,
            means=rows * self.means,
            factor=_signed(left[:, :rank]) * values[:rank],
            singular_values=values[:rank],
            sample=rows[:, None] * self.sample,
        )

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
    # Differences to a point of the data are exact or nearly so: a far translation is gone before
    # anything is added or multiplied, and costs no digits.
    size = _factor_chunk(source, chunk_bytes)
    sampled = _sample(source.points)
    triangles: Iterator[tuple[int, Triangle]]
    if isinstance(source, RemoteSource):
        shift = source.first_point().astype(np.float64)
        triangles = source.triangles(shift, size, sampled, workers)
    else:
        chunks = checked_chunks(source, size)
        first = next(chunks)
        shift = first[1][:, 0].astype(np.float64)
        work = partial(triangle_of, shift=shift, sampled=sampled)
        triangles = map_chunks(work, chain([first], chunks), workers or blas_threads())
    waiting: list[Triangle] = []
    try:
        for index, (stop, triangle) in enumerate(triangles, 1):
            waiting.append(triangle)
            if sum(len(part.rows) for part in waiting) >= 8 * source.frames:
                waiting = [merged(waiting)]
            progress(stop / source.points, index, None)
    except NotUsableError:
        check_values(source)
        raise _too_large() from None
    return _row_space(merged(waiting), shift, source)


def _sample(points: int) -> NDArray[np.intp]:
    """Return numbers of some points: the same in each run, but in step with no grid."""
    if points <= SAMPLE:
        return np.arange(points)
    return np.sort(np.random.default_rng(0).choice(points, SAMPLE, replace=False, shuffle=False))


def _factor_chunk(source: MeasurementSource, chunk_bytes: int) -> int:
    """Return the points in a chunk: enough of them, too, that its triangle is smaller."""
    worthwhile = min(4 * source.frames, chunk_points(source, 4 * chunk_bytes))
    return max(chunk_points(source, chunk_bytes), worthwhile)


def _row_space(total: Triangle, shift: NDArray[np.float64], source: MeasurementSource) -> RowSpace:
    """Turn the triangle of all points into the factor, by its singular value decomposition."""
    largest = float(np.abs(total.rows).max())
    if not largest < _LARGEST:
        raise _too_large()
    with few_blas_threads(total.rows):
        _, values, right = np.linalg.svd(total.rows, full_matrices=False)
    means = shift + total.mean
    spread = float(np.linalg.norm(values)) / np.sqrt(2 * source.frames * source.points)
    single = np.dtype(source.dtype).kind == "f" and np.dtype(source.dtype).itemsize <= 4
    numbers = np.finfo(source.dtype if single else np.float64)
    if 0.0 < largest < (numbers.tiny if single else _SMALLEST):
        raise _too_small()
    if spread <= numbers.eps * float(np.abs(means).max()):
        raise constant_measurements()
    rank = _rank(values, 2 * source.frames)
    return RowSpace(
        means=means,
        factor=_signed(right[:rank].T) * values[:rank],
        singular_values=values[:rank],
        frames=source.frames,
        points=source.points,
        sample=total.sample - total.mean[:, None],
    )


def _rank(values: NDArray[np.float64], rows: int) -> int:
    """Return how many singular values, largest first, are above rounding."""
    return int(np.count_nonzero(values > _EPS * max(32, rows) * values[0]))


def _signed(left: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return singular vectors with the sign that makes the largest entry positive."""
    signs = np.sign(np.take_along_axis(left, np.abs(left).argmax(axis=0)[None], axis=0))
    signed: NDArray[np.float64] = left * signs
    return signed


def _too_small() -> InputError:
    return InputError(
        "The points differ by too little for the solver's arithmetic. Scale the measurements up; "
        "pixels are a good unit."
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
        S: `out`, the new array, or a read-only map of the file. For a dask array and a folder, a
        lazy dask array; the folder then holds ``shapes.zarr``.

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
    points = source.points
    size = min(points, chunk_points(source, chunk_bytes))
    if isinstance(source, RemoteSource):
        dtype = _output_dtype(out, source)
        operator = _operator(A, rowspace, dtype)
        far: NDArray[np.floating[Any]] = source.map_back(
            operator, rowspace.means, out, dtype, size=size, workers=workers, progress=progress
        )
        return far
    sink = sink_for(out, source.frames, points, _output_dtype(out, source))
    workers = min(workers or blas_threads(), -(-points // size))
    spaces: SimpleQueue[Workspace] = SimpleQueue()

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
        operator = _operator(A, rowspace, sink.dtype)
        for _ in range(workers):
            spaces.put(Workspace(operator, size, sink.dtype))
        with closing(map_chunks(work, checked_chunks(source, size), workers)) as done:
            for index, (stop, _) in enumerate(done, 1):
                progress(stop / points, index, None)
    except BaseException:
        sink.discard()
        raise
    return sink.finish()


def _output_dtype(
    out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None, source: MeasurementSource
) -> np.dtype[Any]:
    """Return the precision of the shapes: that of the array, of files, or of the measurements."""
    if isinstance(out, np.ndarray):
        return out.dtype
    dtype = np.dtype(source.dtype)
    single = out is not None or (dtype.kind == "f" and dtype.itemsize <= np.dtype("f4").itemsize)
    return np.dtype(np.float32 if single else np.float64)


def _operator(
    A: NDArray[np.float64] | Lifting, rowspace: RowSpace, dtype: np.dtype[Any]
) -> Operator:
    """Return the map in the precision that the output needs."""
    with few_blas_threads(rowspace.factor):
        operator = Operator.of(A)
        if dtype != np.float32:
            return operator
        rows = np.linalg.norm(rowspace.factor, axis=1)
        shapes = np.linalg.norm(operator(rowspace.factor), axis=1)
        if shapes.max() > np.finfo(np.float32).max:
            raise _too_large()
        if single_precision_serves(operator, rows, shapes):
            operator = operator.astype(np.dtype(np.float32))
        return operator
