"""Server-Sent Events: jobs as they change, pushed (WHATWG HTML, section 9.2)."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from sse_starlette import EventSourceResponse, ServerSentEvent
from sse_starlette.sse import SendTimeoutError

from service.context import JobId, Shared, root_of
from service.problems import example_responses
from service.schemas import job_document
from worker.changes import Deletion, Gap

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from starlette.types import Receive, Scope, Send

    from service.access import Gate
    from worker.changes import ChangeFeed
    from worker.records import JobRecord

RECONNECT_MILLISECONDS = 2000
"""What ``retry:`` tells clients to wait before they connect again."""
SEND_SECONDS = 60.0
"""A client that takes nothing for so long is given up."""

_VERSION = re.compile(r"[0-9]{1,18}")

router = APIRouter(prefix="/v1", tags=["events"])


class EventStream(EventSourceResponse):
    """A stream of events that ends when the client, the server or the client's key goes away.

    Parameters
    ----------
    request : Request
    events : asynchronous iterator of ServerSentEvent
    heartbeat : float
        Seconds between comments that keep the connection alive, and between looks at the key.
    """

    def __init__(
        self, request: Request, events: AsyncIterator[ServerSentEvent], *, heartbeat: float
    ) -> None:
        self._gate: Gate = request.app.state.gate
        self._key = request.state.key
        over = partial(self._gate.until_invalid, self._key, heartbeat)
        super().__init__(_until(over, events), ping=heartbeat, sep="\n", send_timeout=SEND_SECONDS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        with self._gate.stream(self._key), suppress(SendTimeoutError):
            await super().__call__(scope, receive, send)


async def _until(
    over: Callable[[], Awaitable[None]], events: AsyncIterator[ServerSentEvent]
) -> AsyncIterator[ServerSentEvent]:
    """Pass events on until they end or something is over."""
    ending, coming = asyncio.ensure_future(over()), None
    try:
        while True:
            coming = asyncio.ensure_future(_next(events))
            await asyncio.wait({coming, ending}, return_when=asyncio.FIRST_COMPLETED)
            if not coming.done() or (event := coming.result()) is None:
                return
            yield event
    finally:
        tasks = [task for task in (ending, coming) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _next(events: AsyncIterator[ServerSentEvent]) -> ServerSentEvent | None:
    return await anext(events, None)


_EVENT = {
    "type": "object",
    "properties": {name: {"type": "string"} for name in ("event", "data", "id")},
    "required": ["event", "data"],
}


def _stream(description: str, example: str) -> dict[str, Any]:
    # OpenAPI 3.1 has no word for streams; by custom the schema is that of each event.
    content = {"text/event-stream": {"schema": _EVENT, "example": example}}
    return {"description": description, "content": content}


_EXAMPLE = """\
event: job
data: {"id":"0f8fad5bd9cb469fa16570867728950e","status":"running", ...}
id: 7

"""


@router.get(
    "/jobs/{job_id}/events",
    summary="A job as it changes (Server-Sent Events)",
    response_class=Response,
    responses={
        200: _stream("Events `job`, and `deleted` where the job is deleted.", _EXAMPLE),
        204: {"description": "The job has ended, and the client has seen so: connect no more."},
        **example_responses("unknown-job", "too-many-streams", "queue-unavailable"),
    },
)
async def job_events(
    request: Request,
    shared: Shared,
    job_id: JobId,
    last_event_id: Annotated[
        str | None,
        Header(description="Id of the last event that was seen; it is not sent again."),
    ] = None,
) -> Response:
    """Stream the document of a job, at once and at every change, until it has ended.

    The data of an event `job` is the document as in a list of jobs, its id the version of the job.
    A client that lost the connection connects again with `Last-Event-ID`, as browsers do by
    themselves. Comments keep an idle connection alive.
    """
    record = await shared.record(job_id)
    known = int(last_event_id) if last_event_id and _VERSION.fullmatch(last_event_id) else -1
    if record.final and record.version == known:
        return Response(status_code=204)
    return EventStream(
        request,
        _of_a_job(shared.feed, job_id, known, root_of(request)),
        heartbeat=shared.settings.event_heartbeat_seconds,
    )


@router.get(
    "/events",
    summary="All jobs as they change (Server-Sent Events)",
    response_class=Response,
    responses={
        200: _stream("Events `refresh`, `job` and `deleted`.", "event: refresh\ndata: {}\n\n"),
        **example_responses("too-many-streams", "queue-unavailable"),
    },
)
async def all_events(request: Request, shared: Shared) -> Response:
    """Stream the documents of all jobs of the caller as they change, for as long as it listens.

    First and wherever changes may have been missed comes an event `refresh`: list the jobs then,
    and keep the list up to date with the events `job` and `deleted` that follow. They have no ids;
    a client that connects again lists anew.
    """
    return EventStream(
        request,
        _of_all_jobs(shared.feed, shared.owner, root_of(request)),
        heartbeat=shared.settings.event_heartbeat_seconds,
    )


async def _of_a_job(
    feed: ChangeFeed, job_id: str, known: int, root: str
) -> AsyncIterator[ServerSentEvent]:
    yield ServerSentEvent(comment="a job", retry=RECONNECT_MILLISECONDS, sep="\n")
    ended = False
    async for record in feed.watch(job_id, known):
        ended = record.final
        yield _job_event(record, root, event_id=str(record.version))
    if not ended:
        yield _deleted_event(job_id)


async def _of_all_jobs(
    feed: ChangeFeed, owner: str | None, root: str
) -> AsyncIterator[ServerSentEvent]:
    yield ServerSentEvent(comment="all jobs", retry=RECONNECT_MILLISECONDS, sep="\n")
    async for change in feed.watch_all(owner):
        match change:
            case Gap():
                yield ServerSentEvent("{}", event="refresh", sep="\n")
            case Deletion():
                yield _deleted_event(change.id)
            case _:
                yield _job_event(change, root)


def _job_event(record: JobRecord, root: str, event_id: str | None = None) -> ServerSentEvent:
    document = job_document(record, root=root, brief=True)
    return ServerSentEvent(document.model_dump_json(), event="job", id=event_id, sep="\n")


def _deleted_event(job_id: str) -> ServerSentEvent:
    return ServerSentEvent(json.dumps({"id": job_id}), event="deleted", sep="\n")
