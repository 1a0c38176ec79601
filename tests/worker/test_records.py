from __future__ import annotations

import dataclasses
import time
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from smsr.progress import Progress
from worker.records import (
    FINAL,
    PREFIX,
    STATUSES,
    InputFile,
    JobExists,
    JobRecord,
    RecordStore,
    Verdict,
    new_job_id,
    result_prefix,
)

if TYPE_CHECKING:
    from redis import Redis

    from tests.conftest import RedisProcess

PROBLEM = {"type": "/problems/worker-lost", "title": "Lost", "status": 500, "detail": "Lost."}
LEASE = 60.0


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    return RecordStore(redis_process.client(), result_ttl=3600)


INPUT = InputFile("uploads/x/measurements", "tracks.npy", 100, "ab")
RESULT_BYTES = 1000


def new(**fields: object) -> JobRecord:
    record = JobRecord.new(options={"preset": "paper"}, inputs={"measurements": INPUT})
    return dataclasses.replace(record, **fields)  # type: ignore[arg-type]


def created(store: RecordStore, **fields: object) -> str:
    record = new(**fields)
    store.create(record)
    return record.id


def begun(store: RecordStore, job_id: str, worker: str = "ann", ticket: str = "t") -> int:
    attempt = store.begin_attempt(job_id, worker=worker, ticket=ticket, lease=LEASE)
    assert attempt is not None
    return attempt


def published(store: RecordStore, job_id: str, attempt: int) -> Verdict:
    return store.publish(
        job_id,
        attempt,
        frames=3,
        points=4,
        timings={"cameras": 0.5, "total": 1.5},
        result_bytes=RESULT_BYTES,
    )


def got(store: RecordStore, job_id: str) -> JobRecord:
    record = store.get(job_id)
    assert record is not None
    return record


def test_a_record_comes_back_as_it_was_given(store: RecordStore) -> None:
    file = InputFile("uploads/x/measurements", "tracks é.npy", 123, "ab", "application/npy")
    record = JobRecord.new(
        options={"preset": "paper", "time_limit": None},
        inputs={"measurements": file},
        name="a face",
        owner="ann",
        frames=10,
        points=1000,
    )
    store.create(record)
    found = got(store, record.id)
    assert found.queued_at == found.created_at
    stamped = dataclasses.replace(record, created_at=found.created_at, queued_at=found.queued_at)
    assert dataclasses.replace(found, version=0) == stamped
    assert abs(found.created_at - time.time()) < 5


def test_an_id_is_taken_once(store: RecordStore) -> None:
    record = new()
    store.create(record)
    with pytest.raises(JobExists):
        store.create(record)


def test_an_unknown_job(store: RecordStore) -> None:
    job_id = new_job_id()
    assert store.get(job_id) is None
    assert store.begin_attempt(job_id, worker="ann", ticket="t", lease=LEASE) is None
    assert store.cancel(job_id) == ("gone", "")
    assert store.retry(job_id) == "gone"
    assert store.delete(job_id) == ("gone", "", [])
    assert published(store, job_id, 1) is Verdict.GONE
    assert store.renew(job_id, worker="ann", lease=LEASE).state == "gone"


