"""`Prefer: wait=N` (RFC 7240, section 4.3): answering as soon as a job has ended."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from worker.changes import ChangeFeed
    from worker.records import JobRecord

MAX_WAIT_SECONDS = 60
"""Longer waits are shortened to this, below the idle limit of common proxies."""

_WAIT = re.compile(r"\s*wait\s*=\s*\"?(\d{1,9})\"?\s*(;.*)?", re.IGNORECASE)


def preferred_wait(headers: Iterable[str]) -> int | None:
    """Return the seconds of ``wait`` in Prefer headers, at most `MAX_WAIT_SECONDS`.

    A preference that is not understood is ignored, as RFC 7240 asks for, and of two the first
    counts.
    """
    for header in headers:
        for preference in header.split(","):
            if found := _WAIT.fullmatch(preference):
                return min(int(found[1]), MAX_WAIT_SECONDS)
    return None


async def wait_until_final(feed: ChangeFeed, record: JobRecord, seconds: float) -> JobRecord | None:
    """Return the record once its job has ended, or as it is after some seconds.

    None when the job was deleted meanwhile. No thread waits, and all waiters share a connection.
    """
    deadline = time.monotonic() + seconds
    current: JobRecord | None = record
    while current is not None and not current.final:
        left = deadline - time.monotonic()
        if left <= 0 or feed.released:
            break
        current = await feed.wait(current.id, current.version, left)
    return current
