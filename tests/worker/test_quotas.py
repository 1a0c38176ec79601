from __future__ import annotations

import dataclasses
import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worker.conftest import PATIENCE
from worker.maintenance import Maintenance
from worker.pool import WorkerPool
from worker.records import (
    Allowance,
    InputFile,
    JobRecord,
    RecordStore,
    TooManyBytes,
    TooManyJobs,
    new_job_id,
    results_prefix,
    upload_prefix,
)

if TYPE_CHECKING:
    from tests.conftest import RedisProcess
    from tests.worker.conftest import Submitter
    from worker.queue import JobQueue


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    return RecordStore(redis_process.client(), result_ttl=3600)


def new(owner: str | None = "ann", size: int = 100, job_id: str | None = None) -> JobRecord:
    file = InputFile("uploads/x/measurements", "tracks.npy", size, "ab")
    return JobRecord.new(job_id, options={}, inputs={"measurements": file}, owner=owner)


def test_queued_and_running_jobs_are_limited_together(store: RecordStore) -> None:
    two = Allowance(jobs=2)
    first, second = new(), new()
    store.create(first, two)
    store.create(second, two)
    store.begin_attempt(first.id, worker="w", ticket="t", lease=60)
    with pytest.raises(TooManyJobs):
        store.create(new(), two)
    store.create(new(owner="bob"), two)
    assert store.active("ann") == 2
    store.cancel(second.id)
    store.create(new(), two)
    assert store.retry(second.id, two) == "busy"
    assert store.retry(second.id, Allowance(jobs=3)) == "ok"


def test_stored_bytes_are_limited(store: RecordStore) -> None:
    limit = Allowance(bytes=250)
    jobs = [new(), new()]
    for job in jobs:
        store.create(job, limit)
    refused = new()
    with pytest.raises(TooManyBytes):
        store.create(refused, limit)
    assert store.get(refused.id) is None
    store.create(new(owner="bob"), limit)
    store.create(new(owner=None, size=1000), limit)
    store.delete(jobs[0].id)
    store.create(refused, limit)
    assert store.stored_bytes("ann") == 200


def test_many_at_once_get_no_more_than_one_by_one(redis_process: RedisProcess) -> None:
    redis_process.client().flushall()
    limit = Allowance(jobs=7)
    refused = []

    def submit() -> None:
        store = RecordStore(redis_process.client())
        for _ in range(10):
            try:
                store.create(new(), limit)
            except TooManyJobs:
                refused.append(1)

    threads = [threading.Thread(target=submit) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == 73
    store = RecordStore(redis_process.client())
    assert (store.active("ann"), store.stored_bytes("ann")) == (7, 700)


def test_an_upload_is_held_until_it_is_a_job(store: RecordStore) -> None:
    limit = Allowance(bytes=250)
    upload, job = new_job_id(), new_job_id()
    store.hold(upload, "ann", 150, most=250, seconds=60)
    store.hold(job, "ann", 60, most=250, seconds=60)
    with pytest.raises(TooManyBytes):
        store.hold(job, "ann", 101, most=250, seconds=60)
    store.hold(job, "ann", 100, most=250, seconds=60)
    assert store.stored_bytes("ann") == 250
    store.create(new(size=240, job_id=job), limit, [upload])
    assert store.stored_bytes("ann") == 240
    store.drop_hold(upload)
    store.drop_hold(job)
    assert store.stored_bytes("ann") == 240


def test_a_hold_can_be_less_than_before_even_where_there_is_too_much(store: RecordStore) -> None:
    store.hold("u", "ann", 150, most=None, seconds=60)
    store.hold("u", "ann", 120, most=50, seconds=60)
    assert store.stored_bytes("ann") == 120
    store.drop_hold("u")
    assert store.stored_bytes("ann") == 0


def test_forgotten_holds_lapse(queue: JobQueue) -> None:
    queue.records.hold("u", "ann", 150, most=None, seconds=0.05)
    queue.records.hold("v", "ann", 20, most=None, seconds=60)
    time.sleep(0.1)
    Maintenance(queue).run_once()
    assert queue.records.stored_bytes("ann") == 20
    assert queue.redis.keys("smsr:hold:*") == [b"smsr:hold:v"]


def test_a_retried_job_gives_up_its_result(store: RecordStore) -> None:
    job = new()
    store.create(job)
    attempt = store.begin_attempt(job.id, worker="w", ticket="t", lease=60)
    assert attempt is not None
    for _ in range(2):  # as after an answer that was lost
        store.publish(job.id, attempt, frames=3, points=4, timings={}, result_bytes=50)
    assert store.stored_bytes("ann") == 150
    store.retry(job.id)
    assert store.stored_bytes("ann") == 100


def test_workers_tell_what_they_store_and_remove(queue: JobQueue, submit: Submitter) -> None:
    good = dataclasses.replace(submit.record(), owner="ann")
    bad = dataclasses.replace(submit.record(measurements=np.full((20, 9), np.nan)), owner="bob")
    with WorkerPool(queue.settings, 1):
        queue.submit(good)
        queue.submit(bad)
        deadline = time.monotonic() + PATIENCE
        while queue.records.active("ann") or queue.records.stored_bytes("bob"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    folders = (upload_prefix(good.id), results_prefix(good.id))
    keys = [item.key for folder in folders for item in queue.storage.list_prefix(folder)]
    mine = sum(queue.storage.size(key) for key in keys)
    assert queue.records.stored_bytes("ann") == mine > good.inputs["measurements"].bytes
    queue.delete(good.id)
    assert queue.records.stored_bytes("ann") == 0
