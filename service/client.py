"""Client of the service: submit point tracks, follow the job, fetch the moving surface.

    with Client("http://127.0.0.1:8000") as client:
        job = client.wait(client.submit("tracks.npy").id)
        client.download(job.id, "result.npz", "result.npz")

What the network or a busy server makes fail is tried again, with growing pauses and as long as
``Retry-After`` asks; what the server refuses is raised as the problem document it sent (RFC 9457).
"""

from __future__ import annotations

import base64
import contextlib
import functools
import io
import json
import os
import time
import uuid
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Self, TypeAlias, cast
from urllib.parse import quote, urlencode, urlsplit

import httpx

from service.schemas import (
    BatchCancelled,
    BatchDocument,
    BatchRetried,
    Info,
    Job,
    JobList,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from types import TracebackType

    from service.schemas import JobStatus

    AnyPath: TypeAlias = str | os.PathLike[str]

Transferred: TypeAlias = Callable[[int, int], object]
"""Called with the bytes that went over and the bytes in all, 0 where those are not known."""

FINAL: Final = frozenset({"succeeded", "failed", "cancelled"})

_TRY_AGAIN: Final = frozenset(
    {
        HTTPStatus.TOO_MANY_REQUESTS,
        HTTPStatus.BAD_GATEWAY,
        HTTPStatus.SERVICE_UNAVAILABLE,
        HTTPStatus.GATEWAY_TIMEOUT,
    }
)
_NOT_YET: Final = frozenset({"submission-in-progress"})
_REFUSALS: Final = frozenset(
    {
        HTTPStatus.BAD_REQUEST,
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
        HTTPStatus.UNPROCESSABLE_ENTITY,
    }
)
_FIRST_PAUSE, _LONGEST_PAUSE = 0.25, 10.0
_CHUNK = 1 << 20
_TUS: Final = {"Tus-Resumable": "1.0.0"}
_STALLS = 8
"""How often an upload may be tried without any byte more."""
RESUMABLE_BYTES: Final = 64 << 20
"""Size of files from which on a broken upload is gone on with."""


class ClientError(Exception):
    """Base of what this client raises."""


class ServerUnreachable(ClientError):
    """No answer from the server, however often it was asked."""


class ServiceError(ClientError):
    """The server refused, and said why.

    Parameters
    ----------
    status : int
        HTTP status.
    problem : mapping
        The problem document (RFC 9457), or what could be made of another answer.
    """

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        title, detail = problem.get("title"), problem.get("detail")
        super().__init__(": ".join(str(part) for part in (title, detail) if part))
        self.status = status
        self.problem = dict(problem)

    @property
    def slug(self) -> str:
        """Name of the problem type, as in ``/problems/<slug>``."""
        return str(self.problem.get("type", "")).rpartition("/")[2]

    @property
    def refused_input(self) -> bool:
        """Whether the input or the options were at fault."""
        return self.status in _REFUSALS


class JobFailed(ClientError):
    """A job ended without a result.

    Parameters
    ----------
    job : Job
        The job; its `problem` says why.
    """

    def __init__(self, job: Job) -> None:
        why = ""
        if job.problem is not None:
            why = ": " + " ".join(f"{job.problem.title}. {job.problem.detail or ''}".split())
        outcome = "was cancelled" if job.status == "cancelled" else "failed"
        super().__init__(f"Job {job.id} {outcome}{why}")
        self.job = job


def require_success(job: Job) -> Job:
    """Return a job that succeeded.

    Raises
    ------
    JobFailed
        It failed or was cancelled.
    """
    if job.status in ("failed", "cancelled"):
        raise JobFailed(job)
    return job


class Client:
    """A connection to one server; usable from several threads and as a context manager.

    Parameters
    ----------
    server : str
        Address, as ``http://127.0.0.1:8000``.
    patience : float
        Seconds for which a request that fails in the network, or that a busy server puts off, is
        tried again. 0 never tries twice.
    api_key : str, optional
        Where the service needs one; by default that of the environment, SMSR_API_KEY.
    transport : httpx.BaseTransport, optional
        Another way to the server than the network.
    """

    def __init__(
        self,
        server: str,
        *,
        patience: float = 60.0,
        api_key: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        key = os.environ.get("SMSR_API_KEY", "") if api_key is None else api_key
        self.server = server.rstrip("/")
        self._patience = patience
        self._http = httpx.Client(
            base_url=self.server,
            transport=transport,
            # A proxy of the environment cannot reach this machine's loopback interface.
            mounts=dict.fromkeys(("all://127.0.0.1", "all://localhost", "all://[::1]")),
            timeout=httpx.Timeout(10.0, read=120.0, write=120.0),
            headers={"Accept": "application/json, application/problem+json"}
            | ({"Authorization": f"Bearer {key.strip()}"} if key else {}),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def info(self) -> Info:
        """Return what the service is, accepts and offers."""
        return Info.model_validate(self._request("GET", "/v1/info").json())

    def submit(
        self,
        measurements: AnyPath,
        *,
        ground_truth: AnyPath | None = None,
        faces: AnyPath | None = None,
        options: Mapping[str, object] | None = None,
        settings: Mapping[str, object] | None = None,
        progress: Transferred | None = None,
        resumable: int = RESUMABLE_BYTES,
    ) -> Job:
        """Upload files and start a job.

        Files are streamed. Those of `resumable` bytes and more together go over by the tus protocol
        (`upload`): after a broken connection the upload goes on where it stood. Where an answer is
        lost, the submission is repeated under the same Idempotency-Key, so that there is one job in
        the end.

        Parameters
        ----------
        measurements : path
            2D tracks: .npy, .npz, .mat, .h5, .csv, ...
        ground_truth, faces : path, optional
            Known 3D shapes to measure the error against, and the triangles of the surface.
        options : mapping, optional
            Names and values of options.
        settings : mapping, optional
            How the job is treated: batch, priority, ttl, reuse, ...
        progress : callable, optional
            Called while the files go over.
        resumable : int
            Size of all files from which on a broken upload is gone on with, not begun again.

        Raises
        ------
        ServiceError
            The server refused the files or the options.
        ServerUnreachable
            No answer.
        OSError
            A file cannot be read.
        """
        paths = {"measurements": measurements, "ground_truth": ground_truth, "faces": faces}
        given = {role: Path(path) for role, path in paths.items() if path is not None}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        if sum(path.stat().st_size for path in given.values()) >= resumable:
            return self._submit_uploads(given, options, settings, headers, progress)
        with contextlib.ExitStack() as stack:
            counter = _Counter(sum(path.stat().st_size for path in given.values()), progress)
            files = {
                role: (path.name, cast("IO[bytes]", stack.enter_context(_Reader(path, counter))))
                for role, path in given.items()
            }

            def send() -> httpx.Response:
                counter.restart()
                for _, file in files.values():
                    file.seek(0)
                # The options go first, so that the server can refuse early.
                data = {"options": json.dumps(dict(options))} if options else {}
                data |= {name: _text(value) for name, value in (settings or {}).items()}
                return self._http.post("/v1/jobs", data=data, files=files, headers=headers)

            return Job.model_validate(self._insist(send).json())

    def _submit_uploads(
        self,
        files: Mapping[str, Path],
        options: Mapping[str, object] | None,
        settings: Mapping[str, object] | None,
        headers: Mapping[str, str],
        progress: Transferred | None,
    ) -> Job:
        counter = _Counter(sum(path.stat().st_size for path in files.values()), progress)
        counter.restart()
        document: dict[str, object] = {**(settings or {}), "options": dict(options or {})}
        for role, path in files.items():
            document[role] = {"upload": self._upload(path, role, counter)}
        send = functools.partial(self._http.post, "/v1/jobs", json=document, headers=headers)
        return Job.model_validate(self._insist(send).json())

    def upload(self, path: AnyPath, *, progress: Transferred | None = None) -> str:
        """Upload a file by the tus protocol, over a network that breaks as well.

        Parameters
        ----------
        path : path
        progress : callable, optional
            Called while the file goes over.

        Returns
        -------
        str
            Id of the upload, of which a job can be made.

        Raises
        ------
        ServiceError
            The server refused the file.
        ServerUnreachable
            No answer, or no progress any more.
        OSError
            The file cannot be read.
        """
        path = Path(path)
        counter = _Counter(path.stat().st_size, progress)
        counter.restart()
        return self._upload(path, "", counter)

    def _upload(self, path: Path, role: str, counter: _Counter) -> str:
        told = {"filename": path.name} | ({"role": role} if role else {})
        metadata = ",".join(
            f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in told.items()
        )
        size = path.stat().st_size
        headers = _TUS | {"Upload-Length": str(size), "Upload-Metadata": metadata}
        created = self._request("POST", "/v1/uploads", headers=headers)
        upload_id = created.headers["location"].rpartition("/")[2]
        url = f"/v1/uploads/{upload_id}"
        before = counter.done
        offset = 0
        with _Reader(path, counter) as file:

            def send() -> httpx.Response:
                return self._http.patch(
                    url,
                    content=iter(functools.partial(file.read, _CHUNK), b""),
                    headers=_TUS
                    | {
                        "Content-Type": "application/offset+octet-stream",
                        "Content-Length": str(size - offset),
                        "Upload-Offset": str(offset),
                    },
                )

            stalls = 0
            while offset < size:
                counter.to(before + offset)
                file.seek(offset)
                try:
                    answer = send()
                except httpx.TransportError:
                    pass
                else:
                    behind = answer.status_code == HTTPStatus.CONFLICT
                    if answer.is_error and not behind and answer.status_code not in _TRY_AGAIN:
                        raise _service_error(answer)
                reached = int(self._request("HEAD", url, headers=_TUS).headers["upload-offset"])
                stalls = 0 if reached > offset else stalls + 1
                if stalls > _STALLS:
                    raise ServerUnreachable(f"The upload of {path.name} does not go on.")
                if stalls:
                    time.sleep(min(_FIRST_PAUSE * 2**stalls, _LONGEST_PAUSE))
                offset = reached
            counter.to(before + size)
        return upload_id

    def get(self, job_id: str, *, wait: float = 0) -> Job:
        """Return a job.

        Parameters
        ----------
        job_id : str
            Its id.
        wait : float
            Seconds for which the server may hold the answer back until the job has finished.
        """
        headers = {"Prefer": f"wait={wait:.0f}"} if wait >= 1 else {}
        return Job.model_validate(
            self._request("GET", f"/v1/jobs/{job_id}", headers=headers).json()
        )

    def wait(
        self,
        job_id: str,
        *,
        timeout: float | None = None,
        progress: Callable[[Job], object] | None = None,
    ) -> Job:
        """Wait until a job has finished, well or not.

        Parameters
        ----------
        job_id : str
            Its id.
        timeout : float, optional
            Seconds to wait at most.
        progress : callable, optional
            Called with the job about once a second. Returning ``False`` ends the waiting.

        Returns
        -------
        Job
            Finished, unless `progress` ended the waiting.

        Raises
        ------
        TimeoutError
            The time is over and the job has not finished.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        patient = 30.0 if progress is None else 1.0
        while True:
            left = patient if deadline is None else min(patient, deadline - time.monotonic())
            job = self.get(job_id, wait=max(left, 0))
            told = progress(job) if progress is not None else None
            if job.status in FINAL or told is False:
                return job
            if deadline is not None and time.monotonic() >= deadline:
                raise TimeoutError(f"Job {job_id} was still {job.status} after {timeout} s.")
            if left < 1:
                time.sleep(min(max(left, 0.05), 0.5))

    def list(self, *, status: JobStatus | None = None, batch: str | None = None) -> Iterator[Job]:
        """Yield jobs, newest first, a page at a time.

        Parameters
        ----------
        status : str, optional
            Only jobs of this status.
        batch : str, optional
            Only jobs of this batch.
        """
        given = {"status": status, "batch": batch}
        query: str | None = urlencode({name: text for name, text in given.items() if text})
        while query is not None:
            found = JobList.model_validate(self._request("GET", f"/v1/jobs?{query}").json())
            yield from found.jobs
            # A path, perhaps with the prefix of a proxy that stands in our address already.
            query = None if found.next is None else urlsplit(found.next).query

    def batch(self, label: str) -> BatchDocument:
        """Return how far the jobs of a batch are."""
        return BatchDocument.model_validate(self._request("GET", _batch(label)).json())

    def cancel_batch(self, label: str) -> BatchCancelled:
        """Cancel all jobs of a batch that have not ended."""
        answer = self._request("POST", f"{_batch(label)}/cancel")
        return BatchCancelled.model_validate(answer.json())

    def retry_batch(self, label: str) -> BatchRetried:
        """Queue those jobs of a batch again that failed or were cancelled."""
        answer = self._request("POST", f"{_batch(label)}/retry")
        return BatchRetried.model_validate(answer.json())

    def delete_batch(self, label: str) -> None:
        """Remove all jobs of a batch with their files."""
        self._request("DELETE", _batch(label))

    def download_batch(
        self, label: str, target: AnyPath, *, progress: Transferred | None = None
    ) -> Path:
        """Fetch the results of a batch as a ZIP, which appears whole or not at all."""
        return self._fetch(f"{_batch(label)}/results.zip", target, progress)

    def cancel(self, job_id: str) -> Job:
        """Cancel a queued or running job; a running one stops within seconds."""
        return Job.model_validate(self._request("POST", f"/v1/jobs/{job_id}/cancel").json())

    def retry(self, job_id: str) -> Job:
        """Queue a finished job again, with the same inputs."""
        return Job.model_validate(self._request("POST", f"/v1/jobs/{job_id}/retry").json())

    def delete(self, job_id: str) -> None:
        """Remove a job with its files, stopping it where it runs."""
        self._request("DELETE", f"/v1/jobs/{job_id}")

    def download(
        self,
        job_id: str,
        what: str,
        target: AnyPath,
        *,
        progress: Transferred | None = None,
    ) -> Path:
        """Fetch a result into a file, which appears whole or not at all.

        Where the connection breaks, the download goes on with what is missing, unless the job has
        been run again meanwhile.

        Parameters
        ----------
        job_id : str
            A job that succeeded.
        what : str
            ``result.npz``, ``frames.zip``, ``frames/<t>.ply`` or ``report.json``.
        target : path
            The file to write; folders are made where needed.
        progress : callable, optional
            Called while the file comes in.

        Returns
        -------
        Path
            `target`.
        """
        return self._fetch(f"/v1/jobs/{job_id}/{what}", target, progress)

    def _fetch(self, url: str, target: AnyPath, progress: Transferred | None) -> Path:
        target = Path(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(target.name + ".part")
        tag = ""

        def fetch() -> httpx.Response:
            nonlocal tag
            # Bytes of a range count as they are sent, so no coding may be laid over them.
            headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
            held = part.stat().st_size if tag and part.exists() else 0
            if held:
                headers |= {"Range": f"bytes={held}-", "If-Range": tag}
            # The service may send to the storage itself for a file.
            with self._http.stream("GET", url, headers=headers, follow_redirects=True) as response:
                partial = response.status_code == HTTPStatus.PARTIAL_CONTENT
                former, tag = tag, _strong_tag(response)
                if held and (response.is_client_error or (partial and tag != former)):
                    # Nothing of this file can be added to what is there: begin again.
                    part.unlink()
                    raise httpx.ReadError("the file has changed")
                if response.is_error:
                    tag = former
                    response.read()
                    return response
                if not partial:
                    held = 0
                length = int(response.headers.get("content-length", 0))
                counter = _Counter(held + length if length else 0, progress)
                counter.add(held)
                with part.open("ab" if held else "wb", buffering=0) as file:
                    # As they arrive: what is collected is lost when the connection breaks.
                    for chunk in response.iter_bytes():
                        file.write(chunk)
                        counter.add(len(chunk))
                return response

        try:
            self._insist(fetch)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        return target

    def _request(
        self, method: str, url: str, *, headers: Mapping[str, str] | None = None
    ) -> httpx.Response:
        return self._insist(lambda: self._http.request(method, url, headers=headers))

    def _insist(self, send: Callable[[], httpx.Response]) -> httpx.Response:
        """Send until an answer comes that is worth having, or patience ends."""
        deadline = time.monotonic() + self._patience
        pause = _FIRST_PAUSE
        while True:
            try:
                response = send()
            except httpx.TransportError as error:
                if time.monotonic() + pause > deadline:
                    raise ServerUnreachable(
                        f"No answer from {self.server} ({error}). Is the server running, and is "
                        "its address right?"
                    ) from error
                wanted = 0.0
            except httpx.InvalidURL as error:
                raise ServerUnreachable(f"{self.server} is no address: {error}.") from error
            else:
                if not response.is_error:
                    return response
                wanted = _retry_after(response)
                refusal = _service_error(response)
                busy = response.status_code in _TRY_AGAIN or refusal.slug in _NOT_YET
                if not busy or time.monotonic() + max(pause, wanted) > deadline:
                    raise refusal
            time.sleep(max(pause, wanted))
            pause = min(2 * pause, _LONGEST_PAUSE)


class _Counter:
    """Adds up bytes and reports them."""

    def __init__(self, total: int, report: Transferred | None) -> None:
        self._total, self._report, self._done = total, report, 0

    def restart(self) -> None:
        self._done = 0
        self.add(0)

    @property
    def done(self) -> int:
        return self._done

    def to(self, done: int) -> None:
        """Set what went over, in which a resumed upload goes back."""
        self._done = done
        self.add(0)

    def add(self, count: int) -> None:
        self._done += count
        if self._report is not None:
            self._report(self._done, self._total)


class _Reader(io.FileIO):
    """A file that reports how much of it was read."""

    def __init__(self, path: Path, counter: _Counter) -> None:
        super().__init__(path, "rb")
        self._counter = counter

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(-1 if size is None else size) or b""
        self._counter.add(len(data))
        return data


def _strong_tag(response: httpx.Response) -> str:
    """Return the entity tag where the file can be asked for in parts, otherwise nothing."""
    tag = str(response.headers.get("etag", ""))
    in_parts = response.headers.get("accept-ranges") == "bytes"
    return tag if in_parts and not tag.startswith("W/") else ""


def _text(value: object) -> str:
    """Return a setting as the text of a part."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _batch(label: str) -> str:
    return f"/v1/batches/{quote(label, safe='')}"


def _retry_after(response: httpx.Response) -> float:
    """Seconds of Retry-After (RFC 9110, section 10.2.3); its form as a date counts as none."""
    try:
        return max(float(response.headers.get("retry-after", 0)), 0.0)
    except ValueError:
        return 0.0


def _service_error(response: httpx.Response) -> ServiceError:
    problem: dict[str, Any] = {}
    with contextlib.suppress(ValueError):
        document = response.json()
        if isinstance(document, dict):
            problem = document
    if "title" not in problem:
        problem = {"title": f"The server answered {response.status_code} {response.reason_phrase}"}
    return ServiceError(response.status_code, problem)
