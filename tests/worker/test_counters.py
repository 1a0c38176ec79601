from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.worker.test_records import LEASE, PROBLEM, begun, created
from worker.counters import BOUNDS, SIZES, Counters, Histogram, decode
from worker.records import PREFIX, RecordStore

if TYPE_CHECKING:
    from tests.conftest import RedisProcess

INVALID = PROBLEM | {"type": "/problems/not-finite"}


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    return RecordStore(redis_process.client())


def counted(store: RecordStore) -> Counters:
    return store.survey(60).counters


def publish(store: RecordStore, job_id: str, attempt: int, points: int = 4, **stages: float) -> str:
    timings = {"queued": 7.0, **stages, "total": 99.0}
    return store.publish(job_id, attempt, frames=10, points=points, timings=timings)


def test_nothing_is_counted_of_an_empty_queue(store: RecordStore) -> None:
    survey = store.survey(60)
    assert survey.counters == Counters()
    assert (survey.workers, set(survey.jobs.values())) == (0, {0})


def test_a_success_sent_twice_is_counted_once(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    begun(store, job_id)  # the same worker again, with the same ticket
    for _ in range(2):
        assert publish(store, job_id, attempt, opening=0.05, cameras=30.0) == "ok"
    found = counted(store)
    assert (found.ended, found.failures, found.lost) == ({"succeeded": 1}, {}, 0)
    assert (found.waits.count, set(found.runs), found.runs["small"].count) == (1, {"small"}, 1)
    assert {name: (h.count, h.sum) for name, h in found.stages.items()} == {
        "opening": (1, 0.05),
        "cameras": (1, 30.0),
    }
    assert found.stages["opening"].buckets[BOUNDS.index(0.05)] == 1  # bounds belong to them
    assert found.stages["cameras"].buckets[BOUNDS.index(50)] == 1


def test_a_failure_sent_twice_is_counted_once(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    for _ in range(2):
        store.fail(job_id, attempt, INVALID)
    found = counted(store)
    assert (found.ended, found.failures) == ({"failed": 1}, {"not-finite": 1})
    assert found.runs["unknown"].count == 1
    assert store.survey(60).jobs["failed"] == 1


def test_a_job_that_never_ran_has_no_run_time(store: RecordStore) -> None:
    store.cancel(created(store))
    again = created(store)
    begun(store, again)
    store.release(again, "ann", lost=False, max_attempts=9, problem=PROBLEM)
    for _ in range(2):
        store.cancel(again)
    found = counted(store)
    assert (found.ended, found.runs, found.lost) == ({"cancelled": 2}, {}, 0)
    assert found.waits.count == 1


def test_lost_attempts_are_counted_wherever_they_are_noticed(store: RecordStore) -> None:
    job_id = created(store)
    begun(store, job_id, ticket="a")
    for _ in range(2):
        store.release(job_id, "ann", lost=True, max_attempts=2, problem=PROBLEM)
    assert (counted(store).lost, counted(store).ended) == (1, {})
    store.begin_attempt(job_id, worker="ann", ticket="b", lease=-1)
    for _ in range(3):
        store.expire_leases(grace=0.0, max_attempts=2, problem=PROBLEM)
    found = counted(store)
    assert (found.lost, found.failures, found.waits.count) == (2, {"worker-lost": 1}, 2)


def test_the_wait_of_a_retried_job_begins_at_the_retry(store: RecordStore) -> None:
    job_id = created(store)
    publish(store, job_id, begun(store, job_id))
    time.sleep(0.5)
    assert counted(store).waits.sum < 0.25
    store.retry(job_id)
    publish(store, job_id, begun(store, job_id, ticket="u"))
    found = counted(store)
    assert found.waits.count == 2
    assert found.waits.sum < 0.5
    assert found.ended == {"succeeded": 2}


def test_run_time_is_that_of_the_last_attempt(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    time.sleep(0.25)
    publish(store, job_id, attempt)
    runs = counted(store).runs["small"]
    record = store.get(job_id)
    assert record is not None
    assert record.started_at is not None
    assert record.finished_at is not None
    assert runs.sum == pytest.approx(record.finished_at - record.started_at, abs=1e-4)
    assert runs.sum >= 0.25
    assert sum(runs.buckets[: BOUNDS.index(0.2) + 1]) == 0


@pytest.mark.parametrize(
    ("points", "size"),
    [(9_999, "small"), (10_000, "medium"), (999_999, "medium"), (1_000_000, "large")],
)
def test_size_classes(store: RecordStore, points: int, size: str) -> None:
    job_id = created(store)
    publish(store, job_id, begun(store, job_id), points=points)
    assert set(counted(store).runs) == {size}
    assert size in SIZES


def test_workers_are_alive_by_their_last_sign(store: RecordStore) -> None:
    store.sign_of_life("ann")
    store.sign_of_life("bob")
    store.redis.zadd(f"{PREFIX}:workers", {"bob": time.time() - 30})
    assert store.survey(10).workers == 1
    assert store.survey(60).workers == store.workers_since(60) == 2


def test_counts_of_another_version_are_kept(store: RecordStore) -> None:
    fields = {b"wait:0.7": b"2", b"wait:1": b"1", b"wait:86400": b"3", b"wait:sum": b"9.5"}
    found = decode(fields | {b"of another kind": b"x", b"lost": b"4"})
    assert found.waits.buckets[BOUNDS.index(1)] == 3
    assert (found.waits.buckets[-1], found.waits.count, found.waits.sum) == (3, 6, 9.5)
    assert found.lost == 4


@settings(deadline=None)
@given(st.lists(st.floats(0, 1e5), max_size=20))
def test_a_histogram_has_each_duration_in_one_bucket(
    redis_process: RedisProcess, seconds: list[float]
) -> None:
    redis_process.client().flushall()
    store = RecordStore(redis_process.client())
    for duration in seconds:
        job_id = created(store)
        publish(store, job_id, begun(store, job_id), cameras=duration)
    found = counted(store).stages.get("cameras", Histogram())
    limits = [-1.0, *BOUNDS, float("inf")]
    expected = [
        sum(low < duration <= high for duration in seconds)
        for low, high in itertools.pairwise(limits)
    ]
    assert found.buckets == expected
    assert found.sum == pytest.approx(sum(seconds), abs=1e-4)


def test_a_late_start_is_no_start(store: RecordStore) -> None:
    job_id = created(store)
    store.cancel(job_id)
    assert store.begin_attempt(job_id, worker="ann", ticket="t", lease=LEASE) is None
    assert counted(store).waits.count == 0


def test_a_survey_costs_the_same_however_many_jobs_there_are(store: RecordStore) -> None:
    def commands() -> int:
        info: dict[str, int] = store.redis.info("stats")
        return info["total_commands_processed"]

    costs = []
    for _ in range(3):
        store.survey(60)  # connected
        before = commands()
        store.survey(60)
        costs.append(commands() - before)
        for _ in range(20):
            job_id = created(store)
            publish(store, job_id, begun(store, job_id), cameras=1.0)
    assert len(set(costs)) == 1
