"""Jobs that share results, labels and priorities, in whatever order things happen to them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, cast

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from worker import batches
from worker.records import (
    PREFIX,
    PRIORITIES,
    STATUSES,
    InputFile,
    JobRecord,
    Priority,
    RecordStore,
    index_key,
    results_prefix,
    upload_prefix,
)

if TYPE_CHECKING:
    from redis import Redis

    from tests.conftest import RedisProcess

PROBLEM = {"type": "/problems/worker-lost", "title": "Lost", "status": 500, "detail": "Lost."}
FILE = InputFile("uploads/x/measurements", "w.npy", 10, "ab")


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    assert redis_url
    return RecordStore(redis_process.client(), result_ttl=3600)


def created(
    store: RecordStore,
    *,
    owner: str | None = None,
    batch: str | None = "b",
    priority: Priority = "normal",
    ttl: float | None = None,
    digest: str | None = "d",
    reuse: bool = True,
) -> str:
    record = JobRecord.new(
        options={},
        inputs={"measurements": FILE},
        owner=owner,
        batch=batch,
        priority=priority,
        ttl=ttl,
        digest=digest,
    )
    store.create(record, reuse=reuse)
    return record.id


def got(store: RecordStore, job_id: str) -> JobRecord:
    record = store.get(job_id)
    assert record is not None
    return record


def run(store: RecordStore, job_id: str, e3d: float = 0.25) -> None:
    attempt = store.begin_attempt(job_id, worker="ann", ticket=job_id, lease=60)
    assert attempt is not None
    store.publish(job_id, attempt, frames=3, points=4, timings={"total": 1.5}, metrics={"e3d": e3d})


def test_an_equal_job_takes_the_result_over(store: RecordStore) -> None:
    first = created(store)
    run(store, first)
    second = got(store, created(store))
    source = got(store, first)
    assert second.status == "succeeded"
    assert second.reused_from == first
    assert second.result_prefix == source.result_prefix
    assert (second.frames, second.points) == (3, 4)
    assert second.metrics == source.metrics
    assert second.attempt == 0
    assert second.expires_at == pytest.approx(time.time() + 3600, abs=60)
    third = got(store, created(store))
    assert third.reused_from == first
    counters = store.survey(60).counters
    assert (counters.reused, counters.ended) == (2, {"succeeded": 1})


@pytest.mark.parametrize(
    "other", [{"digest": "e"}, {"digest": None}, {"reuse": False}], ids=["digest", "none", "asked"]
)
def test_other_jobs_are_run(store: RecordStore, other: dict[str, object]) -> None:
    run(store, created(store))
    assert got(store, created(store, **other)).status == "queued"  # type: ignore[arg-type]


def test_results_that_have_expired_are_not_taken(store: RecordStore) -> None:
    run(store, created(store, ttl=0.01))
    time.sleep(0.03)
    assert got(store, created(store)).status == "queued"


def test_failed_jobs_share_nothing(store: RecordStore) -> None:
    first = created(store)
    attempt = store.begin_attempt(first, worker="ann", ticket="t", lease=60)
    assert attempt is not None
    store.fail(first, attempt, PROBLEM)
    assert got(store, created(store)).status == "queued"


@pytest.mark.parametrize("first_to_go", [0, 1])
def test_the_last_holder_removes_a_result(store: RecordStore, first_to_go: int) -> None:
    maker = created(store)
    run(store, maker)
    jobs = [maker, created(store)]
    result = got(store, maker).result_prefix
    _, _, unwanted = store.delete(jobs[first_to_go])
    assert not any(str(result).startswith(prefix) for prefix in (*unwanted, *store.garbage()))
    _, _, unwanted = store.delete(jobs[1 - first_to_go])
    assert any(str(result).startswith(prefix) for prefix in unwanted)
    assert any(str(result).startswith(prefix) for prefix in store.garbage())
    for prefix in store.garbage():
        store.forget_garbage(prefix)
    assert store.redis.keys("*") == [f"{PREFIX}:counters".encode()]


def test_running_a_job_again_leaves_its_result_to_those_who_took_it(store: RecordStore) -> None:
    maker = created(store)
    run(store, maker)
    taker = created(store)
    result = got(store, taker).result_prefix
    assert store.retry(maker) == "ok"
    assert result not in store.garbage()
    run(store, maker, e3d=0.5)
    assert got(store, maker).result_prefix != result
    assert result not in store.garbage()
    assert store.retry(taker) == "ok"
    assert got(store, taker).reused_from is None
    assert result in store.garbage()


@pytest.mark.parametrize(("asked", "kept"), [(None, 3600), (10, 10), (0, None)])
def test_a_job_is_kept_as_long_as_it_asked(
    store: RecordStore, asked: float | None, kept: float | None
) -> None:
    job = created(store, ttl=asked)
    run(store, job)
    record = got(store, job)
    assert record.ttl == asked
    if kept is None:
        assert record.expires_at is None
        assert store.redis.zcard(f"{PREFIX}:expiry") == 0
    else:
        assert record.finished_at is not None
        assert record.expires_at == pytest.approx(record.finished_at + kept)


def test_a_batch_is_summarised(store: RecordStore) -> None:
    for e3d in (0.5, 0.125, 0.25, 0.125):
        run(store, created(store, digest=None), e3d)
    started = created(store, digest=None)
    attempt = store.begin_attempt(started, worker="ann", ticket="t", lease=60)
    assert attempt is not None
    created(store, digest=None)
    created(store, digest=None, batch="other")
    found = batches.get(store, None, "b")
    assert found is not None
    assert found.counts.jobs == {
        "queued": 1, "running": 1, "succeeded": 4, "failed": 0, "cancelled": 0,
    }  # fmt: skip
    assert found.e3d == batches.Spread(4, 1.0, 0.25, 0.1875, 0.125, 0.5)
    assert found.seconds is not None
    assert found.seconds.count == 4
    assert found.progress == pytest.approx(4 / 6)
    assert found.finished_at is None
    listed, following = batches.labels(store, None, None, 10)
    assert [counts.label for counts in listed] == ["other", "b"]
    assert following is None
    assert batches.get(store, None, "nothing") is None


def test_owners_have_batches_of_their_own(store: RecordStore) -> None:
    mine, theirs = (created(store, owner=owner) for owner in ("ann", "bob"))
    for owner, job in (("ann", mine), ("bob", theirs)):
        assert [r.id for r in store.list(owner=owner, batch="b").records] == [job]
        found = batches.get(store, owner, "b")
        assert found is not None
        assert found.counts.total == 1
    assert batches.get(store, "eve", "b") is None
    everyone = batches.get(store, None, "b")
    assert everyone is not None
    assert everyone.counts.total == 2


class Sharing(RuleBasedStateMachine):
    """Jobs of two digests, two labels and two owners that come, end, are retried and go."""

    redis: Redis

    def __init__(self) -> None:
        super().__init__()
        self.redis.flushall()
        self.store = RecordStore(self.redis, result_ttl=3600)
        self.jobs: list[str] = []
        self.tickets = 0

    def one(self, number: int) -> str:
        return self.jobs[number % len(self.jobs)]

    @rule(
        owner=st.sampled_from([None, "me"]),
        batch=st.sampled_from([None, "b", "c"]),
        priority=st.sampled_from(PRIORITIES),
        digest=st.sampled_from([None, "d", "e"]),
        reuse=st.booleans(),
    )
    def create(
        self,
        owner: str | None,
        batch: str | None,
        priority: Priority,
        digest: str | None,
        reuse: bool,
    ) -> None:
        there = [r for r in self.records() if r.status == "succeeded" and r.digest == digest]
        job = created(
            self.store, owner=owner, batch=batch, priority=priority, digest=digest, reuse=reuse
        )
        taken = bool(reuse and digest and there)
        assert (got(self.store, job).status == "succeeded") == taken
        self.jobs.append(job)

    @precondition(lambda self: self.jobs)
    @rule(number=st.integers(0, 9), end=st.sampled_from(["publish", "fail", "hold"]))
    def work(self, number: int, end: str) -> None:
        job = self.one(number)
        self.tickets += 1
        attempt = self.store.begin_attempt(job, worker="w", ticket=str(self.tickets), lease=60)
        if attempt is None:
            attempt = got(self.store, job).attempt
        if end == "publish":
            self.store.publish(
                job, attempt, frames=3, points=4, timings={}, metrics={"e3d": number / 8}
            )
        elif end == "fail":
            self.store.fail(job, attempt, PROBLEM)

    @precondition(lambda self: self.jobs)
    @rule(number=st.integers(0, 9))
    def cancel(self, number: int) -> None:
        self.store.cancel(self.one(number))

    @precondition(lambda self: self.jobs)
    @rule(numbers=st.lists(st.integers(0, 9), min_size=1, max_size=3))
    def retry(self, numbers: list[int]) -> None:
        self.store.retry_many([self.one(number) for number in numbers])

    @precondition(lambda self: self.jobs)
    @rule(numbers=st.lists(st.integers(0, 9), min_size=1, max_size=3))
    def delete(self, numbers: list[int]) -> None:
        chosen = {self.one(number) for number in numbers}
        self.store.delete_many([*chosen])
        self.jobs = [job for job in self.jobs if job not in chosen]

    def records(self) -> list[JobRecord]:
        return [got(self.store, job) for job in self.jobs]

    def members(self, key: str) -> set[str]:
        found = cast("list[bytes]", self.redis.zrange(key, 0, -1))
        return {member.decode() for member in found}

    def keys(self, pattern: str) -> set[str]:
        return {key.decode() for key in cast("list[bytes]", self.redis.keys(pattern))}

    @invariant()
    def the_indices_agree_with_the_records(self) -> None:
        records = self.records()
        for owner in (None, "me"):
            visible = [r for r in records if owner is None or r.owner == owner]
            scope = f"@{owner}" if owner else ""
            labels = {r.batch for r in visible if r.batch}
            assert self.members(f"{PREFIX}:batches{scope}") == labels
            for batch in (None, "b", "c"):
                chosen = [r for r in visible if batch is None or r.batch == batch]
                for status in STATUSES:
                    expected = {r.id for r in chosen if r.status == status}
                    assert self.members(index_key(status, owner, batch)) == expected
                assert self.members(index_key(None, owner, batch)) == {r.id for r in chosen}
                if batch is not None:
                    done = {r.id for r in chosen if r.status == "succeeded"}
                    ran = {r.id for r in chosen if r.id in done and r.reused_from is None}
                    ended = {r.id for r in chosen if r.final}
                    assert self.members(f"{PREFIX}:e3d{scope}#{batch}") == done
                    assert self.members(f"{PREFIX}:seconds{scope}#{batch}") == ran
                    assert self.members(f"{PREFIX}:ended{scope}#{batch}") == ended
        for priority in PRIORITIES:
            waiting = {r.id for r in records if (r.status, r.priority) == ("queued", priority)}
            assert self.members(f"{PREFIX}:jobs:queued:{priority}") == waiting

    @invariant()
    def what_is_offered_is_there(self) -> None:
        for digest in ("d", "e"):
            done = {r.id for r in self.records() if (r.status, r.digest) == ("succeeded", digest)}
            assert self.members(f"{PREFIX}:equal:{digest}") == done

    @invariant()
    def a_result_is_garbage_when_and_only_when_nobody_holds_it(self) -> None:
        records = self.records()
        garbage = self.members(f"{PREFIX}:garbage")
        results = {r.result_prefix for r in records if r.result_prefix is not None}
        for result in results:
            assert not any(result.startswith(prefix) for prefix in garbage)
        for key in self.keys(f"{PREFIX}:holders:*"):
            holders = {job.decode() for job in cast("set[bytes]", self.redis.smembers(key))}
            result = key.removeprefix(f"{PREFIX}:holders:")
            assert holders == {r.id for r in records if r.result_prefix == result}
        for record in records:
            for attempt in range(1, record.attempt):
                former = f"{results_prefix(record.id)}{attempt}/"
                assert (former in garbage) == (former not in results)
            assert upload_prefix(record.id) not in garbage

    @invariant()
    def nothing_is_left_of_nothing(self) -> None:
        if not self.jobs:
            assert self.keys("*") <= {f"{PREFIX}:counters", f"{PREFIX}:garbage"}


def test_no_order_of_steps_breaks_what_jobs_share(redis_process: RedisProcess) -> None:
    Sharing.redis = redis_process.client()
    run_machine(
        Sharing,
        settings=settings(
            max_examples=40,
            stateful_step_count=25,
            deadline=None,
            phases=[Phase.reuse, Phase.generate],  # shrinking takes minutes
            suppress_health_check=list(HealthCheck),
        ),
    )
