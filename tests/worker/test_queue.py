from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, cast

import pytest
from structlog.testing import capture_logs

from worker.maintenance import Maintenance, last_maintenance
from worker.queue import FORMER_TICKET_TTL, JobQueue
from worker.records import PREFIX, JobActive, JobExists, result_prefix, upload_prefix

if TYPE_CHECKING:
    from tests.conftest import RedisProcess
    from tests.worker.conftest import Submitter
    from worker.settings import Settings


def keys(queue: JobQueue, pattern: str) -> set[str]:
    return {cast("bytes", key).decode() for key in queue.redis.keys(pattern)}


def rq_keys(queue: JobQueue) -> set[str]:
    """Return what RQ has stored of jobs."""
    return keys(queue, "rq:*") - {"rq:queues"}


def recovered(queue: JobQueue, settings: Settings) -> set[str]:
    """Look for lost jobs until a lost one must have been found."""
    found: set[str] = set()
    end = time.monotonic() + 1.5 * settings.lost_ticket_seconds
    while time.monotonic() < end:
        found |= set(queue.recover().requeued)
        time.sleep(0.05)
    return found


def test_submitted_jobs_wait_in_order(queue: JobQueue, submit: Submitter) -> None:
    first, second = submit(), submit()
    assert (queue.position(first), queue.position(second), queue.length()) == (0, 1, 2)
    assert queue.records.get(first) is not None
    assert queue.position("unknown") is None
    assert queue.recover().requeued == ()


def test_a_job_is_submitted_once(queue: JobQueue, submit: Submitter) -> None:
    record = submit.record()
    queue.submit(record)
    with pytest.raises(JobExists):
        queue.submit(record)
    assert queue.length() == 1


def test_what_rq_wrote_to_removed_tickets_fades_away(queue: JobQueue, submit: Submitter) -> None:
    """A worker that is killed at the wrong moment leaves a part of a ticket, for ever."""
    waiting, ended = submit(), submit()
    former = queue.records.ticket(ended)
    queue.delete(ended)
    queue.redis.hset(f"rq:job:{former}", "last_heartbeat", "now")
    queue.redis.zadd(f"rq:executions:{former}", {"e": 1})
    assert queue.sweep_tickets() == 2
    assert queue.sweep_tickets() == 0
    times = {key: queue.redis.ttl(key) for key in rq_keys(queue) if former in key}
    assert len(times) == 2
    assert all(0 < seconds <= FORMER_TICKET_TTL for seconds in times.values())
    assert queue.redis.ttl(f"rq:job:{queue.records.ticket(waiting)}") == -1


def test_a_crash_between_record_and_ticket_is_repaired(
    queue: JobQueue, submit: Submitter, settings: Settings
) -> None:
    record = submit.record()
    queue.records.create(record)  # and here the process dies
    assert queue.position(record.id) is None
    assert recovered(queue, settings) == {record.id}
    assert queue.position(record.id) == 0
    assert recovered(queue, settings) == set()


def test_a_lost_ticket_is_replaced(queue: JobQueue, submit: Submitter, settings: Settings) -> None:
    job_id = submit()
    (ticket,) = queue.queues["normal"].job_ids
    queue.redis.rpop(queue.queues["normal"].key)  # taken by a worker that dies at once
    assert recovered(queue, settings) == {job_id}
    (present,) = queue.queues["normal"].job_ids
    assert present != ticket
    assert queue.redis.ttl(f"rq:job:{ticket}") > 0
    assert queue.redis.ttl(f"rq:job:{present}") == -1


def test_a_job_of_a_silent_worker_is_queued_first(
    queue: JobQueue, submit: Submitter, settings: Settings
) -> None:
    lost, waiting = submit(), submit()
    (taken, _) = queue.queues["normal"].job_ids
    queue.redis.lmove(queue.queues["normal"].key, queue.queues["normal"].intermediate_queue_key)
    queue.records.begin_attempt(lost, worker="ann", ticket="t", lease=0.01)
    time.sleep(0.02)
    assert queue.recover().requeued == ()
    time.sleep(2 * settings.heartbeat_seconds)
    assert queue.recover().requeued == (lost,)
    assert (queue.position(lost), queue.position(waiting)) == (0, 1)
    assert not [key for key in keys(queue, "*") if taken in key]
    assert queue.redis.llen(queue.queues["normal"].intermediate_queue_key) == 0


def test_cancelling_a_queued_job_leaves_nothing_in_rq(queue: JobQueue, submit: Submitter) -> None:
    job_id = submit()
    record = queue.cancel(job_id)
    assert record is not None
    assert record.status == "cancelled"
    assert rq_keys(queue) == set()
    assert queue.cancel("unknown") is None


def test_deleting_leaves_nothing(queue: JobQueue, submit: Submitter) -> None:
    job_id = submit()
    queue.storage.put_bytes(result_prefix(job_id, 1) + "shapes.npy", b"x")
    assert queue.delete(job_id)
    assert rq_keys(queue) == set()
    assert list(queue.storage.list_prefix("uploads/")) == []
    assert list(queue.storage.list_prefix("results/")) == []
    assert keys(queue, "smsr:*") == {"smsr:garbage"}
    assert not queue.delete(job_id)


def test_retrying(queue: JobQueue, submit: Submitter) -> None:
    job_id = submit()
    with pytest.raises(JobActive):
        queue.retry(job_id)
    queue.cancel(job_id)
    record = queue.retry(job_id)
    assert record is not None
    assert record.status == "queued"
    assert queue.position(job_id) == 0
    assert queue.retry("unknown") is None


