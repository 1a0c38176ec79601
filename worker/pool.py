"""Several worker processes on one machine."""

from __future__ import annotations

import os
import sys
import threading
from typing import TYPE_CHECKING

from worker.processes import KeptProcess

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from worker.settings import Settings

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerPool:
    """Worker processes that are started again when they die; a context manager.

    Parameters
    ----------
    settings : Settings
        With a Redis server.
    count : int, optional
        Number of workers, ``settings.workers`` by default.
    """

    def __init__(self, settings: Settings, count: int | None = None) -> None:
        environment = {
            **os.environ,
            **dict.fromkeys(THREAD_VARIABLES, str(settings.threads_per_worker)),
            **settings.to_environ(),
        }
        self._workers = [
            KeptProcess(
                [sys.executable, "-m", "worker.main"],
                environment=environment,
                stop_seconds=settings.shutdown_grace_seconds + 10.0,
            )
            for _ in range(settings.workers if count is None else count)
        ]

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers that run now."""
        return tuple(worker.pid for worker in self._workers if worker.pid is not None)

    def start(self) -> None:
        """Start the workers."""
        for worker in self._workers:
            worker.start()

    def stop(self) -> None:
        """Stop all workers at once; each hands a job back that it cannot finish soon."""
        stopping = [threading.Thread(target=worker.stop) for worker in self._workers]
        for thread in stopping:
            thread.start()
        for thread in stopping:
            thread.join()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()
