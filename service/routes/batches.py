"""Batches: looking at, cancelling, running again, removing and downloading jobs of one label."""

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Path, Query, Request, Response
from starlette.responses import StreamingResponse

from service import paging
from service.batches import stream_batch
from service.context import Context, Shared, root_of
from service.problems import Problem, example_responses
from service.schemas import batch_document, batch_entry
from service.submissions import LABEL_PATTERN
from smsr_client.documents import BatchCancelled, BatchDocument, BatchList, BatchRetried
from worker import batches
from worker.batches import Batch

router = APIRouter(prefix="/v1/batches", tags=["batches"])

RESULTS = "/v1/batches/{label}/results.zip"
"""Route whose answers are results."""

BatchLabel = Annotated[
    str, Path(pattern=LABEL_PATTERN, description="Label of the batch.", examples=["walk-17"])
]

_PROBLEMS = example_responses("invalid-request", "unknown-batch", "queue-unavailable")


async def _batch(shared: Context, label: str) -> Batch:
    found = await to_thread.run_sync(batches.get, shared.queue.records, shared.owner, label)
    if found is None:
        raise _unknown(label)
    return found


def _unknown(label: str) -> Problem:
    return Problem("unknown-batch", f"There is no job of a batch {label!r}.")


@router.get(
    "",
    summary="List batches, latest first",
    responses=paging.RESPONSES,
)
async def list_batches(
    request: Request,
    response: Response,
    shared: Shared,
    limit: Annotated[int, Query(ge=1, le=paging.PAGE_SIZE, description="Batches on a page.")] = 50,
    cursor: paging.Cursor = None,
) -> BatchList:
    """Return one page of batches; those to which a job was added last come first."""
    try:
        found, next_cursor = await to_thread.run_sync(
            batches.labels, shared.queue.records, shared.owner, cursor, limit
        )
    except ValueError:
        raise paging.foreign_cursor(cursor) from None
    root = root_of(request)
    following = paging.link_next(response, f"{root}/v1/batches", next_cursor, limit=limit)
    return BatchList(batches=[batch_entry(counts, root=root) for counts in found], next=following)


@router.get("/{label}", summary="A batch: counts, progress, errors, times", responses=_PROBLEMS)
async def get_batch(request: Request, shared: Shared, label: BatchLabel) -> BatchDocument:
    """Return how far the jobs of a batch are, and how well those did that have ended."""
    return batch_document(await _batch(shared, label), root=root_of(request))


@router.post(
    "/{label}/cancel",
    status_code=202,
    summary="Cancel all jobs of a batch that have not ended",
    responses=_PROBLEMS,
)
async def cancel_batch(shared: Shared, label: BatchLabel) -> BatchCancelled:
    """End the queued jobs and ask the running ones to stop, which takes seconds."""
    await _batch(shared, label)
    cancelled, stopping = await to_thread.run_sync(
        batches.cancel, shared.queue, shared.owner, label
    )
    return BatchCancelled(cancelled=cancelled, stopping=stopping)


@router.post(
    "/{label}/retry",
    status_code=202,
    summary="Run the jobs of a batch again that failed or were cancelled",
    responses=_PROBLEMS,
)
async def retry_batch(shared: Shared, label: BatchLabel) -> BatchRetried:
    """Queue them once more, with the same files and options; jobs that succeeded stay as they are.

    Jobs that failed for their input keep no files and cannot be run again.
    """
    await _batch(shared, label)
    found = await to_thread.run_sync(
        batches.retry, shared.queue, shared.owner, label, shared.allowance
    )
    return BatchRetried.model_validate(found, from_attributes=True)


@router.delete(
    "/{label}", status_code=204, summary="Delete all jobs of a batch", responses=_PROBLEMS
)
async def delete_batch(shared: Shared, label: BatchLabel) -> None:
    """Remove the jobs, running ones too; their files are removed within the next minutes."""
    if not await to_thread.run_sync(batches.delete, shared.queue, shared.owner, label):
        raise _unknown(label)


@router.get(
    "/{label}/results.zip",
    summary="The results of a batch in one ZIP",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "batch.json, and result.npz and report.json in a folder for each job.",
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        },
        **_PROBLEMS,
        **example_responses("storage-unavailable"),
    },
)
async def get_batch_results(request: Request, shared: Shared, label: BatchLabel) -> Response:
    """Return the results of all jobs that have succeeded so far.

    The folders are named after the files that were sent, and the jobs' ids. The archive is made
    while it is sent, so its length is not known beforehand.
    """
    found = await _batch(shared, label)
    headers = {
        "Content-Disposition": f'attachment; filename="{label}.zip"',
        "Cache-Control": "private, no-store",
    }
    if request.method == "HEAD":
        return Response(media_type="application/zip", headers=headers)
    summary = batch_document(found, root=root_of(request)).model_dump_json(indent=1).encode()
    archive = stream_batch(shared, label, summary + b"\n")
    return StreamingResponse(archive, media_type="application/zip", headers=headers)
