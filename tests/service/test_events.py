"""Streams of events over real connections."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from smsr.progress import Progress
from tests.conftest import redis_running
from tests.service.conftest import api_running, finished, problem, settings_for, submit, wait_for
from worker.changes import ChangeFeed, Deletion, Gap
from worker.connections import connect_async
from worker.records import JobRecord, RecordStore

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import RedisProcess
    from tests.service.conftest import Api


@dataclass
class Event:
    event: str = "message"
    data: str = ""
    id: str | None = None

    @property
    def json(self) -> Any:
        return json.loads(self.data)


def events(answer: httpx.Response) -> Iterator[Event]:
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert answer.headers["cache-control"] == "no-store"
    assert answer.headers["x-accel-buffering"] == "no"
    event = Event()
    for line in answer.iter_lines():
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            if event.data:
                yield event
            event = Event()
        elif name:
            assert name in ("event", "data", "id", "retry")
            if name != "retry":
                setattr(event, name, value)


@pytest.fixture
def store(idle_api: Api) -> RecordStore:
    return RecordStore(idle_api.redis.client())


@pytest.fixture
def idle_client(idle_api: Api) -> Iterator[httpx.Client]:
    with idle_api.client() as opened:
        yield opened


def queued(store: RecordStore, owner: str | None = None) -> str:
    record = JobRecord.new(options={}, inputs={}, owner=owner)
    store.create(record)
    return record.id


def begun(store: RecordStore, owner: str | None = None) -> str:
    job_id = queued(store, owner)
    assert store.begin_attempt(job_id, worker="ann", ticket="t", lease=60) == 1
    return job_id


def report(store: RecordStore, job_id: str, fraction: float) -> None:
    store.report_progress(job_id, 1, Progress("cameras", fraction), lease=60)


def publish(store: RecordStore, job_id: str) -> None:
    store.publish(job_id, 1, frames=3, points=4, timings={})


def test_a_real_job_is_followed_to_its_end(client: httpx.Client, tracks: bytes) -> None:
    job = submit(client, {"measurements": ("w.npy", tracks)})
    with client.stream("GET", f"{job.headers['Location']}/events") as answer:
        seen = list(events(answer))
    assert {event.event for event in seen} == {"job"}
    statuses = [event.json["status"] for event in seen]
    assert statuses[-1] == "succeeded"
    assert statuses == sorted(statuses, key=["queued", "running", "succeeded"].index)
    versions = [int(event.id or "") for event in seen]
    assert versions == sorted(set(versions))
    document = finished(client, job)
    for name in ("id", "links", "metrics", "timings", "finished_at"):
        assert seen[-1].json[name] == document[name]

    again = client.get(
        f"{job.headers['Location']}/events", headers={"Last-Event-ID": str(versions[-1])}
    )
    assert (again.status_code, again.content) == (204, b"")
    with client.stream("GET", f"{job.headers['Location']}/events") as answer:
        (only,) = events(answer)
    assert only == seen[-1]


def test_a_change_is_pushed_when_it_happens(idle_client: httpx.Client, store: RecordStore) -> None:
    job_id = begun(store)
    with idle_client.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        stream = events(answer)
        first = next(stream)
        assert first.json["status"] == "running"
        for step in range(1, 4):
            began = time.monotonic()
            report(store, job_id, step / 10)
            assert next(stream).json["progress"]["fraction"] == step / 10
            assert time.monotonic() - began < 2
        publish(store, job_id)
        last = next(stream)
        assert (last.json["status"], last.json["links"]["cancel"]) == ("succeeded", None)
        assert list(stream) == []


def test_resuming_repeats_nothing(idle_client: httpx.Client, store: RecordStore) -> None:
    job_id = begun(store)
    path = f"/v1/jobs/{job_id}/events"
    with idle_client.stream("GET", path) as answer:
        seen = next(events(answer))
    assert seen.id is not None
    with idle_client.stream("GET", path, headers={"Last-Event-ID": seen.id}) as answer:
        stream = events(answer)
        report(store, job_id, 0.5)
        following = next(stream)
    assert int(following.id or "") == int(seen.id) + 1
    assert following.json["progress"]["fraction"] == 0.5

    publish(store, job_id)
    for known in (following.id, "0", "99", "nonsense", "9" * 5000, ""):
        headers = {"Last-Event-ID": str(known)}
        with idle_client.stream("GET", path, headers=headers) as answer:
            assert [event.json["status"] for event in events(answer)] == ["succeeded"]


@pytest.mark.parametrize("step", ["before", "after"])
def test_a_deleted_job_ends_its_stream(
    idle_client: httpx.Client, store: RecordStore, step: str
) -> None:
    job_id = begun(store)
    headers = {"Last-Event-ID": "2"} if step == "before" else {}
    with idle_client.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as answer:
        stream = events(answer)
        if step == "after":
            assert next(stream).event == "job"
        store.delete(job_id)
        (last,) = stream
    assert (last.event, last.json) == ("deleted", {"id": job_id})
    problem(idle_client.get(f"/v1/jobs/{job_id}/events"), "unknown-job", 404)


def test_the_beginning_of_a_stream(idle_client: httpx.Client, store: RecordStore) -> None:
    job_id = begun(store)
    for path in (f"/v1/jobs/{job_id}/events", "/v1/events"):
        with idle_client.stream("GET", path) as answer:
            lines = answer.iter_lines()
            assert [next(lines)[:1], next(lines), next(lines)] == [":", "retry: 2000", ""]
        head = idle_client.head(path)
        assert head.status_code == 200
        assert head.headers["content-type"].startswith("text/event-stream")


def test_all_jobs_are_followed(idle_client: httpx.Client, store: RecordStore) -> None:
    with idle_client.stream("GET", "/v1/events") as answer:
        stream = events(answer)
        assert next(stream).event == "refresh"
        job_id = queued(store)
        event = next(stream)
        assert (event.event, event.id, event.json["id"]) == ("job", None, job_id)
        assert event.json["status"] == "queued"
        other = queued(store)
        assert next(stream).json["id"] == other
        store.cancel(job_id)
        assert next(stream).json["status"] == "cancelled"
        store.delete(job_id)
        event = next(stream)
        assert (event.event, event.json) == ("deleted", {"id": job_id})


def test_heartbeats_and_a_stop_of_the_server(tmp_path: Path) -> None:
    with redis_running(tmp_path) as redis:
        settings = settings_for(tmp_path, redis, event_heartbeat_seconds=0.2)
        store = RecordStore(redis.client())
        job_id = begun(store)
        with (
            api_running(settings, redis, tmp_path / "api.log") as api,
            api.client() as client,
            client.stream("GET", f"/v1/jobs/{job_id}/events") as one,
            client.stream("GET", "/v1/events") as all_,
        ):
            lines = one.iter_lines()
            comments = 0
            while comments < 5:
                comments += next(lines).startswith(":")
            began = time.monotonic()
            api.process.send_signal(signal.SIGTERM)
            for answer in (lines, all_.iter_lines()):
                with contextlib.suppress(httpx.RemoteProtocolError):
                    list(answer)
            api.process.wait(10)
            assert time.monotonic() - began < 2.5
        assert "Traceback" not in (tmp_path / "api.log").read_text()


def test_a_stream_outlives_a_restart_of_redis(tmp_path: Path) -> None:
    with redis_running(tmp_path) as redis:
        store = RecordStore(redis.client())
        job_id = begun(store)
        time.sleep(1.1)  # the append-only file is synced every second
        with (
            api_running(settings_for(tmp_path, redis), redis, tmp_path / "api.log") as api,
            api.client() as client,
            client.stream("GET", f"/v1/jobs/{job_id}/events") as one,
            client.stream("GET", "/v1/events") as all_,
        ):
            of_one, of_all = events(one), events(all_)
            assert next(of_one).json["status"] == "running"
            assert next(of_all).event == "refresh"
            redis.kill()
            time.sleep(0.5)
            redis.start()
            publish(RecordStore(redis.client()), job_id)
            assert next(of_one).json["status"] == "succeeded"
            assert next(of_all).event == "refresh"


def test_a_client_that_goes_away_is_forgotten(idle_api: Api, store: RecordStore) -> None:
    job_id = begun(store)
    idle_api.log.write_text("")
    for _ in range(5):
        with idle_api.client() as client, client.stream("GET", f"/v1/jobs/{job_id}/events") as one:
            next(events(one))
    report(store, job_id, 0.5)
    wait_for(lambda: httpx.get(f"{idle_api.url}/healthz").status_code == 200)
    lines = [json.loads(line) for line in idle_api.log.read_text().splitlines()]
    assert {(line["event"], line["level"]) for line in lines} == {("request", "info")}


def test_an_owner_hears_of_no_other(redis_process: RedisProcess, redis_url: str) -> None:
    store = RecordStore(redis_process.client())

    async def heard() -> list[str]:
        found: list[str] = []
        async with connect_async(redis_url) as redis, ChangeFeed(redis) as feed:
            async for change in feed.watch_all("ann"):
                if isinstance(change, Gap):
                    if not found:
                        found.append("gap")
                        await asyncio.sleep(0.3)  # the subscription stands
                        other = await asyncio.to_thread(queued, store, "bob")
                        await asyncio.to_thread(store.delete, other)
                        await asyncio.to_thread(queued, store, None)
                        own = await asyncio.to_thread(queued, store, "ann")
                        await asyncio.to_thread(store.delete, own)
                    continue
                found.append("own" if change.id == own else "another's")
                if isinstance(change, Deletion):
                    return found
        return found

    assert set(asyncio.run(heard())) == {"gap", "own"}


def test_many_streams_cost_little(idle_api: Api, store: RecordStore) -> None:
    """They share connections to Redis, and more may begin at once than there are of those."""
    count = 200
    job_id = begun(store)
    redis = idle_api.redis.client()
    head = f"GET /v1/jobs/{job_id}/events HTTP/1.1\r\nHost: here\r\n\r\n".encode()

    async def follow(ready: asyncio.Semaphore) -> float:
        port = int(idle_api.url.rpartition(":")[2])
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            writer.write(head)
            assert b" 200 " in await reader.readline()
            await reader.readuntil(b'"running"')
            ready.release()
            await reader.readuntil(b'"succeeded"')
            return time.monotonic()
        finally:
            writer.close()

    async def run() -> float:
        ready = asyncio.Semaphore(0)
        following = [asyncio.create_task(follow(ready)) for _ in range(count)]
        for _ in range(count):
            await ready.acquire()
        assert len(redis.client_list()) < count / 2
        began = time.monotonic()
        await asyncio.to_thread(publish, store, job_id)
        return max(await asyncio.gather(*following)) - began

    async def bounded() -> float:
        return await asyncio.wait_for(run(), 30)

    assert asyncio.run(bounded()) < 5
