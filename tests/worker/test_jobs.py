"""Jobs from submission to their end, run by real workers that are killed, stopped and starved."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import signal
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr import STAGES
from tests.conftest import redis_running
from tests.worker.conftest import (
    Submitter,
    Workers,
    alive,
    eventually,
    horses,
    quick_settings,
    wait_for,
    wait_for_end,
)
from tests.worker.workers import Behaviour
from worker.changes import ChangeFeed
from worker.checksums import CHECKSUMS, FRAME_CHECKSUMS
from worker.connections import connect, connect_async
from worker.queue import JobQueue
from worker.records import record_key, result_prefix

if TYPE_CHECKING:
    from pathlib import Path

    from smsr.synthetic import Example
    from worker.records import JobRecord
    from worker.settings import Settings

ALL_STAGES = ("opening", *(s for s in STAGES if s != "smoothing"), "evaluating", "publishing")
"""Those of the default preset."""


def check_success(queue: JobQueue, record: JobRecord, example: Example) -> None:
    """Check that a job succeeded, with whole results and nothing else in the storage."""
    assert record.status == "succeeded", record.problem
    frames, points = example.ground_truth.shape[:2]
    prefix = record.result_prefix
    assert prefix == result_prefix(record.id, record.attempt)
    shapes = np.load(io.BytesIO(queue.storage.get(prefix + "shapes.npy")))
    assert (shapes.shape, shapes.dtype) == ((frames, points, 3), np.dtype("<f4"))
    assert np.isfinite(shapes).all()
    assert (record.frames, record.points) == (frames, points)
    report = json.loads(queue.storage.get(prefix + "report.json"))
    assert report["points"] == points
    eventually(
        lambda: (
            {item.key for item in queue.storage.list_prefix(f"results/{record.id}/")}
            == {prefix + name for name in expected_objects(record)}
        ),
        "only the results of the last attempt are left",
    )


def expected_objects(record: JobRecord) -> set[str]:
    names = {"shapes.npy", "cameras.npy", "translations.npy", "report.json"}
    names |= {CHECKSUMS, FRAME_CHECKSUMS}
    return names | ({"faces.npy"} if "faces" in record.inputs else set())


def check_nothing_is_running(queue: JobQueue, settings: Settings) -> None:
    """Check that no lease, no ticket and no scratch file is left."""
    assert queue.redis.zcard("smsr:leases") == 0
    eventually(lambda: not queue.redis.keys("rq:job:*"), "tickets are removed")
    eventually(lambda: not queue.redis.keys("rq:wip:*"), "executions are removed")
    scratch = settings.scratch
    eventually(
        lambda: not [p for p in scratch.rglob("*") if p.parent != scratch], "scratch is removed"
    )


def wait_for_stage(queue: JobQueue, job_id: str, stage: str, attempt: int = 1) -> None:
    def reached(record: JobRecord) -> bool:
        progress = record.progress
        return record.attempt == attempt and progress is not None and progress.stage == stage

    wait_for(queue, job_id, reached, stage)


def test_a_job_with_everything(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    start_worker.start()
    job_id = submit({"time_limit": 60.0}, ground_truth=example.ground_truth, faces=example.faces)
    record = wait_for_end(queue, job_id)
    check_success(queue, record, example)
    assert record.metrics is not None
    assert 0 <= record.metrics["e3d"] < 1
    assert {"queued", "opening", "evaluating", "publishing", "total", *STAGES[:2]} <= set(
        record.timings
    )
    assert all(seconds >= 0 for seconds in record.timings.values())
    assert record.progress is not None
    assert record.progress.fraction == 1.0
    faces = np.load(io.BytesIO(queue.storage.get(f"{record.result_prefix}faces.npy")))
    np.testing.assert_array_equal(faces, example.faces)
    report = json.loads(queue.storage.get(f"{record.result_prefix}report.json"))
    assert report["metrics"] == record.metrics
    check_nothing_is_running(queue, start_worker.settings)
    eventually(lambda: queue.workers() == 1, "the worker gives signs of life")

    # A deleted job leaves nothing, neither in Redis nor in the storage.
    assert queue.delete(job_id)
    assert list(queue.storage.list_prefix("uploads/")) == []
    assert list(queue.storage.list_prefix("results/")) == []
    assert not [key for key in queue.redis.keys("*") if job_id.encode() in key]


def test_progress_grows_and_passes_all_stages(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    job_id = submit(ground_truth=example.ground_truth)
    start_worker.start()

    async def watched() -> list[JobRecord]:
        async with connect_async(str(queue.settings.redis_url)) as redis, ChangeFeed(redis) as feed:
            return [record async for record in feed.watch(job_id)]

    records = asyncio.run(watched())
    assert records[-1].status == "succeeded"
    reports = [record.progress for record in records if record.progress is not None]
    fractions = [report.fraction for report in reports]
    assert fractions == sorted(fractions)
    # Reports may pass by faster than they are read; the times of the stages tell of them all.
    passed = ["queued", "opening", *STAGES, "evaluating", "publishing", "total"]
    assert list(records[-1].timings) == passed
    seen = [[*passed[1:-1], "done"].index(report.stage) for report in reports]
    assert seen == sorted(seen)
    assert reports[-1].stage == "done"


@pytest.mark.parametrize(
    ("change", "slug"),
    [
        ({"measurements": np.zeros((5, 9))}, "odd-row-count"),
        ({"measurements": np.full((24, 16), np.nan)}, "not-finite"),
        ({"ground_truth": np.zeros((3, 16, 3))}, "ground-truth-mismatch"),
        ({"faces": np.array([[0, 1, 99]])}, "invalid-faces"),
    ],
)
def test_input_that_cannot_be_used(
    queue: JobQueue,
    submit: Submitter,
    start_worker: Workers,
    change: dict[str, Any],
    slug: str,
) -> None:
    start_worker.start()
    record = wait_for_end(queue, submit(**change))
    assert (record.status, record.attempt) == ("failed", 1)
    assert record.problem is not None
    assert record.problem["type"] == f"/problems/{slug}"
    assert record.problem["status"] == 422
    assert record.problem["detail"]
    check_nothing_is_running(queue, start_worker.settings)


def test_an_input_that_is_gone(queue: JobQueue, submit: Submitter, start_worker: Workers) -> None:
    record = submit.record()
    queue.storage.delete_prefix(f"uploads/{record.id}/")
    queue.submit(record)
    start_worker.start()
    problem = wait_for_end(queue, record.id).problem
    assert problem is not None
    assert problem["type"] == "/problems/input-missing"


@pytest.mark.parametrize(("kind", "slug"), [("greedy", "out-of-memory"), ("broken", "internal")])
def test_what_goes_wrong_on_our_side(
    queue: JobQueue, submit: Submitter, start_worker: Workers, kind: Any, slug: str
) -> None:
    start_worker.start(Behaviour("cameras", kind))
    record = wait_for_end(queue, submit())
    assert record.status == "failed"
    assert record.problem is not None
    assert record.problem["type"] == f"/problems/{slug}"
    assert record.problem["status"] == 500
    assert "a bug" not in json.dumps(record.problem)
    assert ("reference" in record.problem) == (slug == "internal")
    check_nothing_is_running(queue, start_worker.settings)


@pytest.mark.parametrize("stage", ALL_STAGES)
def test_a_killed_work_horse_is_replaced(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example, stage: str
) -> None:
    worker = start_worker.start(Behaviour(stage, "stuck"))
    job_id = submit(ground_truth=example.ground_truth)
    wait_for_stage(queue, job_id, stage)
    (horse,) = horses(worker)
    os.kill(horse, signal.SIGKILL)
    killed = time.monotonic()
    record = wait_for_end(queue, job_id)
    assert time.monotonic() - killed < 10
    check_success(queue, record, example)
    assert (record.attempt, record.lost_attempts) == (2, 1)
    check_nothing_is_running(queue, start_worker.settings)


@pytest.mark.parametrize("stage", ["opening", "cameras", "writing", "publishing"])
def test_another_worker_takes_over_from_a_killed_one(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example, stage: str
) -> None:
    victim = start_worker.start(Behaviour(stage, "stuck"))
    job_id = submit()
    wait_for_stage(queue, job_id, stage)
    (horse,) = horses(victim)
    start_worker.start()
    start_worker.kill(victim)
    record = wait_for_end(queue, job_id)
    check_success(queue, record, example)
    assert (record.attempt, record.lost_attempts) == (2, 1)
    assert not alive(horse), "the work-horse dies with its worker"
    # The scratch of the dead worker is removed by the next one that starts.
    start_worker.start()
    check_scratch_of(start_worker.settings, 2)


def check_scratch_of(settings: Settings, workers: int) -> None:
    eventually(
        lambda: (
            len(list(settings.scratch.glob("*.lock"))) == workers
            and len([path for path in settings.scratch.iterdir() if path.is_dir()]) == workers
        ),
        f"{workers} scratch folders are left",
    )


def test_a_job_that_kills_its_workers_fails(
    queue: JobQueue, submit: Submitter, start_worker: Workers
) -> None:
    worker = start_worker.start(Behaviour("cameras", "stuck", attempts=99), max_attempts=3)
    job_id = submit()
    for attempt in (1, 2, 3):
        wait_for_stage(queue, job_id, "cameras", attempt)
        (horse,) = horses(worker)
        os.kill(horse, signal.SIGKILL)
    record = wait_for_end(queue, job_id)
    assert (record.status, record.attempt) == ("failed", 3)
    assert record.problem is not None
    assert record.problem["type"] == "/problems/worker-lost"
    check_nothing_is_running(queue, start_worker.settings)


def test_a_worker_that_comes_back_from_the_dead_is_not_heard(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    """A stopped machine, a lost network: the job is given away, and its former worker goes on."""
    zombie = start_worker.start(Behaviour("publishing", "slow", seconds=0.5))
    job_id = submit(ground_truth=example.ground_truth)
    wait_for_stage(queue, job_id, "publishing")
    (horse,) = horses(zombie)
    frozen = [zombie, horse]
    for pid in frozen:
        os.kill(pid, signal.SIGSTOP)
    start_worker.start()
    record = wait_for_end(queue, job_id)
    check_success(queue, record, example)
    assert record.attempt == 2
    for pid in frozen:
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: not horses(zombie), "the former work-horse ends")
    assert queue.records.get(job_id) == record
    check_success(queue, record, example)
    check_nothing_is_running(queue, start_worker.settings)


def test_many_jobs_many_workers_many_kills(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    pids = [start_worker.start() for _ in range(2)]
    jobs = [submit() for _ in range(8)]
    rng = np.random.default_rng(0)
    for _ in range(6):
        time.sleep(rng.uniform(0.05, 0.3))
        victims = [horse for pid in pids for horse in horses(pid)]
        if victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(rng.choice(victims)), signal.SIGKILL)
    for job_id in jobs:
        check_success(queue, wait_for_end(queue, job_id), example)
    check_nothing_is_running(queue, start_worker.settings)


@pytest.mark.parametrize("kind", ["slow", "stuck"])
def test_cancelling_a_running_job(
    queue: JobQueue, submit: Submitter, start_worker: Workers, kind: Any
) -> None:
    start_worker.start(Behaviour("shapes", kind))
    job_id = submit()
    wait_for_stage(queue, job_id, "shapes")
    began = time.monotonic()
    asked = queue.cancel(job_id)
    assert asked is not None
    assert asked.cancel_requested
    record = wait_for_end(queue, job_id)
    assert time.monotonic() - began < (3 if kind == "stuck" else 1)
    assert (record.status, record.attempt, record.problem) == ("cancelled", 1, None)
    assert list(queue.storage.list_prefix(f"results/{job_id}/")) == []
    check_nothing_is_running(queue, start_worker.settings)
    # The worker is fit for more, and the job can be run again.
    assert queue.redis.hincrbyfloat(record_key(job_id), "created_at", -1000)
    queue.retry(job_id)
    again = wait_for_end(queue, job_id)
    assert (again.status, again.attempt, again.cancel_requested) == ("succeeded", 2, False)
    assert again.queued_at is not None
    assert again.started_at is not None
    assert again.timings["queued"] == pytest.approx(again.started_at - again.queued_at, abs=1e-3)
    assert again.timings["queued"] < 60


def test_deleting_a_running_job(queue: JobQueue, submit: Submitter, start_worker: Workers) -> None:
    worker = start_worker.start(Behaviour("shapes", "stuck"))
    job_id = submit()
    wait_for_stage(queue, job_id, "shapes")
    assert queue.delete(job_id)
    assert queue.records.get(job_id) is None
    eventually(lambda: not horses(worker), "the work-horse ends")
    check_nothing_is_running(queue, start_worker.settings)
    assert list(queue.storage.list_prefix("uploads/")) == []
    assert list(queue.storage.list_prefix("results/")) == []


@pytest.mark.parametrize("kind", ["slow", "stuck", "deaf"])
def test_the_time_limit(
    queue: JobQueue, submit: Submitter, start_worker: Workers, kind: Any
) -> None:
    start_worker.start(Behaviour("cameras", kind), job_timeout_seconds=0.5)
    job_id = submit({"time_limit": 20.0})
    record = wait_for_end(queue, job_id)
    assert (record.status, record.attempt) == ("failed", 1)
    assert record.problem is not None
    assert record.problem["type"] == "/problems/time-limit"
    assert record.problem["limit_seconds"] == 0.5
    assert "0.5 seconds" in record.problem["detail"]
    check_nothing_is_running(queue, start_worker.settings)


def test_a_stopping_worker_hands_its_job_back(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    first = start_worker.start(Behaviour("shapes", "stuck"))
    job_id = submit()
    wait_for_stage(queue, job_id, "shapes")
    os.kill(first, signal.SIGTERM)
    wait_for(queue, job_id, lambda r: r.status == "queued", "the job is queued again")
    eventually(lambda: not start_worker.processes[0].is_alive(), "the worker ends")
    assert not list(start_worker.settings.scratch.iterdir())
    start_worker.start()
    record = wait_for_end(queue, job_id)
    check_success(queue, record, example)
    assert (record.attempt, record.lost_attempts) == (2, 0)


def test_redis_is_killed_and_comes_back(tmp_path: Path, example: Example) -> None:
    folder = tmp_path / "redis"
    folder.mkdir()
    with redis_running(folder) as server, contextlib.ExitStack() as cleaning:
        settings = quick_settings(tmp_path, server.url)
        queue = JobQueue(settings, connect(server.url, patient=True))
        workers = Workers(settings, [])
        cleaning.callback(workers.stop)
        submit = Submitter(queue, example)
        workers.start(Behaviour("publishing", "slow", seconds=2.0))
        running, waiting = submit(), submit()
        wait_for_stage(queue, running, "publishing")
        time.sleep(1.1)  # the append-only file is synced every second
        server.kill()
        time.sleep(1.5)
        server.start()
        for job_id in (running, waiting):
            check_success(queue, wait_for_end(queue, job_id), example)
        record = queue.records.get(running)
        assert record is not None
        assert record.attempt == 1, "a worker that only could not reach Redis keeps its job"
        later = submit()
        check_success(queue, wait_for_end(queue, later), example)


def test_a_storage_that_fails_for_a_while(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    obstacle = break_results(queue)
    start_worker.start()
    job_id = submit()
    wait_for_stage(queue, job_id, "publishing")
    time.sleep(0.3)
    obstacle.unlink()
    check_success(queue, wait_for_end(queue, job_id), example)


def test_a_storage_that_is_away_when_a_job_begins_costs_no_attempts(
    queue: JobQueue, submit: Submitter, start_worker: Workers, example: Example
) -> None:
    job_id = submit()
    folder = queue.storage.folder
    assert folder is not None
    away = folder.rename(folder.with_name("away"))
    folder.write_bytes(b"")
    start_worker.start(storage_retry_seconds=20)
    wait_for(queue, job_id, lambda record: record.status == "running")
    time.sleep(1.5)
    folder.unlink()
    away.rename(folder)
    record = wait_for_end(queue, job_id)
    check_success(queue, record, example)
    assert record.attempt == 1


def test_a_storage_that_fails_for_long(
    queue: JobQueue, submit: Submitter, start_worker: Workers
) -> None:
    break_results(queue)
    start_worker.start(storage_retry_seconds=0.2, max_attempts=2)
    record = wait_for_end(queue, submit())
    assert (record.status, record.attempt) == ("failed", 2)
    assert record.problem is not None
    assert record.problem["type"] == "/problems/storage-unavailable"
    assert record.problem["status"] == 503
    assert record.result_prefix is None


def break_results(queue: JobQueue) -> Path:
    """Put a file where results should go."""
    assert queue.storage.folder is not None
    obstacle = queue.storage.folder / "results"
    obstacle.write_bytes(b"")
    return obstacle


def test_finished_jobs_expire(queue: JobQueue, submit: Submitter, start_worker: Workers) -> None:
    start_worker.start(result_ttl_seconds=0.5)
    job_id = submit()
    record = wait_for_end(queue, job_id)
    assert record.expires_at is not None
    eventually(lambda: queue.records.get(job_id) is None, "the job expires")
    eventually(lambda: not list(queue.storage.list_prefix("results/")), "its results are removed")
    eventually(lambda: not list(queue.storage.list_prefix("uploads/")), "its inputs are removed")
