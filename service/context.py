"""What the routes share: the queue, the storage and the feed of changes."""

from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import Depends, Path, Request

from service.downloads import OpenResults
from service.metrics import Metrics
from service.problems import Problem
from service.requests import request_id
from worker.changes import ChangeFeed
from worker.disk import Disk
from worker.queue import JobQueue
from worker.records import ANY, Allowance, JobRecord
from worker.settings import Settings
from worker.storage import ObjectStorage
from worker.tracing import Tracing
from worker.uploads import Digests, UploadStore


@dataclass(frozen=True, slots=True)
class Context:
    """The worker floor, as the routes use it.

    Attributes
    ----------
    settings : Settings
    queue : JobQueue
        Its calls block; they are made in threads.
    feed : ChangeFeed
        Changes of jobs, for those who wait.
    results : OpenResults
    metrics : Metrics
    uploads : UploadStore
        Uploads on their own; its calls block.
    digests : Digests
        Of the uploads that this process receives.
    tracing : Tracing
    disk : Disk
    owner : str or None
        Whose jobs this request may see and make; None where all clients share all of them.
    allowance : Allowance
        What the owner may have.
    request : str or None
        Id of the request.
    """

    settings: Settings
    queue: JobQueue
    feed: ChangeFeed
    results: OpenResults
    metrics: Metrics
    uploads: UploadStore
    digests: Digests
    tracing: Tracing
    disk: Disk
    owner: str | None = None
    allowance: Allowance = ANY
    request: str | None = None

    @property
    def storage(self) -> ObjectStorage:
        """Where uploads and results are."""
        return self.queue.storage

    async def record(self, job_id: str) -> JobRecord:
        """Return the record of a job that this request may see.

        Raises
        ------
        Problem
            There is no such job, or it is another owner's: a client cannot tell which.
        """
        record = await self.feed.get(job_id)
        if record is None or (self.owner is not None and record.owner != self.owner):
            raise unknown_job(job_id)
        return record


def unknown_job(job_id: str) -> Problem:
    """Return the refusal of a request for a job that does not exist."""
    return Problem("unknown-job", f"There is no job {job_id}; it may have been deleted or expired.")


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return replace(
        context,
        owner=request.state.owner,
        allowance=request.state.allowance,
        request=request_id(request.scope),
    )


def _job_id(
    job_id: Annotated[
        str,
        Path(description="Id of the job.", examples=["0f8fad5bd9cb469fa16570867728950e"]),
    ],
) -> str:
    """Refuse what is no id before it gets near a key of Redis or of the storage."""
    if len(job_id) != 32 or not set(job_id) <= set("0123456789abcdef"):
        raise Problem("unknown-job", "There is no such job; ids are 32 hexadecimal digits.")
    return job_id


Shared = Annotated[Context, Depends(_context)]
JobId = Annotated[str, Depends(_job_id)]


def root_of(request: Request) -> str:
    """Return the path prefix under which a proxy serves the service."""
    root: str = request.scope.get("root_path", "")
    return root.rstrip("/")
