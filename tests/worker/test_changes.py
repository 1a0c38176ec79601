from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING

from smsr.progress import Progress
from tests.conftest import redis_running
from worker.changes import ChangeFeed
from worker.connections import connect_async
from worker.records import JobRecord, RecordStore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    import pytest

    from tests.conftest import RedisProcess


@contextlib.asynccontextmanager
async def feed_of(url: str) -> AsyncIterator[ChangeFeed]:
    async with connect_async(url) as redis, ChangeFeed(redis) as feed:
        yield feed


def begun(store: RecordStore) -> str:
    record = JobRecord.new(options={}, inputs={})
    store.create(record)
    store.begin_attempt(record.id, worker="ann", ticket="t", lease=60)
    return record.id


def test_waiting_ends_with_a_change(redis_process: RedisProcess, redis_url: str) -> None:
    store = RecordStore(redis_process.client())
    job_id = begun(store)

    async def waited() -> float:
        async with feed_of(redis_url) as feed:
            record = await feed.get(job_id)
            assert record is not None
            waiting = asyncio.ensure_future(feed.wait(job_id, record.version, 20.0))
            await asyncio.sleep(0.3)
            assert not waiting.done()
            began = time.monotonic()
            await asyncio.to_thread(
                store.report_progress, job_id, 1, Progress("cameras", 0.5), lease=60
            )
            changed = await waiting
            assert changed is not None
            assert changed.progress == Progress("cameras", 0.5)
            return time.monotonic() - began

    assert asyncio.run(waited()) < 2


def test_waiting_does_not_wait_for_what_has_happened(
    redis_process: RedisProcess, redis_url: str
) -> None:
    job_id = begun(RecordStore(redis_process.client()))

    async def waited() -> None:
        async with feed_of(redis_url) as feed:
            record = await feed.wait(job_id, version=1, timeout=20.0)
            assert record is not None
            assert record.version > 1
            assert await feed.wait("unknown", version=1, timeout=20.0) is None

    began = time.monotonic()
    asyncio.run(waited())
    assert time.monotonic() - began < 5


def test_waiting_ends_in_time(redis_process: RedisProcess, redis_url: str) -> None:
    job_id = begun(RecordStore(redis_process.client()))

    async def waited() -> None:
        async with feed_of(redis_url) as feed:
            record = await feed.get(job_id)
            assert record is not None
            began = time.monotonic()
            assert await feed.wait(job_id, record.version, 0.2) == record
            assert 0.2 <= time.monotonic() - began < 5

    asyncio.run(waited())


def test_watching_a_job_to_its_end(redis_process: RedisProcess, redis_url: str) -> None:
    store = RecordStore(redis_process.client())
    job_id = begun(store)

    async def watched() -> list[JobRecord]:
        records = []
        async with feed_of(redis_url) as feed:
            async for record in feed.watch(job_id):
                records.append(record)
                step = len(records)
                if step < 4:
                    report = Progress("cameras", step / 10)
                    await asyncio.to_thread(store.report_progress, job_id, 1, report, lease=60)
                elif step == 4:
                    publish = {"frames": 1, "points": 1, "timings": {}}
                    await asyncio.to_thread(store.publish, job_id, 1, **publish)  # type: ignore[arg-type]
        return records

    records = asyncio.run(watched())
    assert [record.version for record in records] == sorted({r.version for r in records})
    assert records[-1].status == "succeeded"


def test_watching_a_job_that_is_deleted(redis_process: RedisProcess, redis_url: str) -> None:
    store = RecordStore(redis_process.client())
    job_id = begun(store)

    async def watched() -> int:
        seen = 0
        async with feed_of(redis_url) as feed:
            async for _ in feed.watch(job_id):
                seen += 1
                await asyncio.to_thread(store.delete, job_id)
        return seen

    assert asyncio.run(watched()) == 1


def test_a_change_is_seen_though_redis_was_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.changes._RECONNECT_SECONDS", 0.2)
    with redis_running(tmp_path) as server:
        store = RecordStore(server.client())
        job_id = begun(store)
        time.sleep(1.1)  # the append-only file is synced every second

        async def waited() -> None:
            async with feed_of(server.url) as feed:
                record = await feed.get(job_id)
                assert record is not None
                await asyncio.to_thread(server.kill)
                await asyncio.sleep(0.5)
                await asyncio.to_thread(server.start)
                waiting = asyncio.ensure_future(feed.wait(job_id, record.version, 20.0))
                await asyncio.sleep(0.5)
                store = RecordStore(server.client())
                await asyncio.to_thread(store.cancel, job_id)
                changed = await waiting
                assert changed is not None
                assert changed.cancel_requested

        began = time.monotonic()
        asyncio.run(waited())
        assert time.monotonic() - began < 9, "nobody waited for the look that comes anyway"
