"""Events of a job: how their stream is read, and how it goes on after a broken connection."""

from __future__ import annotations

import re
import time
from http import HTTPStatus
from typing import TYPE_CHECKING, Final

import httpx

from smsr_client.documents import FINAL, Job
from smsr_client.errors import ServerUnreachable, ServiceError, refusal_of
from smsr_client.flows import FIRST_PAUSE, LONGEST_PAUSE, TRY_AGAIN, Call, retry_after, unanswered

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smsr_client.flows import Flows

_LINE_END: Final = re.compile(rb"\r\n|\n|\r")


class EventDecoder:
    """Turns bytes of an event stream into events (WHATWG HTML, section 9.2.6)."""

    def __init__(self) -> None:
        self._rest = b""
        self._data: list[str] = []
        self._event = ""
        self.last_id = ""

    def feed(self, chunk: bytes) -> Iterator[tuple[str, str]]:
        """Yield the name and the data of each event that is complete."""
        self._rest += chunk
        # A carriage return at the end may be the first half of a line's end.
        ready = len(self._rest) - self._rest.endswith(b"\r")
        *lines, tail = _LINE_END.split(self._rest[:ready])
        self._rest = tail + self._rest[ready:]
        for line in lines:
            if line:
                self._field(line.decode("utf-8", "replace"))
            elif self._data:
                yield self._event or "message", "\n".join(self._data)
                self._data, self._event = [], ""
            else:
                self._event = ""

    def _field(self, line: str) -> None:
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        match name:
            case "data":
                self._data.append(value)
            case "event":
                self._event = value
            case "id":
                self.last_id = value


class Following:
    """What is known while a job is followed; the connection is the caller's.

    Parameters
    ----------
    flows : Flows
        Of the client.
    job_id : str
    """

    def __init__(self, flows: Flows, job_id: str) -> None:
        self._flows, self._job_id = flows, job_id
        self._decoder = EventDecoder()
        self._seen = ""
        self._pause = FIRST_PAUSE
        self._deadline = time.monotonic() + flows.patience
        self.over = False

    def call(self) -> Call:
        """Return the request for the events that were not seen."""
        self._decoder = EventDecoder()
        headers = {"Accept": "text/event-stream, application/problem+json"}
        if self._seen:
            headers["Last-Event-ID"] = self._seen
        return Call("GET", f"/v1/jobs/{self._job_id}/events", headers)

    def begin(self, response: httpx.Response) -> bool:
        """Take the head of an answer; whether events follow."""
        self.over = response.status_code == HTTPStatus.NO_CONTENT
        return response.status_code == HTTPStatus.OK

    def feed(self, chunk: bytes) -> Iterator[Job]:
        """Yield the job as each event tells of it.

        Raises
        ------
        ServiceError
            The job was deleted.
        """
        for event, data in self._decoder.feed(chunk):
            self._seen = self._decoder.last_id
            if event == "deleted":
                problem = {
                    "type": "/problems/unknown-job",
                    "title": "The job has been deleted",
                    "detail": f"Job {self._job_id} was deleted while it was followed.",
                }
                raise ServiceError(HTTPStatus.NOT_FOUND, problem)
            if event == "job":
                job = Job.model_validate_json(data)
                self.over = job.status in FINAL
                yield job
        self._pause = FIRST_PAUSE
        self._deadline = time.monotonic() + self._flows.patience

    def ended(self, response: httpx.Response) -> float:
        """Return how long to wait after an answer that has ended.

        Raises
        ------
        ServiceError
            The server refused, and not for a while only.
        """
        if not response.is_error:
            return self._next_pause()
        wanted = retry_after(response)
        again = response.status_code in TRY_AGAIN
        if not again or time.monotonic() + max(self._pause, wanted) > self._deadline:
            raise refusal_of(response)
        return max(self._next_pause(), wanted)

    def broken(self, error: Exception) -> float:
        """Return how long to wait after a connection that broke.

        Raises
        ------
        ServerUnreachable
            It has been tried for long enough, or no time will help.
        """
        never = isinstance(error, httpx.UnsupportedProtocol)
        if never or time.monotonic() + self._pause > self._deadline:
            raise ServerUnreachable(unanswered(self._flows.server, error)) from error
        return self._next_pause()

    def _next_pause(self) -> float:
        pause, self._pause = self._pause, min(2 * self._pause, LONGEST_PAUSE)
        return pause
