from __future__ import annotations

import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conftest import clean_environment
from tests.worker.conftest import eventually

if TYPE_CHECKING:
    from tests.worker.conftest import Submitter
    from worker.queue import JobQueue
    from worker.records import JobRecord
    from worker.settings import Settings

THREADS = """
import os
from threadpoolctl import threadpool_info
from worker.main import _prepare_for_forks
_prepare_for_forks(1)
if os.fork() == 0:
    import numpy as np
    np.ones((300, 300)) @ np.ones((300, 300))
    print(sorted({library["num_threads"] for library in threadpool_info()}), flush=True)
    os._exit(0)
os.wait()
"""

SWALLOWED = """
import os, signal, time
from worker import main
from worker.settings import Settings

class Finalised:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)

class Maintenance(main.Maintenance):
    def run_once(self):
        Finalised()

main.Maintenance = Maintenance
keeper = main._Keeper(Settings(), "worker", Settings().scratch)
keeper.ensure()
keeper._process.join(10)
print(keeper._process.exitcode)
keeper._process.kill()
"""


def test_a_worker_that_ends_when_the_queue_is_empty(
    queue: JobQueue, settings: Settings, submit: Submitter
) -> None:
    jobs = [submit() for _ in range(2)]
    subprocess.run(
        [sys.executable, "-m", "worker.main", "--burst"],
        env=clean_environment(**settings.to_environ()),
        check=True,
        timeout=120,
    )
    assert [state(queue.records.get(job_id)) for job_id in jobs] == ["succeeded"] * 2
    assert queue.workers() == 0
    assert list(settings.scratch.iterdir()) == []


def test_wrong_settings_are_told_in_a_line_each() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "worker.main"],
        env=clean_environment(REDIS_URL="foo://x", SMSR_LEASE_SECONDS="0"),
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert run.returncode == 2, run.stderr
    told = [line.split(": ")[:2] for line in run.stderr.splitlines()]
    assert told == [["Error", "REDIS_URL"], ["Error", "SMSR_LEASE_SECONDS"]]


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0])
def test_a_worker_that_is_stopped_while_it_starts(settings: Settings, delay: float) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "worker.main"], env=clean_environment(**settings.to_environ())
    )
    eventually(lambda: settings.scratch.is_dir() and list(settings.scratch.iterdir()), "it starts")
    time.sleep(delay)
    process.terminate()
    try:
        process.wait(30)
    finally:
        process.kill()
    assert list(settings.scratch.iterdir()) == []


def test_a_keeper_ends_though_a_finaliser_swallows_its_exit(settings: Settings) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SWALLOWED],
        env=clean_environment(**settings.to_environ()),
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "SystemExit" in done.stderr
    assert done.stdout.strip() == "0"


def state(record: JobRecord | None) -> str | None:
    return record.status if record else None


def test_work_horses_inherit_the_number_of_threads() -> None:
    environment = {k: v for k, v in clean_environment().items() if not k.endswith("NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", THREADS],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[1]"
