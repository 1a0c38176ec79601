"""A queue with short times, and real workers to run its jobs."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr.synthetic import make_example
from tests.worker import workers
from worker.queue import JobQueue
from worker.records import InputFile, JobRecord, new_job_id, upload_key
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from multiprocessing.context import ForkServerProcess

    from smsr.synthetic import Example

PATIENCE = 30.0


@pytest.fixture(scope="session")
def example() -> Example:
    return make_example(frames=12, side=4)


@pytest.fixture
def settings(tmp_path: Path, redis_url: str) -> Settings:
    return quick_settings(tmp_path, redis_url)


def quick_settings(folder: Path, redis_url: str, **more: Any) -> Settings:
    """Return settings under which a dead worker is noticed within two seconds or so."""
    values: dict[str, Any] = {
        "data_dir": folder,
        "redis_url": redis_url,
        "lease_seconds": 1.0,
        "heartbeat_seconds": 0.2,
        "cancel_grace_seconds": 0.6,
        "shutdown_grace_seconds": 0.2,
        "progress_interval_seconds": 0.05,
        "storage_retry_seconds": 1.0,
        "maintenance_interval_seconds": 0.2,
        "lost_ticket_seconds": 0.6,
        "threads": 1,
        "log_level": "WARNING",
    }
    return Settings(**(values | more))


@pytest.fixture
def queue(settings: Settings) -> JobQueue:
    return JobQueue(settings)


@dataclass
class Submitter:
    """Stores inputs and submits jobs."""

    queue: JobQueue
    example: Example

    def record(
        self, options: Mapping[str, Any] | None = None, **arrays: np.ndarray[Any, Any]
    ) -> JobRecord:
        job_id = new_job_id()
        inputs = {}
        for role, array in ({"measurements": self.example.measurements} | arrays).items():
            buffer = io.BytesIO()
            np.save(buffer, array)
            key = upload_key(job_id, role)
            self.queue.storage.put_bytes(key, buffer.getvalue())
            inputs[role] = InputFile(key, f"{role}.npy", buffer.tell(), "")
        return JobRecord.new(job_id, options=options or {}, inputs=inputs)

    def __call__(
        self, options: Mapping[str, Any] | None = None, **arrays: np.ndarray[Any, Any]
    ) -> str:
        return self.queue.submit(self.record(options, **arrays)).id


@pytest.fixture
def submit(queue: JobQueue, example: Example) -> Submitter:
    return Submitter(queue, example)


def wait_for(
    queue: JobQueue, job_id: str, condition: Callable[[JobRecord], bool], what: str = ""
) -> JobRecord:
    """Return the record as soon as a condition holds."""
    deadline = time.monotonic() + PATIENCE
    record = None
    while time.monotonic() < deadline:
        record = queue.records.get(job_id)
        if record is not None and condition(record):
            return record
        time.sleep(0.01)
    raise AssertionError(f"waited in vain for {what or condition}: {record}")


def wait_for_end(queue: JobQueue, job_id: str) -> JobRecord:
    return wait_for(queue, job_id, lambda record: record.final, "the end of the job")


def eventually(condition: Callable[[], object], what: str) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.02)


def horses(worker: int) -> list[int]:
    """Return the process ids of a worker's work-horses (its children but the keeper)."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent, group = (folder / "stat").read_text().rpartition(")")[2].split()[1:3]
            # A work-horse leads a process group of its own, the keeper does not.
            if int(parent) == worker and group == folder.name:
                found.append(int(folder.name))
    return found


def alive(pid: int) -> bool:
    """Whether a process runs."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@dataclass
class Workers:
    """Starts workers, and sees that none is left."""

    settings: Settings
    processes: list[ForkServerProcess]

    def start(self, behaviour: workers.Behaviour | None = None, **settings: Any) -> int:
        """Start a worker in a process of its own; return its process id."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["tests.worker.workers"])
        changed = self.settings.model_copy(update=settings)
        process = context.Process(target=workers.work, args=(changed, behaviour))
        process.start()
        self.processes.append(process)
        assert process.pid is not None
        return process.pid

    def kill(self, pid: int, *, with_horse: bool = False) -> None:
        victims = [pid, *(horses(pid) if with_horse else [])]
        for victim in victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)

    def stop(self) -> None:
        for process in self.processes:
            process.terminate()
        for process in self.processes:
            process.join(10)
            if process.is_alive():
                process.kill()
                process.join()


@pytest.fixture
def start_worker(settings: Settings) -> Iterator[Workers]:
    started = Workers(settings, [])
    try:
        yield started
    finally:
        started.stop()
