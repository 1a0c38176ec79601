"""Reading the body of a request in large blocks, as far as it comes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from starlette.requests import ClientDisconnect

from service.problems import Problem

if TYPE_CHECKING:
    from starlette.requests import Request

_PATIENCE_STEP = 1.0
"""Seconds between two looks at the clock: packets come far more often than that."""


class Body:
    """The body of a request.

    Parameters
    ----------
    request : Request
        Its body is read here, once.
    idle_seconds : float
        Silence after which it is given up.
    """

    def __init__(self, request: Request, idle_seconds: float) -> None:
        self._receive = request.receive
        self._idle = idle_seconds
        self._pending: list[bytes] = []
        self._ended = False

    async def block(self, size: int) -> bytes:
        """Return the next bytes, `size` of them or a packet's more; fewer only at the end.

        Raises
        ------
        ClientDisconnect
            The client went away; `rest` has what came until then.
        Problem
            Nothing came for too long; the same.
        """
        held = 0
        clock = asyncio.get_running_loop().time
        try:
            async with asyncio.timeout(self._idle) as patience:
                looked = clock()
                while held < size and not self._ended:
                    message = await self._receive()
                    if message["type"] == "http.disconnect":
                        raise ClientDisconnect
                    if data := message.get("body", b""):
                        self._pending.append(data)
                        held += len(data)
                    self._ended = not message.get("more_body", False)
                    if (now := clock()) - looked > _PATIENCE_STEP:
                        looked = now
                        patience.reschedule(now + self._idle)
        except TimeoutError:
            raise Problem(
                "upload-stalled",
                f"No byte arrived for {self._idle:g} seconds.",
                headers={"Connection": "close"},
            ) from None
        return self.rest()

    def rest(self) -> bytes:
        """Return what has arrived and was not returned yet."""
        data = self._pending[0] if len(self._pending) == 1 else b"".join(self._pending)
        self._pending = []
        return data