def test_success(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    report = Progress("cameras", 0.25, 7, 1e-3)
    verdict = store.report_progress(job_id, attempt, report, lease=LEASE, frames=3, points=4)
    assert verdict is Verdict.OK
    running = got(store, job_id)
    assert (running.status, running.worker, running.attempt) == ("running", "ann", 1)
    assert (running.progress, running.frames, running.points) == (report, 3, 4)
    assert running.started_at is not None
    assert running.started_at >= running.created_at

    metrics = {"e3d": 0.125}
    verdict = store.publish(
        job_id, attempt, frames=3, points=4, timings={"total": 1.5}, metrics=metrics
    )
    assert verdict is Verdict.OK
    done = got(store, job_id)
    assert (done.status, done.final, done.worker) == ("succeeded", True, None)
    assert done.result_prefix == result_prefix(job_id, 1)
    assert (done.metrics, done.timings) == (metrics, {"total": 1.5})
    assert done.finished_at is not None
    assert done.expires_at == pytest.approx(done.finished_at + 3600)


def test_each_visible_change_raises_the_version(store: RecordStore) -> None:
    job_id = created(store)
    versions = [got(store, job_id).version]
    attempt = begun(store, job_id)
    versions.append(got(store, job_id).version)
    store.report_progress(job_id, attempt, Progress("cameras", 0.5), lease=LEASE)
    versions.append(got(store, job_id).version)
    published(store, job_id, attempt)
    versions.append(got(store, job_id).version)
    assert versions == sorted(set(versions))


def test_beginning_again_with_the_same_ticket_is_the_same_attempt(store: RecordStore) -> None:
    job_id = created(store)
    assert begun(store, job_id, "ann", "t") == begun(store, job_id, "ann", "t") == 1
    assert store.begin_attempt(job_id, worker="ann", ticket="u", lease=LEASE) is None
    assert store.begin_attempt(job_id, worker="bob", ticket="t", lease=LEASE) is None


def test_publishing_twice_is_publishing_once(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    assert published(store, job_id, attempt) is Verdict.OK
    before = got(store, job_id)
    assert published(store, job_id, attempt) is Verdict.OK
    assert got(store, job_id) == before


def test_a_replaced_attempt_can_do_nothing(store: RecordStore) -> None:
    job_id = created(store)
    zombie = begun(store, job_id, "ann", "t")
    assert take_back(store, job_id, "ann") == "queued"
    for _ in ("queued again", "running elsewhere"):
        assert published(store, job_id, zombie) is Verdict.LOST
        assert store.fail(job_id, zombie, PROBLEM) is Verdict.LOST
        assert store.stop(job_id, zombie) is Verdict.LOST
        report = Progress("shapes", 0.9)
        assert store.report_progress(job_id, zombie, report, lease=LEASE) is Verdict.LOST
        begun(store, job_id, "bob", "u")
        assert store.renew(job_id, worker="ann", lease=LEASE).state == "lost"
        assert take_back(store, job_id, "ann") == "lost"
    assert got(store, job_id).worker == "bob"
    assert got(store, job_id).progress is None
    assert published(store, job_id, zombie + 1) is Verdict.OK
    assert published(store, job_id, zombie) is Verdict.LOST
    assert got(store, job_id).result_prefix == result_prefix(job_id, zombie + 1)


def take_back(store: RecordStore, job_id: str, worker: str, most: int = 12) -> str:
    return store.release(job_id, worker, lost=True, max_attempts=most, problem=PROBLEM)


def test_what_other_attempts_wrote_is_garbage(store: RecordStore) -> None:
    job_id = created(store)
    for ticket in "abc":
        begun(store, job_id, "ann", ticket)
        take_back(store, job_id, "ann")
    published(store, job_id, begun(store, job_id, "ann", "d"))
    assert set(store.garbage()) == {result_prefix(job_id, k) for k in (1, 2, 3)}


def test_a_job_is_not_lost_for_ever(store: RecordStore) -> None:
    job_id = created(store)
    for ticket in ("a", "b"):
        begun(store, job_id, "ann", ticket)
        assert take_back(store, job_id, "ann", most=3) == "queued"
    begun(store, job_id, "ann", "c")
    assert take_back(store, job_id, "ann", most=3) == "failed"
    failed = got(store, job_id)
    assert (failed.status, failed.problem, failed.lost_attempts) == ("failed", PROBLEM, 3)


def test_a_job_that_is_handed_back_has_lost_nothing(store: RecordStore) -> None:
    job_id = created(store)
    begun(store, job_id)
    outcome = store.release(job_id, "ann", lost=False, max_attempts=1, problem=PROBLEM)
    assert outcome == "queued"
    assert got(store, job_id).lost_attempts == 0


def test_cancelling_a_queued_job_ends_it(store: RecordStore) -> None:
    job_id = created(store)
    store.assign_ticket(job_id, "the ticket")
    assert store.cancel(job_id) == ("cancelled", "the ticket")
    assert got(store, job_id).status == "cancelled"
    assert store.cancel(job_id) == ("finished", "")
    assert store.begin_attempt(job_id, worker="ann", ticket="t", lease=LEASE) is None


def test_cancelling_a_running_job_asks_it_to_stop(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    assert store.renew(job_id, worker="ann", lease=LEASE).cancel_seconds is None
    assert store.cancel(job_id) == ("requested", "")
    asked = got(store, job_id)
    assert (asked.status, asked.cancel_requested) == ("running", True)
    hold = store.renew(job_id, worker="ann", lease=LEASE)
    assert hold.cancel_seconds is not None
    assert hold.cancel_seconds >= 0
    report = Progress("shapes", 0.5)
    assert store.report_progress(job_id, attempt, report, lease=LEASE) is Verdict.CANCELLED
    assert published(store, job_id, attempt) is Verdict.CANCELLED
    assert store.fail(job_id, attempt, PROBLEM) is Verdict.CANCELLED
    assert store.stop(job_id, attempt) is Verdict.CANCELLED
    ended = got(store, job_id)
    assert (ended.status, ended.progress, ended.problem) == ("cancelled", None, None)


def test_a_cancelled_job_whose_worker_died_is_not_run_again(store: RecordStore) -> None:
    job_id = created(store)
    begun(store, job_id)
    store.cancel(job_id)
    assert take_back(store, job_id, "ann") == "cancelled"
    assert got(store, job_id).status == "cancelled"


def test_stopping_needs_a_request(store: RecordStore) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    assert store.stop(job_id, attempt) is Verdict.OK
    assert got(store, job_id).status == "running"


@pytest.mark.parametrize("end", ["succeeded", "failed", "cancelled"])
def test_an_ended_job_can_be_run_again(store: RecordStore, end: str) -> None:
    job_id = created(store)
    attempt = begun(store, job_id)
    assert store.retry(job_id) == "active"
    match end:
        case "succeeded":
            published(store, job_id, attempt)
        case "failed":
            store.fail(job_id, attempt, PROBLEM)
        case _:
            store.cancel(job_id)
            store.stop(job_id, attempt)
    assert got(store, job_id).status == end
    assert store.retry(job_id) == "ok"
    again = got(store, job_id)
    assert (again.status, again.problem, again.result_prefix) == ("queued", None, None)
    assert (again.finished_at, again.expires_at, again.cancel_requested) == (None, None, False)
    assert result_prefix(job_id, attempt) in store.garbage()
    assert begun(store, job_id, "ann", "later") == attempt + 1
    assert published(store, job_id, attempt) is Verdict.LOST


def test_only_expired_jobs_are_deleted_when_asked_so(store: RecordStore) -> None:
    store.result_ttl = 0.01
    job_id = created(store)
    assert store.delete(job_id, only_expired=True)[0] == "kept"
    published(store, job_id, begun(store, job_id))
    time.sleep(0.02)
    assert store.expired() == [job_id]
    assert store.delete(job_id, only_expired=True)[0] == "ok"
    assert store.get(job_id) is None
    assert store.expired() == []


def test_deleting_leaves_only_the_list_of_garbage_and_the_counts(store: RecordStore) -> None:
    job_id = created(store, owner="ann")
    published(store, job_id, begun(store, job_id))
    unwanted = [f"results/{job_id}/", f"uploads/{job_id}/"]
    assert store.delete(job_id) == ("ok", "", unwanted)
    counters = f"{PREFIX}:counters".encode()
    assert set(store.redis.keys("*")) == {counters, f"{PREFIX}:garbage".encode()}
    assert set(store.garbage()) == {f"uploads/{job_id}/", f"results/{job_id}/"}
    for prefix in store.garbage():
        store.forget_garbage(prefix)
    assert store.redis.keys("*") == [counters]


def test_a_silent_worker_loses_its_job_at_the_second_look(store: RecordStore) -> None:
    job_id = created(store)
    store.begin_attempt(job_id, worker="ann", ticket="t", lease=0.01)
    time.sleep(0.02)
    assert look(store) == {}
    assert look(store) == {job_id: "queued"}
    assert got(store, job_id).lost_attempts == 1


def test_a_worker_that_comes_back_in_between_keeps_its_job(store: RecordStore) -> None:
    job_id = created(store)
    store.begin_attempt(job_id, worker="ann", ticket="t", lease=0.01)
    time.sleep(0.02)
    look(store)
    assert store.renew(job_id, worker="ann", lease=0.01).state == "held"
    time.sleep(0.02)
    assert look(store) == {}


def look(store: RecordStore) -> dict[str, str]:
    return store.expire_leases(grace=0.0, max_attempts=12, problem=PROBLEM)


def test_queued_jobs_without_a_ticket_are_found(store: RecordStore) -> None:
    with_ticket, without, started = (created(store) for _ in range(3))
    store.assign_ticket(with_ticket, "x")
    store.redis.rpush("tickets", "x")
    begun(store, started)
    assert store.without_ticket(0, ["tickets"]) == []
    assert store.without_ticket(60, ["tickets"]) == []
    assert store.without_ticket(0, ["tickets"]) == [without]
    store.assign_ticket(without, "y")  # on its way to the list
    assert store.without_ticket(0, ["tickets"]) == []
    store.redis.rpush("tickets", "y")
    assert store.without_ticket(0, ["tickets"]) == []


def test_listing_newest_first_in_stable_pages(store: RecordStore) -> None:
    ids = [created(store, owner="ann" if k % 2 else "bob") for k in range(7)][::-1]
    first = store.list(limit=3)
    assert [r.id for r in first.records] == ids[:3]
    created(store)
    store.delete(ids[3])
    second = store.list(cursor=first.next_cursor, limit=3)
    assert [r.id for r in second.records] == ids[4:]
    assert second.next_cursor is None
    assert [r.id for r in store.list(owner="bob").records] == [j for j in ids[::2] if j != ids[3]]


def test_jobs_of_one_instant_are_all_listed_once(store: RecordStore) -> None:
    ids = [created(store) for _ in range(9)]
    store.redis.zadd(f"{PREFIX}:jobs", dict.fromkeys(ids, 1000.25))
    seen: list[str] = []
    cursor = None
    while True:
        page = store.list(cursor=cursor, limit=2)
        seen += [record.id for record in page.records]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert sorted(seen) == sorted(ids)


def test_listing_by_status(store: RecordStore) -> None:
    queued, running = created(store), created(store)
    begun(store, running)
    assert [r.id for r in store.list("queued").records] == [queued]
    assert [r.id for r in store.list("running").records] == [running]
    assert store.count() == {
        "queued": 1, "running": 1, "succeeded": 0, "failed": 0, "cancelled": 0,
    }  # fmt: skip


@pytest.mark.parametrize("cursor", ["", "x", "1:", "nan:abc", "1.5:abc"])
def test_a_cursor_that_no_page_gave(store: RecordStore, cursor: str) -> None:
    with pytest.raises(ValueError, match="cursor"):
        store.list(cursor=cursor)


def test_signs_of_life(store: RecordStore) -> None:
    store.sign_of_life("ann")
    store.sign_of_life("bob")
    assert store.workers_since(60) == 2
    store.sign_off("ann")
    assert store.workers_since(60) == 1


SLOTS = st.sampled_from([0, 1])
BEHIND = st.sampled_from([0, 0, 1])
"""How many attempts a worker has missed."""
WORKERS = st.sampled_from(["ann", "bob"])


class Lives(RuleBasedStateMachine):
    """All lives two jobs can have, with workers that die, come back and act too late."""

    redis: Redis

    def __init__(self) -> None:
        super().__init__()
        self.redis.flushall()
        self.store = RecordStore(self.redis)
        self.jobs = [created(self.store, owner="me"), created(self.store)]
        self.running: dict[str, int] = {}
        self.ended: dict[str, tuple[str, int]] = {}
        self.asked: set[str] = set()
        self.ticket = 0
        self.counted: Counter[str] = Counter()

    @rule(slot=SLOTS, worker=WORKERS)
    def begin(self, slot: int, worker: str) -> None:
        job = self.jobs[slot]
        self.ticket += 1
        attempt = self.store.begin_attempt(job, worker=worker, ticket=str(self.ticket), lease=-1)
        if attempt is None:
            assert job in self.running or job in self.ended
        else:
            assert job not in self.running
            assert job not in self.ended
            self.running[job] = attempt
            self.counted["begun"] += 1

    def which(self, slot: int, behind: int) -> tuple[str, int]:
        job = self.jobs[slot]
        return job, got(self.store, job).attempt - behind

    def expected(self, job: str, attempt: int) -> Verdict:
        if self.running.get(job) != attempt:
            return Verdict.LOST
        return Verdict.CANCELLED if job in self.asked else Verdict.OK

    def end(self, job: str, attempt: int, status: str) -> None:
        del self.running[job]
        self.asked.discard(job)
        self.ended[job] = (status, attempt)
        self.counted[status] += 1
        self.counted["run"] += 1

    @rule(slot=SLOTS, behind=BEHIND)
    def report(self, slot: int, behind: int) -> None:
        which = self.which(slot, behind)
        verdict = self.store.report_progress(*which, Progress("shapes", 0.5), lease=-1)
        assert verdict is self.expected(*which)

    @rule(slot=SLOTS, behind=BEHIND)
    def publish(self, slot: int, behind: int) -> None:
        which = self.which(slot, behind)
        expected = self.expected(*which)
        if self.ended.get(which[0]) == ("succeeded", which[1]):
            expected = Verdict.OK
        assert published(self.store, *which) is expected
        if which[0] in self.running and expected is Verdict.OK:
            self.end(*which, "succeeded")

    @rule(slot=SLOTS, behind=BEHIND)
    def fail(self, slot: int, behind: int) -> None:
        which = self.which(slot, behind)
        expected = self.expected(*which)
        if self.ended.get(which[0]) == ("failed", which[1]):
            expected = Verdict.OK
        assert self.store.fail(*which, PROBLEM) is expected
        if which[0] in self.running and expected is Verdict.OK:
            self.end(*which, "failed")

    @rule(slot=SLOTS, behind=BEHIND)
    def stop(self, slot: int, behind: int) -> None:
        which = self.which(slot, behind)
        expected = self.expected(*which)
        if self.ended.get(which[0], ("",))[0] == "cancelled":
            expected = Verdict.CANCELLED
        assert self.store.stop(*which) is expected
        if which[0] in self.running and expected is Verdict.CANCELLED:
            self.end(*which, "cancelled")

    def taken(self, job: str, outcome: str) -> None:
        attempt = self.running[job]
        asked = job in self.asked
        assert outcome == "cancelled" if asked else outcome in ("queued", "failed")
        if outcome == "queued":
            del self.running[job]
        else:
            self.end(job, attempt, outcome)

    @rule(slot=SLOTS, behind=BEHIND, lost=st.booleans())
    def release(self, slot: int, behind: int, lost: bool) -> None:
        job, attempt = self.which(slot, behind)
        outcome = self.store.release(job, attempt, lost=lost, max_attempts=3, problem=PROBLEM)
        if self.running.get(job) == attempt:
            self.taken(job, outcome)
        else:
            assert outcome in ("lost", "gone")

    @precondition(lambda self: self.running)
    @rule()
    def expire(self) -> None:
        outcomes = self.store.expire_leases(grace=0, max_attempts=3, problem=PROBLEM)
        for job, outcome in outcomes.items():
            self.taken(job, outcome)

    @rule(slot=SLOTS)
    def cancel(self, slot: int) -> None:
        job = self.jobs[slot]
        record = got(self.store, job)
        outcome, _ = self.store.cancel(job)
        if job in self.running:
            assert outcome == "requested"
            self.asked.add(job)
        elif job in self.ended:
            assert outcome == "finished"
        else:
            assert outcome == "cancelled"
            self.ended[job] = ("cancelled", record.attempt)
            self.counted["cancelled"] += 1

    @rule(slot=SLOTS)
    def retry(self, slot: int) -> None:
        job = self.jobs[slot]
        outcome = self.store.retry(job)
        assert (outcome == "ok") == (job in self.ended)
        self.ended.pop(job, None)

    @rule(slot=SLOTS)
    def delete_and_submit_another(self, slot: int) -> None:
        job = self.jobs[slot]
        assert self.store.delete(job)[0] == "ok"
        self.running.pop(job, None)
        self.ended.pop(job, None)
        self.asked.discard(job)
        assert published(self.store, job, 1) is Verdict.GONE
        self.jobs[slot] = created(self.store, owner="me" if slot == 0 else None)

    @invariant()
    def the_record_says_what_happened(self) -> None:
        listed = {record.id: record for record in self.store.list(limit=1000).records}
        for job, record in listed.items():
            if job in self.running:
                assert (record.status, record.attempt) == ("running", self.running[job])
                assert record.worker is not None
            elif job in self.ended:
                assert (record.status, record.attempt) == self.ended[job]
                assert record.finished_at is not None
            else:
                assert record.status == "queued"
            assert (record.result_prefix is not None) == (record.status == "succeeded")
            assert (record.problem is not None) == (record.status == "failed")
            assert record.cancel_requested == (job in self.asked or record.status == "cancelled")

    @invariant()
    def the_indices_agree_with_the_records(self) -> None:
        listed = self.store.list(limit=1000).records
        for owner in (None, "me"):
            mine = [record for record in listed if owner is None or record.owner == owner]
            for status in STATUSES:
                found = {r.id for r in self.store.list(status, limit=1000, owner=owner).records}
                assert found == {record.id for record in mine if record.status == status}
        assert self.redis.zcard(f"{PREFIX}:leases") == len(self.running)
        for job in self.running:
            assert self.redis.zscore(f"{PREFIX}:leases", job) is not None

    @invariant()
    def what_an_owner_stores_is_what_its_jobs_have(self) -> None:
        jobs = self.store.list(limit=1000, owner="me").records
        expected = sum(INPUT.bytes + RESULT_BYTES * (j.status == "succeeded") for j in jobs)
        assert self.store.stored_bytes("me") == expected
        assert set(self.redis.hkeys(f"{PREFIX}:stored")) <= {b"me"}

    @invariant()
    def each_end_and_each_start_is_counted_once(self) -> None:
        counters = self.store.survey(60).counters
        assert counters.ended == {s: n for s, n in self.counted.items() if s in FINAL}
        assert sum(counters.failures.values()) == self.counted["failed"]
        assert counters.waits.count == self.counted["begun"]
        assert sum(runs.count for runs in counters.runs.values()) == self.counted["run"]
        stages = [stage.count for stage in counters.stages.values()]
        assert stages == [self.counted["succeeded"]] * len(stages)

    @invariant()
    def published_results_are_no_garbage(self) -> None:
        garbage = set(self.store.garbage(10_000))
        for record in self.store.list("succeeded", limit=1000).records:
            assert record.result_prefix not in garbage
            assert record.status in FINAL


def test_no_order_of_steps_breaks_a_record(redis_process: RedisProcess) -> None:
    Lives.redis = redis_process.client()
    run_machine(
        Lives,
        settings=settings(
            max_examples=30,
            stateful_step_count=20,
            deadline=None,
            phases=[Phase.reuse, Phase.generate],  # shrinking takes minutes
            suppress_health_check=list(HealthCheck),
        ),
    )
