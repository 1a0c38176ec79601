"""What is wrong with the service, found out in a bounded time."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from anyio import CapacityLimiter, create_task_group, move_on_after, to_thread
from redis.exceptions import RedisError

from worker.connections import connect
from worker.maintenance import last_maintenance
from worker.records import RecordStore
from worker.storage import StorageError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from worker.disk import Disk
    from worker.records import Survey
    from worker.settings import Settings
    from worker.storage import ObjectStorage

T = TypeVar("T")

CHECK_SECONDS = 1.8
"""After which a part that says nothing is taken for one that does not work."""

ESSENTIAL = ("redis", "storage")
"""Without these no request can be served. The rest is told, and the service is ready all the same:
who takes it out of a balancer for a full disk or absent workers keeps clients from deleting jobs
and from reading results."""

_REDIS_TIMEOUT = 0.3
_LATE_SECONDS = 60.0
_LATE_PERIODS = 30


class Probe:
    """Looks at all that the service needs.

    Parameters
    ----------
    settings : Settings
    storage : ObjectStorage
    disk : Disk
    """

    def __init__(self, settings: Settings, storage: ObjectStorage, disk: Disk) -> None:
        self._redis = connect(str(settings.redis_url), timeout=_REDIS_TIMEOUT)
        self._records = RecordStore(self._redis)
        self._silence = 2 * settings.lease_seconds
        self._late = max(_LATE_SECONDS, _LATE_PERIODS * settings.maintenance_interval_seconds)
        self._storage = storage
        self._disk = disk
        # Of its own: threads that hang must not take those of other requests.
        self._threads = CapacityLimiter(8)
        self._began = time.time()

    def close(self) -> None:
        """Close the connection to Redis."""
        self._redis.close()

    async def look(self) -> tuple[Mapping[str, str], Survey | None]:
        """Return what is found by part, 'ok' or what is wrong, and the state of the queue."""
        checks = {"redis": "does not answer", "storage": "does not answer"}
        survey: Survey | None = None
        maintained: float | None = None

        async def redis() -> None:
            nonlocal survey, maintained
            answer = await self._run(self._ask_redis)
            if answer is not None:
                survey, maintained = answer
                checks["redis"] = "ok"

        async def storage() -> None:
            found = await self._run(self._try_storage)
            if found is not None:
                checks["storage"] = found

        async with create_task_group() as group:
            group.start_soon(redis)
            group.start_soon(storage)
        if checks["storage"] == "ok":
            room = await self._run(self._disk.has_room)
            checks["disk"] = "ok" if room else "nearly full: uploads are refused"
        if survey is not None:
            checks["workers"] = "ok" if survey.workers else "none lives: jobs wait"
            late = time.time() - max(maintained or 0.0, self._began) > self._late
            checks["maintenance"] = "is late: what expired stays" if late else "ok"
        return checks, survey

    async def _run(self, check: Callable[[], T]) -> T | None:
        with move_on_after(CHECK_SECONDS):
            return await to_thread.run_sync(
                partial(check), abandon_on_cancel=True, limiter=self._threads
            )
        return None

    def _ask_redis(self) -> tuple[Survey, float | None] | None:
        try:
            return self._records.survey(self._silence), last_maintenance(self._redis)
        except RedisError:
            return None

    def _try_storage(self) -> str:
        try:
            self._storage.check()
        except StorageError:
            # What exactly failed may name hosts and folders, which are nobody else's business.
            return "cannot be written and read"
        return "ok"
