"""Answers to requests whose body was not read to its end, as refused uploads are."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LINGER_SECONDS = 30.0
"""How long a client may go on sending what nobody reads."""


class LingeringClose:
    """Lets a client see the answer that comes while it still sends.

    Closing the connection at once would make the system answer the rest of the body with a reset,
    which can destroy the response on its way (RFC 9112, section 9.6). So the response goes out
    whole and the body is read and dropped for a while; then the connection is closed.

    Parameters
    ----------
    app : ASGIApp
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http" or not _has_body(scope):
            await self.app(scope, receive, send)
            return
        unread = True
        lingers = False

        async def watched_receive() -> Message:
            nonlocal unread
            message = await receive()
            unread = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def drain() -> None:
            while unread:
                await watched_receive()

        async def lingering_send(message: Message) -> None:
            nonlocal lingers
            if message["type"] == "http.response.start" and unread:
                lingers = True
                message["headers"] = [*message["headers"], (b"connection", b"close")]
            if not lingers or message["type"] != "http.response.body" or message.get("more_body"):
                await send(message)
                return
            await send({**message, "more_body": True})
            with suppress(TimeoutError):
                await asyncio.wait_for(drain(), LINGER_SECONDS)
            await send({"type": "http.response.body", "body": b"", "more_body": False})

        await self.app(scope, watched_receive, lingering_send)


def _has_body(scope: Scope) -> bool:
    """Whether a request announces a body (RFC 9112, section 6.3)."""
    headers = dict(scope["headers"])
    return b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0"
