"""What the client says to the server, and what it makes of the answers, without doing the talking.

Each operation is a generator that yields what is to be done next, a request or a pause, and is
given the answer; what it returns is the result. `Client` and `AsyncClient` carry the steps out, so
that requests, retries and the reading of answers are the same in both.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import os
import tempfile
import time
import uuid
from collections.abc import Generator
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar
from urllib.parse import quote, urlencode, urlsplit

import httpx
import numpy as np

from smsr_client.documents import (
    FINAL,
    BatchCancelled,
    BatchDocument,
    BatchRetried,
    Info,
    Job,
    JobList,
)
from smsr_client.errors import ServerUnreachable, refusal_of, require_success
from smsr_client.result import Result, read_result
from smsr_client.transfer import Counter, PartialFile, Source

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smsr_client.transfer import AnyPath, Transferred

Answer = TypeVar("Answer")

TRY_AGAIN: Final = frozenset(
    {
        HTTPStatus.TOO_MANY_REQUESTS,
        HTTPStatus.BAD_GATEWAY,
        HTTPStatus.SERVICE_UNAVAILABLE,
        HTTPStatus.GATEWAY_TIMEOUT,
    }
)
FIRST_PAUSE: Final = 0.25
LONGEST_PAUSE: Final = 10.0
RESUMABLE_BYTES: Final = 64 << 20
"""Size of files from which on a broken upload is gone on with."""

_NOT_YET: Final = frozenset({"submission-in-progress"})
_CHUNK = 1 << 20
_TUS: Final = {"Tus-Resumable": "1.0.0"}
_STALLS = 8
"""How often an upload may be tried without any byte more."""


@dataclass(frozen=True, slots=True)
class Call:
    """A request.

    Attributes
    ----------
    method, url : str
    headers : mapping
    body : mapping
        The body as `httpx.Client.build_request` takes it: json, data, files or content, which may
        read files as it goes over.
    into : PartialFile, optional
        Where the body of the answer goes; redirections are followed then.
    """

    method: str
    url: str
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Mapping[str, Any] = field(default_factory=dict)
    into: PartialFile | None = None


@dataclass(frozen=True, slots=True)
class Pause:
    """Time in which nothing is done."""

    seconds: float


Flow: TypeAlias = Generator[Call | Pause, Any, Answer]
"""Yields steps, is sent the `httpx.Response` of each call or thrown its error, returns a result."""


def connection(server: str, api_key: str | None) -> dict[str, Any]:
    """Return how an httpx client is set up for a server."""
    key = os.environ.get("SMSR_API_KEY", "") if api_key is None else api_key
    return {
        "base_url": server,
        # A proxy of the environment cannot reach this machine's loopback interface.
        "mounts": dict.fromkeys(("all://127.0.0.1", "all://localhost", "all://[::1]")),
        "timeout": httpx.Timeout(10.0, read=120.0, write=120.0),
        "headers": {"Accept": "application/json, application/problem+json"}
        | ({"Authorization": f"Bearer {key.strip()}"} if key else {}),
    }


class Flows:
    """The operations of the client.

    Parameters
    ----------
    server : str
        Address, for messages.
    patience : float
        Seconds for which what fails is tried again.
    """

    def __init__(self, server: str, patience: float) -> None:
        self.server, self.patience = server, patience

    def info(self) -> Flow[Info]:
        """Ask what the service is."""
        answer = yield from self._request("GET", "/v1/info")
        return Info.model_validate_json(answer.content)

    def submit(
        self,
        what: Mapping[str, Any],
        options: Mapping[str, object] | None,
        settings: Mapping[str, object] | None,
        progress: Transferred | None,
        resumable: int,
    ) -> Flow[Job]:
        """Upload what is given by role, and start a job."""
        sources = {role: Source(one, role) for role, one in what.items() if one is not None}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        total = sum(source.bytes for source in sources.values())
        counter = Counter(total, progress)
        if total >= resumable:
            return (yield from self._submit_uploads(sources, options, settings, headers, counter))
        # The options go first, so that the server can refuse early.
        data = {"options": json.dumps(_plain(options))} if options else {}
        data |= {name: _text(value) for name, value in _plain(settings).items()}
        with contextlib.ExitStack() as stack:
            files = {
                role: (source.name, stack.enter_context(source.open(counter)))
                for role, source in sources.items()
            }

            def send() -> Call:
                counter.to(0)
                for _, file in files.values():
                    file.seek(0)
                return Call("POST", "/v1/jobs", headers, {"data": data, "files": files})

            answer = yield from self._insist(send)
        return Job.model_validate_json(answer.content)

    def _submit_uploads(
        self,
        sources: Mapping[str, Source],
        options: Mapping[str, object] | None,
        settings: Mapping[str, object] | None,
        headers: Mapping[str, str],
        counter: Counter,
    ) -> Flow[Job]:
        counter.to(0)
        document: dict[str, object] = _plain(settings) | {"options": _plain(options)}
        for role, source in sources.items():
            upload_id = yield from self._upload(source, role, counter)
            document[role] = {"upload": upload_id}
        call = Call("POST", "/v1/jobs", headers, {"json": document})
        answer = yield from self._insist(lambda: call)
        return Job.model_validate_json(answer.content)

    def upload(self, what: Any, progress: Transferred | None) -> Flow[str]:
        """Upload one file by the tus protocol and return the upload's id."""
        source = Source(what, "upload")
        counter = Counter(source.bytes, progress)
        counter.to(0)
        return (yield from self._upload(source, "", counter))

    def _upload(self, source: Source, role: str, counter: Counter) -> Flow[str]:
        told = {"filename": source.name} | ({"role": role} if role else {})
        metadata = ",".join(
            f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in told.items()
        )
        size = source.bytes
        created = yield from self._request(
            "POST",
            "/v1/uploads",
            _TUS | {"Upload-Length": str(size), "Upload-Metadata": metadata},
        )
        upload_id: str = created.headers["location"].rpartition("/")[2]
        url = f"/v1/uploads/{upload_id}"
        before = counter.done
        offset = stalls = 0
        with source.open(counter) as file:
            while offset < size:
                counter.to(before + offset)
                file.seek(offset)
                headers = _TUS | {
                    "Content-Type": "application/offset+octet-stream",
                    "Content-Length": str(size - offset),
                    "Upload-Offset": str(offset),
                }
                chunks = iter(functools.partial(file.read, _CHUNK), b"")
                try:
                    answer = yield Call("PATCH", url, headers, {"content": chunks})
                except httpx.TransportError:
                    pass
                else:
                    behind = answer.status_code == HTTPStatus.CONFLICT
                    if answer.is_error and not behind and answer.status_code not in TRY_AGAIN:
                        raise refusal_of(answer)
                found = yield from self._request("HEAD", url, _TUS)
                reached = int(found.headers["upload-offset"])
                stalls = 0 if reached > offset else stalls + 1
                if stalls > _STALLS:
                    raise ServerUnreachable(f"The upload of {source.name} does not go on.")
                if stalls:
                    yield Pause(min(FIRST_PAUSE * 2**stalls, LONGEST_PAUSE))
                offset = reached
            counter.to(before + size)
        return upload_id

    def get(self, job_id: str, wait: float = 0) -> Flow[Job]:
        """Ask for a job."""
        headers = {"Prefer": f"wait={wait:.0f}"} if wait >= 1 else {}
        answer = yield from self._request("GET", f"/v1/jobs/{job_id}", headers)
        return Job.model_validate_json(answer.content)

    def wait(
        self,
        job_id: str,
        timeout: float | None,
        progress: Callable[[Job], object] | None,
    ) -> Flow[Job]:
        """Wait until a job has ended."""
        deadline = None if timeout is None else time.monotonic() + timeout
        patient = 30.0 if progress is None else 1.0
        while True:
            left = patient if deadline is None else min(patient, deadline - time.monotonic())
            job = yield from self.get(job_id, max(left, 0))
            told = progress(job) if progress is not None else None
            if job.status in FINAL or told is False:
                return job
            if deadline is not None and time.monotonic() >= deadline:
                raise TimeoutError(f"Job {job_id} was still {job.status} after {timeout} s.")
            if left < 1:
                yield Pause(min(max(left, 0.05), 0.5))

    def jobs(self, query: str) -> Flow[tuple[list[Job], str | None]]:
        """Ask for a page of jobs; with them comes the query of the next page."""
        answer = yield from self._request("GET", f"/v1/jobs?{query}")
        page = JobList.model_validate_json(answer.content)
        # A path, perhaps with the prefix of a proxy that stands in our address already.
        return page.jobs, None if page.next is None else urlsplit(page.next).query

    def act(self, job_id: str, action: str) -> Flow[Job]:
        """Cancel a job or queue it again."""
        answer = yield from self._request("POST", f"/v1/jobs/{job_id}/{action}")
        return Job.model_validate_json(answer.content)

    def keep(self, job_id: str, ttl: float | None) -> Flow[Job]:
        """Set the time to live of a job."""
        call = Call("PATCH", f"/v1/jobs/{job_id}", {}, {"json": _plain({"ttl": ttl})})
        answer = yield from self._insist(lambda: call)
        return Job.model_validate_json(answer.content)

    def delete(self, url: str) -> Flow[None]:
        """Remove a job or a batch."""
        yield from self._request("DELETE", url)

    def batch(self, label: str) -> Flow[BatchDocument]:
        """Ask for a batch."""
        answer = yield from self._request("GET", batch_url(label))
        return BatchDocument.model_validate_json(answer.content)

    def cancel_batch(self, label: str) -> Flow[BatchCancelled]:
        """Cancel a batch."""
        answer = yield from self._request("POST", f"{batch_url(label)}/cancel")
        return BatchCancelled.model_validate_json(answer.content)

    def retry_batch(self, label: str) -> Flow[BatchRetried]:
        """Queue a batch again."""
        answer = yield from self._request("POST", f"{batch_url(label)}/retry")
        return BatchRetried.model_validate_json(answer.content)

    def download(self, url: str, target: AnyPath, progress: Transferred | None) -> Flow[Path]:
        """Fetch a file, which appears whole or not at all."""
        target = Path(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(target.name + ".part")
        file = PartialFile(part, progress)
        try:
            # The service may send to the storage itself for a file.
            yield from self._insist(lambda: Call("GET", url, file.headers(), into=file))
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        return target

    def result(self, job_id: str, progress: Transferred | None) -> Flow[Result]:
        """Fetch the arrays of a job that succeeded."""
        here = f"/v1/jobs/{job_id}"
        report = yield from self._request("GET", f"{here}/report.json")
        with tempfile.TemporaryDirectory(prefix="smsr-") as folder:
            npz = Path(folder) / "result.npz"
            yield from self.download(f"{here}/result.npz", npz, progress)
            return read_result(job_id, npz, report.json())

    def reconstruct(
        self,
        what: Mapping[str, Any],
        options: Mapping[str, object] | None,
        settings: Mapping[str, object] | None,
        timeout: float | None,
        progress: Callable[[Job], object] | None,
    ) -> Flow[Result]:
        """Submit, wait and fetch."""
        job = yield from self.submit(what, options, settings, None, RESUMABLE_BYTES)
        job = yield from self.wait(job.id, timeout, progress)
        return (yield from self.result(require_success(job).id, None))

    def _request(
        self, method: str, url: str, headers: Mapping[str, str] | None = None
    ) -> Flow[httpx.Response]:
        call = Call(method, url, headers or {})
        return (yield from self._insist(lambda: call))

    def _insist(self, send: Callable[[], Call]) -> Flow[httpx.Response]:
        """Send until an answer comes that is worth having, or patience ends."""
        deadline = time.monotonic() + self.patience
        pause = FIRST_PAUSE
        while True:
            try:
                response: httpx.Response = yield send()
            except (httpx.UnsupportedProtocol, httpx.InvalidURL) as error:
                raise ServerUnreachable(f"{self.server} cannot be asked: {error}") from error
            except httpx.TransportError as error:
                if time.monotonic() + pause > deadline:
                    raise ServerUnreachable(unanswered(self.server, error)) from error
                wanted = 0.0
            else:
                if not response.is_error:
                    return response
                wanted = retry_after(response)
                refusal = refusal_of(response)
                busy = response.status_code in TRY_AGAIN or refusal.slug in _NOT_YET
                if not busy or time.monotonic() + max(pause, wanted) > deadline:
                    raise refusal
            yield Pause(max(pause, wanted))
            pause = min(2 * pause, LONGEST_PAUSE)


def jobs_query(status: str | None, batch: str | None) -> str:
    """Return the query of the first page of a list."""
    given = {"status": status, "batch": batch}
    return urlencode({name: text for name, text in given.items() if text})


def batch_url(label: str) -> str:
    """Return the path of a batch."""
    return f"/v1/batches/{quote(label, safe='')}"


def retry_after(response: httpx.Response) -> float:
    """Seconds of Retry-After (RFC 9110, section 10.2.3); its form as a date counts as none."""
    try:
        return max(float(response.headers.get("retry-after", 0)), 0.0)
    except ValueError:
        return 0.0


def unanswered(server: str, error: Exception) -> str:
    """Return what to tell a person whose server does not answer."""
    return f"No answer from {server} ({error}). Is the server running, and is its address right?"


def _plain(values: Mapping[str, object] | None) -> dict[str, object]:
    """Return values with the scalars of numpy, which JSON does not know, as numbers of Python."""
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in (values or {}).items()
    }


def _text(value: object) -> str:
    """Return a setting as the text of a part."""
    return str(value).lower() if isinstance(value, bool) else str(value)
