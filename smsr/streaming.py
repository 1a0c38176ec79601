"""Passes over a measurement source: chunks of points worked on by a few threads.

The threads are ours and each BLAS call runs on one of them: with blocks small enough for a core's
cache that is faster than the threads of BLAS, and the result does not depend on their number.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import scipy.linalg  # noqa: F401  # loads its own BLAS, which is to be found with that of numpy
from threadpoolctl import ThreadpoolController

from smsr.errors import WrongShape

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

    from smsr.measurements import Chunk, MeasurementSource

Result = TypeVar("Result")

_SMALL = 512


@cache
def _blas() -> ThreadpoolController:
    """Return the handle on numpy's BLAS (and any other loaded): finding it takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")


def blas_threads() -> int:
    """Return how many threads BLAS may use now, which follows the environment and affinity."""
    return max((library["num_threads"] for library in _blas().info()), default=1)


def one_blas_thread() -> AbstractContextManager[object]:
    """Keep BLAS to one thread within a context."""
    limiter: AbstractContextManager[object] = _blas().limit(limits=1)
    return limiter


def few_blas_threads(matrix: NDArray[Any]) -> AbstractContextManager[object]:
    """Keep BLAS to one thread for work on a matrix so small that more wait for each other."""
    return one_blas_thread() if min(matrix.shape) <= _SMALL else nullcontext()


def map_chunks(
    work: Callable[[slice, NDArray[Any]], Result], chunks: Iterable[Chunk], workers: int
) -> Generator[tuple[int, Result]]:
    """Apply `work` to each chunk.

    Parameters
    ----------
    work : callable
        Takes the slice of points and its block; called from several threads at once.
    chunks : iterable
        Read from the calling thread, at most ``workers + 1`` chunks ahead.
    workers : int
        Number of threads; 1 works in the calling thread.

    Yields
    ------
    stop : int
        Number of points up to the end of the chunk.
    result
        What `work` returned, in the order of the chunks.
    """
    with one_blas_thread():
        if workers == 1:
            for points, block in chunks:
                yield points.stop, work(points, block)
            return
        pending: deque[tuple[int, Future[Result]]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="smsr") as pool:
            try:
                for points, block in chunks:
                    pending.append((points.stop, pool.submit(work, points, block)))
                    if len(pending) > workers:
                        stop, future = pending.popleft()
                        yield stop, future.result()
                while pending:
                    stop, future = pending.popleft()
                    yield stop, future.result()
            finally:
                for _, future in pending:
                    future.cancel()


def checked_chunks(source: MeasurementSource, size: int) -> Iterator[Chunk]:
    """Yield the source's chunks of at most `size` points.

    Raises
    ------
    WrongShape
        A block of another shape than the source announced, or points left out.
    """
    rows = 2 * source.frames
    start = 0
    for points, block in source.chunks(size):
        if points.start != start or np.shape(block) != (rows, points.stop - start):
            raise WrongShape(
                f"The source gave a block of shape {np.shape(block)} for points {points.start} to "
                f"{points.stop}; expected {rows} rows of points from {start}."
            )
        start = points.stop
        yield points, block
    if start != source.points:
        raise WrongShape(f"The source gave {start} points; it announced {source.points}.")
