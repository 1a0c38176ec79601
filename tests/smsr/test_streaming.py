from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from smsr.measurements import as_source
from smsr.streaming import blas_threads, checked_chunks, map_chunks, one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smsr.measurements import Chunk

SOURCE = as_source(np.random.default_rng(0).standard_normal((6, 100)))


@pytest.mark.parametrize("workers", [1, 2, 7])
def test_results_come_in_order(workers: int) -> None:
    def work(points: slice, block: np.ndarray[Any, Any]) -> float:
        time.sleep(0.002 * (points.start % 3))
        return float(block.sum())

    results = list(map_chunks(work, checked_chunks(SOURCE, 8), workers))
    expected = [(points.stop, float(block.sum())) for points, block in SOURCE.chunks(8)]
    assert results == expected


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_it_reads_little_ahead(workers: int) -> None:
    read = done = most = 0
    lock = threading.Lock()

    def chunks() -> Iterator[Chunk]:
        nonlocal read, most
        for chunk in SOURCE.chunks(1):
            read += 1
            most = max(most, read - done)
            yield chunk

    def work(points: slice, block: np.ndarray[Any, Any]) -> None:
        nonlocal done
        time.sleep(0.001)
        with lock:
            done += 1

    for _ in map_chunks(work, chunks(), workers):
        pass
    assert done == 100
    assert workers <= most <= workers + 1


@pytest.mark.parametrize("workers", [1, 3])
def test_an_error_ends_the_pass(workers: int) -> None:
    def work(points: slice, block: np.ndarray[Any, Any]) -> None:
        if points.start == 40:
            raise ZeroDivisionError

    started = threading.active_count()
    with pytest.raises(ZeroDivisionError):
        list(map_chunks(work, checked_chunks(SOURCE, 8), workers))
    assert threading.active_count() == started


def test_threads_of_blas() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert blas_threads() == 2
        with one_blas_thread():
            assert blas_threads() == 1
        assert blas_threads() == 2
