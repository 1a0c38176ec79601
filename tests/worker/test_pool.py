from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

from tests.worker.conftest import Submitter, alive, eventually, wait_for_end
from worker.pool import WorkerPool

if TYPE_CHECKING:
    from worker.queue import JobQueue
    from worker.settings import Settings


def test_workers_of_a_pool_work_and_are_replaced(
    queue: JobQueue, settings: Settings, submit: Submitter
) -> None:
    with WorkerPool(settings, 1) as pool:
        assert wait_for_end(queue, submit()).status == "succeeded"
        eventually(lambda: queue.workers() == 1, "the worker gives signs of life")
        (first,) = pool.pids
        os.kill(first, signal.SIGKILL)
        job_id = submit()
        assert wait_for_end(queue, job_id).status == "succeeded"
        (second,) = pool.pids
        assert second != first
    assert pool.pids == ()
    assert not alive(second)
    assert list(settings.scratch.iterdir()) == []
