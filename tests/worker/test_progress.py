from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from smsr.progress import Progress
from tests.conftest import redis_running
from worker.progress import AttemptOver, ProgressReporter
from worker.records import JobRecord, RecordStore, Verdict

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import RedisProcess


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    return RecordStore(redis_process.client())


@pytest.fixture
def job_id(store: RecordStore) -> str:
    record = JobRecord.new(options={}, inputs={})
    store.create(record)
    store.begin_attempt(record.id, worker="ann", ticket="t", lease=60)
    return record.id


def reporter(store: RecordStore, job_id: str, interval: float = 0.0) -> ProgressReporter:
    return ProgressReporter(store, job_id, 1, interval=interval, lease=60)


def shown(store: RecordStore, job_id: str) -> Progress | None:
    record = store.get(job_id)
    assert record is not None
    return record.progress


def test_reports_are_thinned_out_within_a_stage(store: RecordStore, job_id: str) -> None:
    report = reporter(store, job_id, interval=0.2)
    record = store.get(job_id)
    assert record is not None
    before = record.version
    began = time.monotonic()
    for k in range(500):
        assert report(Progress("cameras", k / 1000, k, 1.0))
    elapsed = time.monotonic() - began
    after = store.get(job_id)
    assert after is not None
    assert 1 <= after.version - before <= 1 + elapsed / 0.2


def test_a_new_stage_is_reported_at_once(store: RecordStore, job_id: str) -> None:
    report = reporter(store, job_id, interval=60)
    for stage in ("reading", "cameras", "shapes"):
        report(Progress(stage, 0.5))
        found = shown(store, job_id)
        assert found is not None
        assert found.stage == stage


def test_the_bar_never_goes_back(store: RecordStore, job_id: str) -> None:
    report = reporter(store, job_id)
    for fraction, expected in ((0.5, 0.5), (0.25, 0.5), (2.0, 1.0)):
        report(Progress("shapes", fraction))
        found = shown(store, job_id)
        assert found is not None
        assert found.fraction == expected


@pytest.mark.parametrize("residual", [float("nan"), float("inf")])
def test_a_residual_that_is_no_number_is_left_out(
    store: RecordStore, job_id: str, residual: float
) -> None:
    reporter(store, job_id)(Progress("shapes", 0.5, 3, residual))
    assert shown(store, job_id) == Progress("shapes", 0.5, 3, None)


def test_the_size_comes_with_a_report(store: RecordStore, job_id: str) -> None:
    report = reporter(store, job_id)
    report.set_size(100, 5000)
    report(Progress("reading", 0.0))
    record = store.get(job_id)
    assert record is not None
    assert (record.frames, record.points) == (100, 5000)


def test_cancelling_and_losing_are_heard(store: RecordStore, job_id: str) -> None:
    report = reporter(store, job_id)
    assert report(Progress("shapes", 0.5)) is True
    store.cancel(job_id)
    assert report(Progress("shapes", 0.6)) is False
    store.release(job_id, "ann", lost=True, max_attempts=9, problem={})
    with pytest.raises(AttemptOver) as lost:
        report(Progress("shapes", 0.7))
    assert lost.value.verdict is Verdict.LOST
    store.delete(job_id)
    with pytest.raises(AttemptOver) as gone:
        report(Progress("shapes", 0.8))
    assert gone.value.verdict is Verdict.GONE


def test_work_goes_on_while_redis_is_away(tmp_path: Path) -> None:
    with redis_running(tmp_path) as server:
        store = RecordStore(server.client())
        record = JobRecord.new(options={}, inputs={})
        store.create(record)
        store.begin_attempt(record.id, worker="ann", ticket="t", lease=60)
        time.sleep(1.1)  # the append-only file is synced every second
        report = ProgressReporter(store, record.id, 1, interval=0, lease=60)
        server.kill()
        began = time.monotonic()
        for k in range(1000):
            assert report(Progress("shapes", k / 2000)) is True
        assert time.monotonic() - began < 10
        server.start()
        time.sleep(1.1)
        assert report(Progress("shapes", 0.75)) is True
        found = shown(store, record.id)
        assert found is not None
        assert found.fraction == 0.75
