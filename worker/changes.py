"""Waiting for changes of jobs, for long polls and event streams."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
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

_CANCEL_AGAIN_SECONDS = 1.0
_RECONNECT_SECONDS = 1.0
_LOOK_ANYWAY_SECONDS = 10.0
"""A waiter looks this often even when nothing was announced."""
_READS_AT_ONCE = 32
"""Fewer than the connections of a client's pool, which refuses more instead of waiting."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Deletion:
    """That a job was deleted."""

    id: str


@dataclass(frozen=True, slots=True)
class Gap:
    """That changes may have been missed: who keeps a list of jobs has to make it anew."""


@dataclass(eq=False, slots=True)
class _Inbox:
    """What somebody who watches all jobs has not seen yet."""

    owner: str | None
    missed: bool = True
    changed: dict[str, bool] = field(default_factory=dict)  # by id: whether it was deleted
    filled: asyncio.Event = field(default_factory=asyncio.Event)


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
        self._inboxes: set[_Inbox] = set()
        self._reading = asyncio.Semaphore(_READS_AT_ONCE)
        self._fetches: dict[str, asyncio.Task[JobRecord | None]] = {}
        self._listener: asyncio.Task[None] | None = None
        self.released = False
        """Whether nobody is to wait any more."""

    def release(self) -> None:
        """Have `wait` return at once, now and from now on: the process is about to end."""
        self.released = True
        for waiting in self._waiting.values():
            for announced in waiting:
                announced.set()

    async def __aenter__(self) -> Self:
        self._listener = asyncio.create_task(self._listen(), name="job changes")
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        # More than once if need be: the client of Redis may take a cancellation for a time-out.
        while self._listener is not None and not self._listener.done():
            self._listener.cancel()
            await asyncio.wait([self._listener], timeout=_CANCEL_AGAIN_SECONDS)

    async def get(self, job_id: str) -> JobRecord | None:
        """Return a record, or None when there is no such job."""
        async with self._reading:
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
                due = remaining <= 0 or self.released
                if record is None or record.version != version or due:
                    return record
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(announced.wait(), min(remaining, _LOOK_ANYWAY_SECONDS))

    async def watch(self, job_id: str, known: int = -1) -> AsyncIterator[JobRecord]:
        """Yield the record as it is, then at each change, until the job has ended or is deleted.

        While Redis is away nothing comes.

        Parameters
        ----------
        job_id : str
        known : int
            The version the caller knows; the record is not yielded before it differs or has ended.

        Yields
        ------
        JobRecord
            The last one has ended, unless the job was deleted.
        """
        version = known
        with self._announcements(job_id) as announced:
            while True:
                announced.clear()
                record = await self._shared_get(job_id)
                if record is None:
                    return
                if record.version != version or record.final:
                    yield record
                if record.final:
                    return
                version = record.version
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(announced.wait(), _LOOK_ANYWAY_SECONDS)

    async def watch_all(self, owner: str | None) -> AsyncIterator[JobRecord | Deletion | Gap]:
        """Yield the records of all jobs as they change, for ever.

        Several changes of a job that come while the caller is busy are yielded as one.

        Parameters
        ----------
        owner : str or None
            Only the jobs of this owner; None for all.

        Yields
        ------
        JobRecord, Deletion or Gap
            First of all a gap: what is listed after it and changed by what follows is up to date.
        """
        inbox = _Inbox(owner)
        inbox.filled.set()
        self._inboxes.add(inbox)
        try:
            while True:
                await inbox.filled.wait()
                inbox.filled.clear()
                if inbox.missed:
                    inbox.missed = False
                    yield Gap()
                changed, inbox.changed = inbox.changed, {}
                for job_id, deleted in changed.items():
                    if deleted:
                        yield Deletion(job_id)
                    elif (record := await self._shared_get(job_id)) is not None:
                        yield record
        finally:
            self._inboxes.discard(inbox)

    async def _shared_get(self, job_id: str) -> JobRecord | None:
        """Return a record, read once for all who ask for it after the same announcement."""
        fetch = self._fetches.get(job_id)
        if fetch is None or fetch.done():
            fetch = self._fetches[job_id] = asyncio.create_task(self._insist(job_id))
            fetch.add_done_callback(lambda done: self._forget(job_id, done))
        return await asyncio.shield(fetch)

    async def _insist(self, job_id: str) -> JobRecord | None:
        while True:
            try:
                return await self.get(job_id)
            except (RedisError, OSError) as error:
                log.warning("a job cannot be looked at", job=job_id, reason=str(error))
                await asyncio.sleep(_RECONNECT_SECONDS)

    def _forget(self, job_id: str, fetch: asyncio.Task[JobRecord | None]) -> None:
        if self._fetches.get(job_id) is fetch:
            del self._fetches[job_id]

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
        while True:
            try:
                async with self.redis.pubsub() as subscription:
                    await subscription.psubscribe(f"{PREFIX}:changed:*")
                    while True:
                        message = await subscription.get_message(timeout=_LOOK_ANYWAY_SECONDS)
                        match message and message["type"]:
                            case "psubscribe":
                                # The client may have connected again by itself in between.
                                self._wake_all()
                            case "pmessage":
                                self._announce(message["channel"], message["data"])
            except (RedisError, OSError) as error:
                log.warning("changes of jobs cannot be heard", reason=str(error))
                await asyncio.sleep(_RECONNECT_SECONDS)

    def _announce(self, channel: bytes, announcement: bytes) -> None:
        job_id = channel[len(changed_channel("")) :].decode()
        version, _, owner = announcement.decode().partition(" ")
        self._fetches.pop(job_id, None)  # what is being read may be older than this
        for event in self._waiting.get(job_id, ()):
            event.set()
        for inbox in self._inboxes:
            if inbox.owner is None or inbox.owner == owner:
                inbox.changed[job_id] = version == "deleted"
                inbox.filled.set()

    def _wake_all(self) -> None:
        self._fetches.clear()
        for events in self._waiting.values():
            for event in events:
                event.set()
        for inbox in self._inboxes:
            inbox.missed = True
            inbox.filled.set()
