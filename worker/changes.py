"""Waiting for changes of jobs, for long polls and event streams."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, cast

import structlog
from redis.exceptions import RedisError

from worker.records import PREFIX, changed_channel, decode, record_key

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Iterator
    from types import TracebackType
    from typing import Self

    from redis.asyncio import Redis

    from worker.records import JobRecord

_RECONNECT_SECONDS = 1.0
_LOOK_ANYWAY_SECONDS = 10.0
"""A waiter looks this often even when nothing was announced."""

log = structlog.get_logger(__name__)


class ChangeFeed:
    """One subscription of a process to the changes of all jobs, shared by all that wait.

    Used as an asynchronous context manager, in the event loop of the waiters.

    Parameters
    ----------
    redis : redis.asyncio.Redis
        Client that does not decode answers; closing it remains the caller's.
    """

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self._waiting: dict[str, set[asyncio.Event]] = {}
        self._listener: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._listener = asyncio.create_task(self._listen(), name="job changes")
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._listener is not None:
            self._listener.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._listener

    async def get(self, job_id: str) -> JobRecord | None:
        """Return a record, or None when there is no such job."""
        answer = cast("Awaitable[dict[bytes, bytes]]", self.redis.hgetall(record_key(job_id)))
        return decode(job_id, await answer)

    async def wait(self, job_id: str, version: int, timeout: float) -> JobRecord | None:
        """Return the record as soon as its version differs, or as it is when time is up.

        Parameters
        ----------
        job_id : str
        version : int
            The version the caller knows.
        timeout : float
            Seconds.
        """
        deadline = time.monotonic() + timeout
        with self._announcements(job_id) as announced:
            while True:
                announced.clear()
                record = await self.get(job_id)
                remaining = deadline - time.monotonic()
                if record is None or record.version != version or remaining <= 0:
                    return record
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(announced.wait(), min(remaining, _LOOK_ANYWAY_SECONDS))

    async def watch(self, job_id: str) -> AsyncIterator[JobRecord]:
        """Yield the record as it is, then at each change, until the job has ended or is deleted."""
        version = -1
        with self._announcements(job_id) as announced:
            while True:
                announced.clear()
                record = await self.get(job_id)
                if record is None:
                    return
                if record.version != version:
                    version = record.version
                    yield record
                    if record.final:
                        return
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(announced.wait(), _LOOK_ANYWAY_SECONDS)

    @contextlib.contextmanager
    def _announcements(self, job_id: str) -> Iterator[asyncio.Event]:
        event = asyncio.Event()
        waiting = self._waiting.setdefault(job_id, set())
        waiting.add(event)
        try:
            yield event
        finally:
            waiting.discard(event)
            if not waiting:
                self._waiting.pop(job_id, None)

    async def _listen(self) -> None:
        """Pass announcements on; after a broken connection wake everyone to look again."""
        start = len(changed_channel(""))
        while True:
            try:
                async with self.redis.pubsub() as subscription:
                    await subscription.psubscribe(f"{PREFIX}:changed:*")
                    self._wake_all()
                    while True:
                        message = await subscription.get_message(
                            ignore_subscribe_messages=True, timeout=_LOOK_ANYWAY_SECONDS
                        )
                        if message is not None:
                            job_id = cast("bytes", message["channel"])[start:].decode()
                            for event in self._waiting.get(job_id, ()):
                                event.set()
            except (RedisError, OSError) as error:
                log.warning("changes of jobs cannot be heard", reason=str(error))
                await asyncio.sleep(_RECONNECT_SECONDS)

    def _wake_all(self) -> None:
        for events in self._waiting.values():
            for event in events:
                event.set()
