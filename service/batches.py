"""The archive of a batch: the results of all its jobs in one ZIP, made while it streams.

There may be thousands of jobs, which may end or be deleted while the archive is sent, so results
are looked at one after the other and the length is not known beforehand. The standard library's
`zipfile` writes to a stream that cannot seek by putting checksum and sizes behind each member
(APPNOTE.TXT, section 4.3.9); nothing is buffered but the directory.
"""

from __future__ import annotations

import io
import re
import time
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from anyio import to_thread

from service.archives import SEND_BYTES, archive
from service.content import Content, held_content
from worker.storage import ObjectMissing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from typing_extensions import Buffer

    from service.context import Context
    from worker.records import JobRecord

_PAGE = 100
"""Records looked at together; results are opened one after the other, as they are sent."""

_SUMMARY = "batch.json"


@dataclass(frozen=True, slots=True)
class Member:
    """A file of the archive, with its time stamp."""

    name: str
    content: Content
    modified: float


class _Pipe(io.RawIOBase):
    """A stream that cannot seek; what is written to it waits until it is taken."""

    def __init__(self) -> None:
        super().__init__()
        self._written: list[bytes] = []
        self.waiting = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Buffer, /) -> int:
        # The chunks of a member come as bytes already: no copy is made of those.
        block = data if isinstance(data, bytes) else bytes(data)
        self._written.append(block)
        self.waiting += len(block)
        return len(block)

    def take(self) -> bytes:
        """Return and forget what was written."""
        taken, self._written, self.waiting = self._written, [], 0
        return taken[0] if len(taken) == 1 else b"".join(taken)


def folder_of(record: JobRecord) -> str:
    """Return the name of a job's folder: that of its file, and enough of the id to be the only one.

    In ASCII, without what some system does not take in a file name.
    """
    stem = (record.name or "").rpartition(".")[0] or record.name or ""
    readable = re.sub(r"[^A-Za-z0-9_-]+", "-", stem).strip("-")[:60]
    return f"{readable or 'job'}-{record.id[:16]}"


async def stream_batch(shared: Context, label: str, summary: bytes) -> AsyncIterator[bytes]:
    """Yield the archive of a batch: batch.json, then a folder for each job, oldest last."""
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_STORED) as zipped:
        async for member in _members(shared, label, summary):
            moment = datetime.fromtimestamp(member.modified, UTC)
            info = zipfile.ZipInfo(member.name, moment.timetuple()[:6])
            info.external_attr = 0o644 << 16
            size = member.content.size
            with zipped.open(info, "w", force_zip64=size > zipfile.ZIP64_LIMIT) as entry:
                async for chunk in member.content.read(0, size):
                    entry.write(chunk)
                    if pipe.waiting >= SEND_BYTES:
                        yield pipe.take()
    yield pipe.take()


async def _members(shared: Context, label: str, summary: bytes) -> AsyncIterator[Member]:
    """Yield the members of the archive of a batch.

    Jobs that have no result, or lose it meanwhile, are left out.
    """
    yield Member(_SUMMARY, held_content(summary), time.time())
    cursor: str | None = None
    while True:
        page = await to_thread.run_sync(
            partial(
                shared.queue.records.list,
                "succeeded",
                cursor,
                _PAGE,
                owner=shared.owner,
                batch=label,
            )
        )
        for record in page.records:
            try:
                files = await shared.results.open(record)
                key = f"{record.result_prefix}report.json"
                report = await to_thread.run_sync(shared.storage.get, key)
            except ObjectMissing:
                continue
            folder = folder_of(record)
            finished = record.finished_at or record.created_at
            packed = archive(files.npz_members(), finished)
            yield Member(f"{folder}/result.npz", packed, finished)
            yield Member(f"{folder}/report.json", held_content(report), finished)
        cursor = page.next_cursor
        if cursor is None:
            return
