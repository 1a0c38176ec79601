"""Each request: its id, its span, and its line in the access log."""

from __future__ import annotations

import re
import time
import uuid
from typing import TYPE_CHECKING

import structlog
from starlette.datastructures import Headers, MutableHeaders

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from worker.tracing import Tracing

REQUEST_ID = "X-Request-ID"
QUIET = frozenset({"/healthz", "/readyz", "/metrics"})
"""Routes that are asked every few seconds: their answers are logged at DEBUG, and not traced."""

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:+/=@-]{0,127}")
_SHOWN = 300

log = structlog.get_logger(__name__)


def request_id(scope: Scope) -> str | None:
    """Return the id of a request, None outside of `TrackedRequests`."""
    found: str | None = scope.get("state", {}).get("request_id")
    return found


class TrackedRequests:
    """Gives each request an id, binds it to all log lines, and logs one line at the end.

    An id that the client or a proxy gives in ``X-Request-ID`` is kept where it is 128 letters,
    digits and ``._:+/=@-`` or fewer, else one is made. Every answer names it.

    Parameters
    ----------
    app : ASGIApp
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get(REQUEST_ID, "")
        known_as = given if _ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = known_as
        # Not unbound at the end: the server logs an error after it, in the same task. A connection
        # may pass its context on to the next request, though.
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(request=known_as)
        tracing: Tracing | None = getattr(scope["app"].state, "tracing", None)
        if tracing is None or not tracing.on or scope["path"] in QUIET:
            await self._log(scope, receive, send, known_as)
            return
        method = scope["method"]
        with tracing.span(
            method,
            parent=headers.get("traceparent"),
            kind="server",
            http__request__method=method,
            url__path=scope["path"],
            smsr__request=known_as,
        ) as span:
            structlog.contextvars.bind_contextvars(trace=span.trace_id)
            status = await self._log(scope, receive, send, known_as)
            route = _route(scope)
            span.name(f"{method} {route}" if route else method)
            span.set(http__response__status_code=status, http__route=route)
            if status >= 500:
                span.fail(str(status))

    async def _log(self, scope: Scope, receive: Receive, send: Send, known_as: str) -> int:
        """Pass a request on and log it; return the status of the answer."""
        started = time.perf_counter()
        status = 500  # what the server answers when the application does not
        taken = sent = 0

        async def counted_receive() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            return message

        async def counted_send(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
                message.setdefault("headers", [])
                MutableHeaders(scope=message)[REQUEST_ID] = known_as
            await send(message)
            sent += len(message.get("body", b""))

        try:
            await self.app(scope, counted_receive, counted_send)
        finally:
            say = log.debug if scope["path"] in QUIET and status < 500 else log.info
            say(
                "request",
                method=scope["method"][:_SHOWN],
                path=scope["path"][:_SHOWN],
                route=_route(scope),
                status=status,
                received=taken,
                sent=sent,
                seconds=round(time.perf_counter() - started, 6),
                owner=scope["state"].get("owner"),
            )
        return status


def _route(scope: Scope) -> str | None:
    """Return the template of the path, which the router has noted."""
    path: str | None = getattr(scope.get("route"), "path", None)
    return path
