"""What an owner may have at a time: room for uploads, and jobs.

The counts are kept in Redis by the steps that change a job (`worker.records`). An upload under way
is held there from its first byte, so that many at once get no more room than one after the other;
when it becomes a job the hold becomes the job's bytes in the same step.
"""

from __future__ import annotations

import logging
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

from anyio import CancelScope, to_thread
from redis.exceptions import RedisError
from starlette.requests import Request

from worker.records import TooManyJobs

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from starlette.types import Message

    from service.context import Context

BLOCK_BYTES = 8 << 20
"""By how much the hold of an upload of unknown length grows."""

_log = logging.getLogger(__name__)


async def hold(shared: Context, upload_id: str, size: int, seconds: float | None = None) -> None:
    """Count an upload under way as stored; calling it again sets its size and its time anew.

    A finished upload stays held until a job takes it (`service.submissions.accept` with its id) or
    `drop` says that its files are gone.

    Parameters
    ----------
    shared : Context
        Says whose it is.
    upload_id : str
    size : int
        In all where that is known, else so far.
    seconds : float, optional
        How long the files will stay if nothing more is heard; by default as long as orphans do.

    Raises
    ------
    TooManyBytes
        There is no room for it, which is answered as 507.
    """
    if shared.owner is None:
        return
    await to_thread.run_sync(
        partial(
            shared.queue.records.hold,
            upload_id,
            shared.owner,
            size,
            most=shared.allowance.bytes,
            seconds=shared.settings.orphan_grace_seconds if seconds is None else seconds,
        )
    )


async def drop(shared: Context, upload_id: str) -> None:
    """Count an upload no longer; without Redis it lapses by itself."""
    if shared.owner is None:
        return
    with CancelScope(shield=True):
        try:
            await to_thread.run_sync(shared.queue.records.drop_hold, upload_id)
        except RedisError as error:
            _log.warning("the bytes of an upload count until they lapse: %s", error)


async def check_jobs(shared: Context) -> None:
    """Refuse early what would be refused after a long upload.

    Raises
    ------
    TooManyJobs
        The owner has as many queued and running jobs as it may, which is answered as 429.
    """
    if shared.owner is None or shared.allowance.jobs is None:
        return
    if await to_thread.run_sync(shared.queue.records.active, shared.owner) >= shared.allowance.jobs:
        raise TooManyJobs(shared.owner)


@asynccontextmanager
async def room(shared: Context, request: Request, upload_id: str) -> AsyncIterator[Request]:
    """Hold room for the body of a request while it is received; give the request to read it from.

    The hold ends with the block where that fails; else it is left to the job that the upload has
    become.

    Raises
    ------
    TooManyBytes
    """
    if shared.owner is None:
        yield request
        return
    announced = request.headers.get("content-length", "")
    expected = int(announced) if announced.isdecimal() else 0
    received = 0

    async def counted_receive() -> Message:
        nonlocal expected, received
        message = await request.receive()
        received += len(message.get("body", b""))
        if received > expected:
            expected = received + BLOCK_BYTES
            await hold(shared, upload_id, received)
        return message

    try:
        await hold(shared, upload_id, min(expected, shared.settings.max_upload_bytes))
        yield Request(request.scope, counted_receive)
    except BaseException:
        await drop(shared, upload_id)
        raise