def test_expired_jobs_are_removed(settings: Settings, submit: Submitter) -> None:
    queue = JobQueue(settings.model_copy(update={"result_ttl_seconds": 0.05}))
    kept, expired = submit(), submit()
    queue.cancel(expired)
    time.sleep(0.1)
    Maintenance(queue).run_once()
    assert queue.records.get(expired) is None
    assert queue.records.get(kept) is not None
    assert list(queue.storage.list_prefix(upload_prefix(expired))) == []
    assert len(list(queue.storage.list_prefix(upload_prefix(kept)))) == 1


def test_garbage_is_removed(queue: JobQueue) -> None:
    queue.storage.put_bytes("results/x/1/shapes.npy", b"x")
    queue.redis.zadd("smsr:garbage", {"results/x/1/": time.time() - 1, "results/y/1/": 1e12})
    Maintenance(queue).run_once()
    assert list(queue.storage.list_prefix("results/")) == []
    assert queue.redis.zrange("smsr:garbage", 0, -1) == [b"results/y/1/"]


def test_old_objects_of_no_job_are_removed(settings: Settings, submit: Submitter) -> None:
    queue = JobQueue(settings.model_copy(update={"orphan_grace_seconds": 0.1}))
    running, done = submit(), submit()
    for job_id in (running, done):
        attempt = queue.records.begin_attempt(job_id, worker="ann", ticket="t", lease=60)
        assert attempt == 1
    queue.records.publish(done, 1, frames=1, points=1, timings={})
    kept = [result_prefix(running, 1), result_prefix(done, 1), upload_prefix(done)]
    late = [result_prefix(done, 7), upload_prefix("nobody"), result_prefix("nobody", 1)]
    for prefix in kept + late:
        queue.storage.put_bytes(prefix + "x", b"x")
    time.sleep(0.15)
    Maintenance(queue).run_once()
    present = {item.key for item in queue.storage.list_prefix("results/")}
    present |= {item.key for item in queue.storage.list_prefix("uploads/")}
    assert {prefix + "x" for prefix in kept} <= present
    assert not {prefix + "x" for prefix in late} & present
    assert upload_prefix(running) + "measurements" in present


def test_young_objects_of_no_job_are_kept(settings: Settings) -> None:
    queue = JobQueue(settings)
    queue.storage.put_bytes("uploads/coming/measurements", b"x")
    Maintenance(queue).run_once()
    assert queue.storage.exists("uploads/coming/measurements")


def test_maintenance_outlives_a_failing_storage(queue: JobQueue, submit: Submitter) -> None:
    job_id = submit()
    assert queue.storage.folder is not None
    queue.delete(job_id)
    queue.storage.folder.joinpath("uploads").rmdir()
    queue.storage.folder.joinpath("uploads").write_bytes(b"a file in the way")
    queue.storage.put_bytes("results/x/1/shapes.npy", b"x")
    queue.redis.zadd("smsr:garbage", {f"uploads/{job_id}/": 1, "results/x/1/": 2})
    Maintenance(queue).run_once()
    assert (queue.redis.zscore("smsr:garbage", f"uploads/{job_id}/") or 0) > time.time() + 30
    assert queue.redis.zscore("smsr:garbage", "results/x/1/") is None, "held up by the other"
    assert list(queue.storage.list_prefix("results/")) == []
    queue.storage.folder.joinpath("uploads").unlink()
    queue.redis.zadd("smsr:garbage", {f"uploads/{job_id}/": 1})
    Maintenance(queue).run_once()
    assert queue.redis.zscore("smsr:garbage", f"uploads/{job_id}/") is None


def test_maintenance_waits_for_redis_once(queue: JobQueue, redis_process: RedisProcess) -> None:
    """Not in every one of its parts, or it would still be waiting when Redis is back."""
    keeper = Maintenance(queue)
    redis_process.kill()
    try:
        with capture_logs() as lines:
            keeper.run_once()
    finally:
        redis_process.start()
    assert [line["event"] for line in lines] == ["maintenance stops, Redis is away"]
    assert last_maintenance(queue.redis) is None
    keeper.run_once()
    assert last_maintenance(queue.redis) is not None


def test_the_queue_needs_a_server(settings: Settings) -> None:
    with pytest.raises(ValueError, match="Redis"):
        JobQueue(settings.model_copy(update={"redis_url": None}))


def test_what_is_removed_is_counted(queue: JobQueue, submit: Submitter) -> None:
    expired, deleted = submit(), submit()
    queue.cancel(expired)
    queue.redis.zadd(f"{PREFIX}:expiry", {expired: 1.0})
    queue.storage.put_bytes(f"results/{deleted}/1/shapes.npy", b"late")
    queue.redis.zadd(f"{PREFIX}:garbage", {f"results/{deleted}/1/": 1.0})
    orphan = queue.storage.folder
    assert orphan is not None
    queue.storage.put_bytes("uploads/nobody/measurements", b"x")
    os.utime(orphan / "uploads" / "nobody" / "measurements", (1.0, 1.0))
    Maintenance(queue).run_once()
    Maintenance(queue).run_once()
    assert queue.records.survey(60).counters.removed == {
        "expired_job": 1,
        "garbage": 1,
        "orphan": 1,
    }
    assert abs((last_maintenance(queue.redis) or 0.0) - time.time()) < 5
    assert queue.records.get(deleted) is not None
