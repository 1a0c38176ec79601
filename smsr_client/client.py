"""The client for programs that wait for each answer."""

from __future__ import annotations

import time
from contextlib import closing
from typing import TYPE_CHECKING, Any, Self, TypeVar

import httpx

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
    from collections.abc import Callable, Iterator, Mapping
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
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.server = server_address(server)
        self._flows = Flows(self.server, patience)
        self._http = httpx.Client(transport=transport, **connection(self.server, api_key))

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
        return self._run(self._flows.info())

    def submit(
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
        """Upload files or arrays and start a job.

        Files are streamed. Those of `resumable` bytes and more together go over by the tus protocol
        (`upload`): after a broken connection the upload goes on where it stood. Where an answer is
        lost, the submission is repeated under the same Idempotency-Key, so that there is one job in
        the end.

        Parameters
        ----------
        measurements : path or ndarray
            2D tracks: .npy, .npz, .mat, .h5, .csv, ..., or an array of shape (2T, N), (T, 2, N) or
            (T, N, 2).
        ground_truth, faces : path or ndarray, optional
            Known 3D shapes to measure the error against, and the triangles of the surface.
        options : mapping, optional
            Names and values of options.
        settings : mapping, optional
            How the job is treated: batch, priority, ttl, reuse, webhook.
        progress : callable, optional
            Called while the files go over with the bytes that went and the bytes in all.
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
        what = {"measurements": measurements, "ground_truth": ground_truth, "faces": faces}
        return self._run(self._flows.submit(what, options, settings, progress, resumable))

    def upload(self, what: AnyPath | NDArray[Any], *, progress: Transferred | None = None) -> str:
        """Upload a file or an array by the tus protocol, over a network that breaks as well.

        Parameters
        ----------
        what : path or ndarray
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
        return self._run(self._flows.upload(what, progress))

    def get(self, job_id: str, *, wait: float = 0) -> Job:
        """Return a job.

        Parameters
        ----------
        job_id : str
            Its id.
        wait : float
            Seconds for which the server may hold the answer back until the job has finished.
        """
        return self._run(self._flows.get(job_id, wait))

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
        return self._run(self._flows.wait(job_id, timeout, progress))

    def events(self, job_id: str) -> Iterator[Job]:
        """Yield a job at once and at each change, until it has ended (Server-Sent Events).

        After a broken connection the events go on with what was not seen.

        Parameters
        ----------
        job_id : str
            Its id.

        Raises
        ------
        ServiceError
            There is no such job, or it was deleted meanwhile.
        ServerUnreachable
            No connection for as long as `patience`.
        """
        following = Following(self._flows, job_id)
        while not following.over:
            try:
                request = self._request(following.call())
                response = self._http.send(request, stream=True)
                with closing(response):
                    if following.begin(response):
                        for chunk in response.iter_bytes():
                            yield from following.feed(chunk)
                    else:
                        response.read()
                pause = following.ended(response)
            except httpx.TransportError as error:
                pause = following.broken(error)
            if not following.over:
                time.sleep(pause)

    def result(self, job_id: str, *, progress: Transferred | None = None) -> Result:
        """Fetch the arrays of a job that succeeded.

        Parameters
        ----------
        job_id : str
            Its id.
        progress : callable, optional
            Called while they come in.

        Raises
        ------
        ServiceError
            There is no such job, or it has no result (yet).
        """
        return self._run(self._flows.result(job_id, progress))

    def reconstruct(
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
        """Submit tracks, wait and fetch the arrays of the result.

        Parameters are those of `submit` and `wait`.

        Raises
        ------
        JobFailed
            The job failed or was cancelled.
        TimeoutError
            It had not ended after `timeout` seconds; it goes on.
        ServiceError
            The server refused the input.
        """
        what = {"measurements": measurements, "ground_truth": ground_truth, "faces": faces}
        return self._run(self._flows.reconstruct(what, options, settings, timeout, progress))

    def list(self, *, status: JobStatus | None = None, batch: str | None = None) -> Iterator[Job]:
        """Yield jobs, newest first, a page at a time.

        Parameters
        ----------
        status : str, optional
            Only jobs of this status.
        batch : str, optional
            Only jobs of this batch.
        """
        query: str | None = jobs_query(status, batch)
        while query is not None:
            found, query = self._run(self._flows.jobs(query))
            yield from found

    def batch(self, label: str) -> BatchDocument:
        """Return how far the jobs of a batch are."""
        return self._run(self._flows.batch(label))

    def cancel_batch(self, label: str) -> BatchCancelled:
        """Cancel all jobs of a batch that have not ended."""
        return self._run(self._flows.cancel_batch(label))

    def retry_batch(self, label: str) -> BatchRetried:
        """Queue those jobs of a batch again that failed or were cancelled."""
        return self._run(self._flows.retry_batch(label))

    def delete_batch(self, label: str) -> None:
        """Remove all jobs of a batch with their files."""
        self._run(self._flows.delete(batch_url(label)))

    def download_batch(
        self, label: str, target: AnyPath, *, progress: Transferred | None = None
    ) -> Path:
        """Fetch the results of a batch as a ZIP, which appears whole or not at all."""
        return self._run(self._flows.download(f"{batch_url(label)}/results.zip", target, progress))

    def cancel(self, job_id: str) -> Job:
        """Cancel a queued or running job; a running one stops within seconds."""
        return self._run(self._flows.act(job_id, "cancel"))

    def retry(self, job_id: str) -> Job:
        """Queue a finished job again, with the same inputs."""
        return self._run(self._flows.act(job_id, "retry"))

    def keep(self, job_id: str, ttl: float | None) -> Job:
        """Have a job kept for some seconds after its end, which may be over already.

        Parameters
        ----------
        job_id : str
            Its id.
        ttl : float or None
            Seconds; 0 for ever, None for the service's own time.
        """
        return self._run(self._flows.keep(job_id, ttl))

    def delete(self, job_id: str) -> None:
        """Remove a job with its files, stopping it where it runs."""
        self._run(self._flows.delete(f"/v1/jobs/{job_id}"))

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
            ``result.npz``, ``result.glb``, ``frames.zip``, ``frames/<t>.ply``, ``shapes.npy``,
            ``report.json``, ...
        target : path
            The file to write; folders are made where needed.
        progress : callable, optional
            Called while the file comes in.

        Returns
        -------
        Path
            `target`.
        """
        return self._run(self._flows.download(f"/v1/jobs/{job_id}/{what}", target, progress))

    def _run(self, flow: Flow[Answer]) -> Answer:
        """Carry out the steps of an operation."""
        try:
            step = next(flow)
            while True:
                if isinstance(step, Pause):
                    time.sleep(step.seconds)
                    step = next(flow)
                    continue
                try:
                    answer = self._send(step)
                except (httpx.TransportError, httpx.InvalidURL) as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(answer)
        except StopIteration as stop:
            result: Answer = stop.value
            return result
        finally:
            flow.close()

    def _request(self, call: Call) -> httpx.Request:
        return self._http.build_request(
            call.method, call.url, headers=dict(call.headers), **call.body
        )

    def _send(self, call: Call) -> httpx.Response:
        if call.into is None:
            return self._http.send(self._request(call))
        response = self._http.send(self._request(call), stream=True, follow_redirects=True)
        try:
            if call.into.begin(response):
                for chunk in response.iter_bytes():
                    call.into.add(chunk)
            else:
                response.read()
        finally:
            call.into.end()
            response.close()
        return response
