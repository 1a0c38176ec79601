"""Measurements as a dask array: the two passes run where its blocks are.

Needs the extra ``smsr[dask]``. With an active `distributed.Client` each block is made, reduced and
let go on a worker, and only triangles (2T x 2T) travel; without one the blocks are made one by one
on this machine. Shapes written to a folder go to a zarr store, a chunk of points to a file, so
that workers share no file.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import dask.array
import numpy as np
import zarr
from dask.delayed import delayed

from smsr.mapping import Workspace
from smsr.progress import ignore
from smsr.sinks import sink_for
from smsr.streaming import blas_threads, map_chunks
from smsr.triangles import triangle_of

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from smsr.mapping import Operator
    from smsr.measurements import Chunk
    from smsr.progress import StageHook
    from smsr.triangles import Triangle

Result = TypeVar("Result")

SHAPES_STORE = "shapes.zarr"
"""Name of the zarr store of shapes in an output folder."""


@dataclass(frozen=True, slots=True, eq=False)
class DaskSource:
    """A dask array as a source that takes the work to its blocks.

    Parameters
    ----------
    matrix : dask array of shape (2T, N)
        W, rows u1, v1, u2, v2, ... Chunks of points with all frames are best; others are put
        together as needed.
    """

    matrix: dask.array.Array

    @property
    def frames(self) -> int:
        """T."""
        return int(self.matrix.shape[0]) // 2

    @property
    def points(self) -> int:
        """N."""
        return int(self.matrix.shape[1])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries."""
        dtype: np.dtype[Any] = self.matrix.dtype
        return dtype

    def first_point(self) -> NDArray[Any]:
        """Return the first column (2T,) of W."""
        column: NDArray[Any] = self.matrix[:, 0].compute()
        return column

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Bring one block after another here; see `MeasurementSource.chunks`."""
        size = size or self.points
        for points, block in self._blocks(size):
            here: NDArray[Any] = block.compute()
            for start in range(points.start, points.stop, size):
                part = slice(start, min(start + size, points.stop))
                yield part, here[:, part.start - points.start : part.stop - points.start]

    def triangles(
        self, shift: NDArray[np.float64], size: int, sampled: NDArray[np.intp], workers: int | None
    ) -> Iterator[tuple[int, Triangle]]:
        """Reduce blocks of about `size` points where they are, and keep a sample."""
        return self.map(partial(triangle_of, shift=shift, sampled=sampled), size, workers)

    def map(
        self, work: Callable[[slice, NDArray[Any]], Result], size: int, workers: int | None
    ) -> Iterator[tuple[int, Result]]:
        """Apply `work`, which must pickle, to blocks of about `size` points where they are.

        Yields
        ------
        stop, result
            As from `smsr.streaming.map_chunks`; `workers` counts only without a cluster.
        """
        client = _client()
        if client is None:
            blocks = ((points, block.compute()) for points, block in self._blocks(size))
            yield from map_chunks(work, blocks, workers or blas_threads())
            return
        # One node for the work, so that its arrays travel once and not with every task.
        shared = delayed(work, traverse=False)
        slices, tasks = [], []
        for points, block in self._blocks(size):
            slices.append(points)
            tasks.append(delayed(_apply)(shared, points, block))
        futures = client.compute(tasks)
        try:
            while futures:
                result = futures[0].result()
                futures.pop(0).release()
                yield slices.pop(0).stop, result
        finally:
            client.cancel(futures)

    def map_back(
        self,
        operator: Operator,
        means: NDArray[np.float64],
        out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None,
        dtype: np.dtype[Any],
        *,
        size: int,
        workers: int | None,
        progress: StageHook = ignore,
    ) -> Any:
        """Make the shapes of all points; see `smsr.rowspace.map_back`.

        Returns
        -------
        ndarray or dask array of shape (T, N, 3)
            The array that was given or made, on this machine; or, with a folder, a lazy array on
            the zarr store in it that the workers wrote.
        """
        if out is not None and not isinstance(out, np.ndarray):
            return self._write(Path(out), operator, means, size, workers, progress)
        sink = sink_for(out, self.frames, self.points, dtype)
        work = partial(_shapes, operator=operator, means=means, dtype=dtype)
        start = 0
        for index, (stop, shapes) in enumerate(self.map(work, size, workers), 1):
            target = sink.target(slice(start, stop))
            if target is not None:
                target[...] = shapes
            progress(stop / self.points, index, None)
            start = stop
        return sink.finish()

    def _write(
        self,
        folder: Path,
        operator: Operator,
        means: NDArray[np.float64],
        size: int,
        workers: int | None,
        progress: StageHook,
    ) -> dask.array.Array:
        """Let each worker write the chunks of its blocks."""
        path = folder / SHAPES_STORE
        store = zarr.create_array(
            str(path),
            shape=(self.frames, self.points, 3),
            chunks=(self.frames, min(self.points, self.block_points(size)), 3),
            dtype="<f4",
            compressors=None,
            overwrite=True,
        )
        work = partial(_store, store=store, operator=operator, means=means)
        try:
            for index, (stop, _) in enumerate(self.map(work, size, workers), 1):
                progress(stop / self.points, index, None)
        except BaseException:
            shutil.rmtree(path, ignore_errors=True)
            raise
        return dask.array.from_zarr(str(path))

    def block_points(self, size: int) -> int:
        """Return the points of each block but the last, whole chunks of the array if possible."""
        widths = self.matrix.chunks[1]
        regular = len(set(widths[:-1])) <= 1 and widths[-1] <= widths[0]
        if regular and widths[0] <= _WIDE * size:
            return int(widths[0]) * max(1, size // int(widths[0]))
        return size

    def _blocks(self, size: int) -> Iterator[tuple[slice, dask.array.Array]]:
        """Yield lazy blocks (2T, n)."""
        step = self.block_points(size)
        for start in range(0, self.points, step):
            points = slice(start, min(start + step, self.points))
            yield points, self.matrix[:, points]


_WIDE = 8  # chunks of the array wider than this many times what is asked for are cut


def _client() -> Any:
    """Return the active client of a cluster, if any."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return distributed.get_client()
    except ValueError:
        return None


def _apply(
    work: Callable[[slice, NDArray[Any]], Result], points: slice, block: NDArray[Any]
) -> Result:
    return work(points, block)


def _shapes(
    _points: slice,
    block: NDArray[Any],
    *,
    operator: Operator,
    means: NDArray[np.float64],
    dtype: np.dtype[Any],
) -> NDArray[np.floating[Any]]:
    """Return the shapes (T, n, 3) of a block."""
    space = Workspace(operator, block.shape[1], dtype)
    space.fill(space.shapes, block, means)
    return space.shapes


def _store(
    points: slice,
    block: NDArray[Any],
    *,
    store: zarr.Array[Any],
    operator: Operator,
    means: NDArray[np.float64],
) -> None:
    """Write the shapes of a block to its chunk of the store."""
    dtype = np.dtype(np.float32)
    store[:, points] = _shapes(points, block, operator=operator, means=means, dtype=dtype)
