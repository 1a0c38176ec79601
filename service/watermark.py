"""Refusing uploads before the disk is full, so that running jobs can finish."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anyio import to_thread
from starlette.requests import Request

from service.problems import FULL_RETRY_SECONDS, Problem

if TYPE_CHECKING:
    from starlette.types import Message

    from service.context import Context

LOOK_BYTES = 8 << 20
"""How much may arrive between two looks at the disk."""


async def check_room(shared: Context, size: int = 0) -> None:
    """Refuse an upload that would leave too little of the disk free.

    Parameters
    ----------
    shared : Context
    size : int
        Bytes that it announces.

    Raises
    ------
    Problem
        storage-full.
    """
    if not await to_thread.run_sync(shared.disk.has_room, size):
        raise Problem(
            "storage-full",
            "The disk of the service is nearly full: it takes no uploads, and finishes its jobs.",
            headers={"Retry-After": str(FULL_RETRY_SECONDS)},
        )


async def watched(shared: Context, request: Request, size: int | None = None) -> Request:
    """Return a request to read the body from, which is refused when it does not fit the disk.

    Parameters
    ----------
    shared : Context
    request : Request
    size : int, optional
        Bytes that are still to come; by default what Content-Length says.

    Raises
    ------
    Problem
        storage-full; reading the body raises it as well.
    """
    if size is None:
        announced = request.headers.get("content-length", "")
        size = int(announced) if announced.isdecimal() else LOOK_BYTES
    await check_room(shared, min(size, shared.settings.max_upload_bytes))
    unlooked = 0

    async def watched_receive() -> Message:
        nonlocal unlooked
        message = await request.receive()
        unlooked += len(message.get("body", b""))
        if unlooked >= LOOK_BYTES:
            unlooked = 0
            await check_room(shared, LOOK_BYTES)  # others may have come in between
        return message

    return Request(request.scope, watched_receive)
