"""Reading the body of a request in large blocks, as far as it comes."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from starlette.requests import ClientDisconnect

from service.problems import Problem

if TYPE_CHECKING:
    from starlette.datastructures import Headers
    from starlette.requests import Request

JSON_BYTES = 128 << 10
"""Longest JSON document that is read."""

_JSON_SECONDS = 60.0
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

    Raises
    ------
    Problem
        It has a content coding; none is undone here.
    """

    def __init__(self, request: Request, idle_seconds: float) -> None:
        coding = ", ".join(request.headers.getlist("content-encoding")) or "identity"
        if coding.lower() != "identity":
            raise Problem(
                "unsupported-media-type",
                f"The body is sent as it is, without Content-Encoding {coding[:60]}.",
                headers={"Accept-Encoding": "identity"},  # RFC 9110, section 12.5.3
            )
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


async def read_json(request: Request) -> dict[str, Any]:
    """Read a body that is a JSON object.

    Raises
    ------
    Problem
        It is none, or too long.
    """
    body, text = Body(request, _JSON_SECONDS), b""
    while block := await body.block(JSON_BYTES):
        text += block
        if len(text) > JSON_BYTES:
            raise Problem("malformed-json", f"The document is longer than {JSON_BYTES} B.")
    return json_object(text, "malformed-json", "The body is")


def json_object(text: bytes | bytearray, slug: str, subject: str) -> dict[str, Any]:
    """Return the JSON object in a text.

    Parameters
    ----------
    text : bytes
    slug, subject : str
        Of the problem where there is none: its type, and what its detail begins with.

    Raises
    ------
    Problem
    """
    try:
        found = json.loads(text.decode("utf-8"), parse_constant=_no_constant)
    except RecursionError:
        raise Problem(slug, f"{subject} nested too deeply.") from None
    except ValueError as error:
        raise Problem(slug, f"{subject} no valid JSON: {error}.") from None
    if not isinstance(found, dict):
        raise Problem(slug, f"{subject} a JSON {_type_of(found)}, not an object.")
    return found


def _type_of(value: object) -> str:
    names = {list: "array", str: "string", bool: "boolean", type(None): "null"}
    return names.get(type(value), "number")


def _no_constant(name: str) -> object:
    raise ValueError(f"{name} is no JSON")


def content_type(headers: Headers) -> str:
    """Return the media type of a body without its parameters, '' where none is said."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()
