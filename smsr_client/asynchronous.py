"""The client for programs on an event loop, of asyncio or trio."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

import anyio
import httpx
from anyio import to_thread

from smsr_client.address import server_address
from smsr_client.events import Following
from smsr_client.flows import (
    RESUMABLE_BYTES,
    Call,
    Flows,
    Pause,
    batch_url,
    connection,
    jobs_query,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from smsr_client.documents import (
        BatchCancelled,
        BatchDocument,
        BatchRetried,
        Info,
        Job,
        JobStatus,
    )
    from smsr_client.flows import Flow
    from smsr_client.result import Result
    from smsr_client.transfer import AnyPath, Transferred

Answer = TypeVar("Answer")


class AsyncClient:
    """A connection to one server, as `Client` with ``await``; an asynchronous context manager.

    Every method does what that of `Client` does and raises the same. Files are read and
    written, and the callables called, in other threads than that of the event loop.

    Parameters
    ----------
    server : str
        Address, as ``http://127.0.0.1:8000``.
    patience : float
        Seconds for which a request that fails in the network, or that a busy server puts off, is
        tried again. 0 never tries twice.
    api_key : str, optional
        Where the service needs one; by default that of the environment, SMSR_API_KEY.
    transport : httpx.AsyncBaseTransport, optional
        Another way to the server than the network.

    Raises
    ------
    WrongAddress
        The server's is no ``http://`` or ``https://`` address.
    """

    def __init__(
        self,
        server: str,
        *,
        patience: float = 60.0,
        api_key: str | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.server = server_address(server)
        self._flows = Flows(self.server, patience)
        self._http = httpx.AsyncClient(transport=transport, **connection(self.server, api_key))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def info(self) -> Info:
        """Return what the service is, accepts and offers."""
        return await self._run(self._flows.info())

    async def submit(
        self,
        measurements: AnyPath | NDArray[Any],
        *,
        ground_truth: AnyPath | NDArray[Any] | None = None,
        faces: AnyPath | NDArray[Any] | None = None,
        options: Mapping[str, object] | None = None,
        settings: Mapping[str, object] | None = None,
        progress: Transferred | None = None,
        resumable: int = RESUMABLE_BYTES,
    ) -> Job:
        """Upload files or arrays and start a job."""
        what = {"measurements": measurements, "ground_truth": ground_truth, "faces": faces}
        return await self._run(self._flows.submit(what, options, settings, progress, resumable))

    async def upload(
        self, what: AnyPath | NDArray[Any], *, progress: Transferred | None = None
    ) -> str:
        """Upload a file or an array by the tus protocol, over a network that breaks as well."""
        return await self._run(self._flows.upload(what, progress))

    async def get(self, job_id: str, *, wait: float = 0) -> Job:
        """Return a job, at once or within `wait` seconds when it has finished."""
        return await self._run(self._flows.get(job_id, wait))

    async def wait(
        self,
        job_id: str,
        *,
        timeout: float | None = None,
        progress: Callable[[Job], object] | None = None,
    ) -> Job:
        """Wait until a job has finished, well or not."""
        return await self._run(self._flows.wait(job_id, timeout, progress))

    async def events(self, job_id: str) -> AsyncIterator[Job]:
        """Yield a job at once and at each change, until it has ended (Server-Sent Events)."""
        following = Following(self._flows, job_id)
        while not following.over:
            try:
                request = self._request(following.call())
                response = await self._http.send(request, stream=True)
                async with aclosing(response):
                    if following.begin(response):
                        async for chunk in response.aiter_bytes():
                            for job in following.feed(chunk):
                                yield job
                    else:
                        await response.aread()
                pause = following.ended(response)
            except httpx.TransportError as error:
                pause = following.broken(error)
            if not following.over:
                await anyio.sleep(pause)

    async def result(self, job_id: str, *, progress: Transferred | None = None) -> Result:
        """Fetch the arrays of a job that succeeded."""
        return await self._run(self._flows.result(job_id, progress))

    async def reconstruct(
        self,
        measurements: AnyPath | NDArray[Any],
        *,
        ground_truth: AnyPath | NDArray[Any] | None = None,
        faces: AnyPath | NDArray[Any] | None = None,
        options: Mapping[str, object] | None = None,
        settings: Mapping[str, object] | None = None,
        timeout: float | None = None,
        progress: Callable[[Job], object] | None = None,
    ) -> Result:
        """Submit tracks, wait and fetch the arrays of the result."""
        what = {"measurements": measurements, "ground_truth": ground_truth, "faces": faces}
        return await self._run(self._flows.reconstruct(what, options, settings, timeout, progress))

    async def list(
        self, *, status: JobStatus | None = None, batch: str | None = None
    ) -> AsyncIterator[Job]:
        """Yield jobs, newest first, a page at a time."""
        query: str | None = jobs_query(status, batch)
        while query is not None:
            found, query = await self._run(self._flows.jobs(query))
            for job in found:
                yield job

    async def batch(self, label: str) -> BatchDocument:
        """Return how far the jobs of a batch are."""
        return await self._run(self._flows.batch(label))

    async def cancel_batch(self, label: str) -> BatchCancelled:
        """Cancel all jobs of a batch that have not ended."""
        return await self._run(self._flows.cancel_batch(label))

    async def retry_batch(self, label: str) -> BatchRetried:
        """Queue those jobs of a batch again that failed or were cancelled."""
        return await self._run(self._flows.retry_batch(label))

    async def delete_batch(self, label: str) -> None:
        """Remove all jobs of a batch with their files."""
        await self._run(self._flows.delete(batch_url(label)))

    async def download_batch(
        self, label: str, target: AnyPath, *, progress: Transferred | None = None
    ) -> Path:
        """Fetch the results of a batch as a ZIP, which appears whole or not at all."""
        return await self._run(
            self._flows.download(f"{batch_url(label)}/results.zip", target, progress)
        )

    async def cancel(self, job_id: str) -> Job:
        """Cancel a queued or running job; a running one stops within seconds."""
        return await self._run(self._flows.act(job_id, "cancel"))

    async def retry(self, job_id: str) -> Job:
        """Queue a finished job again, with the same inputs."""
        return await self._run(self._flows.act(job_id, "retry"))

    async def keep(self, job_id: str, ttl: float | None) -> Job:
        """Have a job kept for some seconds after its end; 0 for ever, None for the usual time."""
        return await self._run(self._flows.keep(job_id, ttl))

    async def delete(self, job_id: str) -> None:
        """Remove a job with its files, stopping it where it runs."""
        await self._run(self._flows.delete(f"/v1/jobs/{job_id}"))

    async def download(
        self,
        job_id: str,
        what: str,
        target: AnyPath,
        *,
        progress: Transferred | None = None,
    ) -> Path:
        """Fetch a result into a file, which appears whole or not at all."""
        return await self._run(self._flows.download(f"/v1/jobs/{job_id}/{what}", target, progress))

    async def _run(self, flow: Flow[Answer]) -> Answer:
        """Carry out the steps of an operation."""
        done, step = await to_thread.run_sync(_advance, flow, None)
        try:
            while not done:
                answer: httpx.Response | Exception | None = None
                if isinstance(step, Pause):
                    await anyio.sleep(step.seconds)
                else:
                    try:
                        answer = await self._send(step)
                    except (httpx.TransportError, httpx.InvalidURL) as error:
                        answer = error
                done, step = await to_thread.run_sync(_advance, flow, answer)
        finally:
            flow.close()
        return cast("Answer", step)

    def _request(self, call: Call) -> httpx.Request:
        request = self._http.build_request(
            call.method, call.url, headers=dict(call.headers), **call.body
        )
        if {"files", "content"} & call.body.keys():
            request.stream = _Threaded(cast("Iterable[bytes]", request.stream))
        return request

    async def _send(self, call: Call) -> httpx.Response:
        if call.into is None:
            return await self._http.send(self._request(call))
        response = await self._http.send(self._request(call), stream=True, follow_redirects=True)
        try:
            if call.into.begin(response):
                async for chunk in response.aiter_bytes():
                    await to_thread.run_sync(call.into.add, chunk)
            else:
                await response.aread()
        finally:
            call.into.end()
            with anyio.CancelScope(shield=True):
                await response.aclose()
        return response


class _Threaded(httpx.AsyncByteStream):
    """A body whose parts are read in another thread."""

    def __init__(self, parts: Iterable[bytes]) -> None:
        self._parts = parts

    async def __aiter__(self) -> AsyncIterator[bytes]:
        parts = iter(self._parts)
        while (part := await to_thread.run_sync(next, parts, None)) is not None:
            yield part


def _advance(flow: Flow[Any], answer: httpx.Response | Exception | None) -> tuple[bool, Any]:
    """Take an operation to its next step, or to its result: whether it is over, and which."""
    try:
        if isinstance(answer, Exception):
            return False, flow.throw(answer)
        return False, flow.send(answer)
    except StopIteration as stop:
        return True, stop.value
