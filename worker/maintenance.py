"""Keeping order: lost jobs, expired jobs, garbage and orphans in the storage.

Every worker runs this beside its work, and the API should too; doing it twice at once is harmless.
"""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING, cast

import structlog
from redis.exceptions import RedisError

from worker.connections import UNREACHABLE
from worker.records import PREFIX
from worker.storage import StorageError
from worker.uploads import UploadStore, folder_prefix

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from redis import Redis

    from worker.queue import JobQueue

ORPHAN_LOOK_SECONDS = 3600.0
PUT_OFF_SECONDS = 60.0
FAILURES = 3
"""After so many the whole storage is taken to be away; the rest waits for the next time."""

_OBJECT = re.compile(r"(?P<kind>uploads|results|incoming)/(?P<job>[^/]+)/(?:(?P<attempt>\d+)/)?")

_LAST = f"{PREFIX}:maintained"
"""When any process had last done all that was due, in Unix seconds."""

log = structlog.get_logger(__name__)


def last_maintenance(redis: Redis) -> float | None:
    """Return when order was last kept, in Unix seconds; None for never."""
    found = cast("bytes | None", redis.get(_LAST))
    return None if found is None else float(found)


class Maintenance:
    """One keeper of order.

    Parameters
    ----------
    queue : JobQueue
    """

    def __init__(self, queue: JobQueue) -> None:
        self.queue = queue
        self.uploads = UploadStore(queue.redis, ttl=queue.settings.upload_ttl_seconds)

    def run_once(self) -> None:
        """Do all that is due; failures of Redis or of the storage are left for the next time."""
        for part in (
            self.queue.recover,
            self.expire,
            self.queue.records.lapse_holds,
            self.expire_uploads,
            self.collect_garbage,
            self.collect_orphans,
            self._note,
        ):
            try:
                part()
            except UNREACHABLE as error:
                # All parts need Redis, and each would wait for it in turn.
                reason = str(error)
                log.warning("maintenance stops, Redis is away", part=part.__name__, reason=reason)
                return
            except (RedisError, StorageError) as error:
                log.warning("maintenance is put off", part=part.__name__, reason=str(error))

    def _note(self) -> None:
        self.queue.redis.set(_LAST, time.time())

    def _removed(self, kind: str, count: int) -> None:
        """Count what was removed."""
        if count:
            self.queue.records.count_removed(kind, count)

    def expire(self) -> None:
        """Delete the jobs whose time to live has passed."""
        for job_id in self.queue.records.expired():
            if self.queue.delete(job_id, only_expired=True):
                log.info("job expired", job=job_id)
                self._removed("expired_job", 1)

    def expire_uploads(self) -> None:
        """Remove the objects of uploads that nobody went on with and no job took."""
        prefixes = {folder: folder_prefix(folder) for folder in self.uploads.abandoned()}
        self._empty(
            "abandoned_upload", prefixes, self.uploads.forget_folder, self.uploads.put_off_folder
        )

    def collect_garbage(self) -> None:
        """Remove the objects of deleted jobs and of attempts that came to nothing."""
        records = self.queue.records
        prefixes = {prefix: prefix for prefix in records.garbage()}
        self._empty("garbage", prefixes, records.forget_garbage, records.put_off_garbage)

    def _empty(
        self,
        kind: str,
        prefixes: Mapping[str, str],
        forget: Callable[[str], None],
        put_off: Callable[[str, float], None],
    ) -> None:
        """Remove all objects under prefixes; one that cannot be emptied does not hold up others.

        Parameters
        ----------
        kind : str
            As what they are counted.
        prefixes : mapping of str to str
            By the name under which Redis knows each.
        forget, put_off : callable
            Notes that nothing is left; that it is to be tried again after some seconds.
        """
        storage, count, size, failures = self.queue.storage, 0, 0, 0
        for name, prefix in prefixes.items():
            try:
                found = list(storage.list_prefix(prefix))
                storage.delete_prefix(prefix)
            except StorageError as error:
                log.warning("objects are left for later", prefix=prefix, reason=str(error))
                put_off(name, PUT_OFF_SECONDS)
                failures += 1
                if failures == FAILURES:
                    break
                continue
            forget(name)
            count += bool(found)
            size += sum(item.bytes for item in found)
        if count:
            log.info("objects removed", kind=kind, count=count, bytes=size)
        self._removed(kind, count)

    def collect_orphans(self) -> None:
        """Once an hour, remove old objects that no record knows, and tickets of no job.

        Such objects are uploads whose client went away before there was a job, and results of an
        attempt that wrote on after it had been given up.
        """
        settings = self.queue.settings
        period = min(ORPHAN_LOOK_SECONDS, settings.orphan_grace_seconds)
        if self.queue.redis.set(f"{PREFIX}:orphans", 1, nx=True, px=int(period * 1000)):
            self.queue.sweep_tickets()
            orphans = self._orphans(time.time() - settings.orphan_grace_seconds)
            for prefix in orphans:
                log.info("objects of no job are removed", prefix=prefix)
            # What cannot be removed now is an orphan the next time, too.
            self._empty(
                "orphan",
                {o: o for o in orphans},
                lambda _prefix: None,
                lambda _prefix, _seconds: None,
            )

    def _orphans(self, before: float) -> list[str]:
        """Return prefixes without a record, none of whose objects changed after a time."""
        latest: dict[tuple[str, str, str | None], float] = {}
        for kind in ("uploads/", "results/", "incoming/"):
            for item in self.queue.storage.list_prefix(kind):
                if found := _OBJECT.match(item.key):
                    place = (found["kind"], found["job"], found["attempt"])
                    latest[place] = max(latest.get(place, 0.0), item.modified)
        orphans = []
        for (kind, job_id, attempt), modified in latest.items():
            if modified >= before:
                continue
            prefix = f"{kind}/{job_id}/" + (f"{attempt}/" if attempt else "")
            if kind == "incoming":
                if not self.uploads.knows_folder(job_id):
                    orphans.append(prefix)
                continue
            record = self.queue.records.get(job_id)
            needed = record is not None and (
                kind == "uploads"
                or prefix == record.result_prefix
                or (record.status == "running" and attempt == str(record.attempt))
            )
            if not needed and not self.queue.records.held(prefix):
                orphans.append(prefix)
        return orphans
