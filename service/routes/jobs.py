"""Submitting, watching, cancelling and deleting jobs."""

from contextlib import nullcontext
from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from starlette.requests import ClientDisconnect

from service import paging, quotas
from service.bodies import content_type, read_json
from service.context import Context, JobId, Shared, root_of, unknown_job
from service.downloads import diagnostics_of
from service.idempotency import REPLAYED, ClaimedKey, Digests, claimed
from service.incoming import limits_of, read_references, take_references
from service.problems import Problem, example_responses
from service.schemas import job_document
from service.submissions import (
    Label,
    accept,
    fingerprint_of,
    read_settings,
    settings_schema,
)
from service.uploads import FILES, receive_submission
from service.waiting import preferred_wait, wait_until_final
from service.watermark import watched
from smsr.options import describe
from smsr_client.documents import Job, JobList, JobStatus
from worker.options import JobOptions
from worker.queue import InputsGone
from worker.records import JobActive, JobRecord, new_job_id
from worker.storage import ObjectMissing

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


def _file(description: str) -> dict[str, Any]:
    return {"type": "string", "format": "binary", "description": description}


def _references() -> dict[str, Any]:
    """Return the JSON Schemas of references to uploads, by role."""
    return {
        role: {
            "type": "object",
            "description": f"A finished upload with the {role.replace('_', ' ')}.",
            "required": ["upload"],
            "additionalProperties": False,
            "properties": {"upload": {"type": "string", "pattern": "^[0-9a-f]{32}$"}},
        }
        for role in FILES
    }


def _options_schema() -> dict[str, Any]:
    """Return the JSON Schema of the options, made from their descriptions."""
    properties: dict[str, Any] = {}
    for option in describe(JobOptions):
        known = {
            "type": [option.type, "null"] if option.nullable else option.type,
            "default": option.default,
            "description": option.help,
            "minimum": option.minimum,
            "maximum": option.maximum,
            "enum": list(option.choices) if option.choices else None,
        }
        properties[option.name] = {
            k: v for k, v in known.items() if v is not None or k == "default"
        }
    return {"type": "object", "additionalProperties": False, "properties": properties}


_TRACKS = "0,1,4,2,7\n3,0,2,5,1\n0,2,4,1,6\n3,1,2,4,1\n1,3,4,0,5\n2,1,3,5,0\n"
"""The smallest file there can be, as an example: 5 points in 3 frames, as CSV."""

_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["measurements"],
                    "additionalProperties": False,
                    "properties": {
                        "options": _options_schema(),
                        "measurements": _file(
                            "2D tracks: a (2T, N) matrix of rows u1, v1, u2, v2, ..., or (T, 2, N) "
                            "or (T, N, 2); GET /v1/info lists the formats."
                        ),
                        "ground_truth": _file(
                            "True 3D points, (T, N, 3) or (3T, N): the result gets its e3D."
                        ),
                        "faces": _file("Triangles, (F, 3) point numbers from 0: results get them."),
                        **settings_schema(),
                    },
                },
                "encoding": {
                    "options": {"contentType": "application/json"},
                    **{str(role): {"contentType": "application/octet-stream"} for role in FILES},
                },
                "example": {"options": {"layout": "interleaved"}, "measurements": _TRACKS},
            },
            "application/json": {
                "schema": {
                    "type": "object",
                    "required": ["measurements"],
                    "additionalProperties": False,
                    "properties": {
                        "options": _options_schema(),
                        **_references(),
                        **settings_schema(),
                    },
                },
                "example": {
                    "measurements": {"upload": "0f8fad5bd9cb469fa16570867728950e"},
                    "options": {"layout": "interleaved"},
                },
            },
        },
    }
}


_CHANGES = ("application/json", "application/merge-patch+json")
"""Media types of a change of a job."""

_CHANGE: dict[str, Any] = {
    "schema": {
        "type": "object",
        "required": ["ttl"],
        "additionalProperties": False,
        "properties": {
            "ttl": {
                "type": ["number", "null"],
                "minimum": 0,
                "description": "Seconds from its end on, 0 for ever, where the service allows "
                "that; null for the service's own time.",
            }
        },
    },
    "example": {"ttl": 86400},
}


@router.post(
    "",
    status_code=201,
    summary="Submit a job",
    openapi_extra=_BODY,
    responses={
        201: {
            "headers": {
                "Location": {"schema": {"type": "string"}, "description": "The job."},
                REPLAYED: {
                    "schema": {"type": "string", "enum": ["true"]},
                    "description": "The job was made by an earlier submission of this key.",
                },
            }
        },
        **example_responses(
            "malformed-multipart",
            "malformed-json",
            "malformed-digest",
            "digest-mismatch",
            "unknown-upload",
            "upload-unfinished",
            "upload-used",
            "invalid-request",
            "upload-stalled",
            "upload-too-large",
            "too-large",
            "unsupported-media-type",
            "unsupported-format",
            "missing-measurements",
            "unknown-part",
            "duplicate-part",
            "malformed-options",
            "unknown-option",
            "invalid-option",
            "invalid-setting",
            "invalid-idempotency-key",
            "idempotency-key-reused",
            "submission-in-progress",
            "submission-gone",
            "odd-row-count",
            "too-few-frames",
            "too-few-points",
            "not-numeric",
            "empty-file",
            "unreadable-file",
            "too-many-requests",
            "too-many-jobs",
            "too-many-bytes",
            "queue-unavailable",
            "storage-unavailable",
            "storage-full",
        ),
    },
)
async def submit(
    request: Request,
    response: Response,
    shared: Shared,
    idempotency_key: Annotated[
        str | None,
        Header(
            description="Names this submission. Sent again under the same key it makes no second "
            "job; the answer is that of the first time, with the job as it is now.",
            examples=["8e03978e-40d5-43e8-bc93-6894a57f9324"],
        ),
    ] = None,
) -> Job:
    """Upload tracks and queue their reconstruction.

    The parts may come in any order. The beginning of each file is checked while it arrives, so
    most unusable files are refused at once; what only shows in the whole file (an entry that is not
    finite, a corrupt archive) makes the job fail with the same kind of problem document. Nothing of
    a refused or broken upload is kept; the files of a job are kept until it fails for its input,
    expires or is deleted.

    A JSON document makes a job of files that were uploaded before (`/v1/uploads`); the job takes
    them over. `Content-Digest` and `Repr-Digest` of a multipart body are verified (RFC 9530).
    """
    queue = shared.queue
    await to_thread.run_sync(queue.redis.ping)  # before a long upload, not after it
    job_id = new_job_id()
    async with claimed(shared, idempotency_key, job_id) as key:
        repeated = key is not None and key.bound
        if not repeated:
            await quotas.check_jobs(shared)
            request = await watched(shared, request)
        try:
            async with (
                nullcontext(request) if repeated else quotas.room(shared, request, job_id)
            ) as body:
                record = await _receive(body, shared, job_id, key)
        except ClientDisconnect:
            raise Problem("malformed-multipart", "The client went away.") from None
    if repeated:
        response.headers[REPLAYED] = "true"
    document = job_document(record, root=root_of(request))
    response.headers["Location"] = document.links.self
    return document


async def _receive(
    request: Request, shared: Context, job_id: str, key: ClaimedKey | None
) -> JobRecord:
    """Make a job of the body; of a repeated one nothing is stored."""
    if content_type(request.headers) == "application/json":
        references = await read_references(request, shared)
        fingerprint = references.fingerprint
        if key is not None and key.bound:
            return await key.replay(shared, fingerprint)
        submission = await take_references(shared, references, job_id)
    else:
        repeated = key is not None and key.bound
        submission = await receive_submission(
            request,
            job_id,
            Digests() if repeated else shared.storage,
            limits_of(shared),
            shared.settings,
            checked=not repeated,  # an unusable file is not that of the first submission either
        )
        fingerprint = fingerprint_of(submission)
        if key is not None and key.bound:
            return await key.replay(shared, fingerprint)
    binding = key.bind(fingerprint) if key is not None else None
    return await accept(shared, job_id, submission, key=binding)


@router.get(
    "",
    summary="List jobs, newest first",
    responses=paging.RESPONSES,
)
async def list_jobs(
    request: Request,
    response: Response,
    shared: Shared,
    status: Annotated[JobStatus | None, Query(description="Only jobs of this status.")] = None,
    batch: Annotated[Label | None, Query(description="Only jobs of this batch.")] = None,
    limit: Annotated[int, Query(ge=1, le=paging.PAGE_SIZE, description="Jobs on a page.")] = 50,
    cursor: paging.Cursor = None,
) -> JobList:
    """Return one page of jobs. Jobs that come or go in between do not shift the pages."""
    try:
        page = await to_thread.run_sync(
            partial(
                shared.queue.records.list, status, cursor, limit, owner=shared.owner, batch=batch
            )
        )
    except ValueError:
        raise paging.foreign_cursor(cursor) from None
    root = root_of(request)
    following = paging.link_next(
        response, f"{root}/v1/jobs", page.next_cursor, status=status, batch=batch, limit=limit
    )
    jobs = [job_document(record, root=root, brief=True) for record in page.records]
    return JobList(jobs=jobs, next=following)


@router.get(
    "/{job_id}",
    summary="A job: status, progress, errors, links",
    responses={
        200: {
            "headers": {
                "Preference-Applied": {
                    "schema": {"type": "string"},
                    "description": "The wait that was applied, at most 60 seconds (RFC 7240).",
                }
            }
        },
        **example_responses("unknown-job", "queue-unavailable"),
    },
)
async def get_job(
    request: Request,
    response: Response,
    shared: Shared,
    job_id: JobId,
    prefer: Annotated[  # noqa: ARG001  (documented here, but there may be several of it)
        str | None,
        Header(
            description="`wait=N` answers when the job has ended, or after N seconds (RFC 7240).",
            examples=["wait=30"],
        ),
    ] = None,
) -> Job:
    """Return a job, at once or when it has ended."""
    record: JobRecord | None = await shared.record(job_id)
    seconds = preferred_wait(request.headers.getlist("prefer"))
    if seconds is not None and record is not None:
        record = await wait_until_final(shared.feed, record, seconds)
        response.headers["Preference-Applied"] = f"wait={seconds}"
    if record is None:
        raise unknown_job(job_id)
    response.headers["Vary"] = "Prefer"
    response.headers["Cache-Control"] = "no-store"
    return await _whole_document(request, shared, record)


async def _whole_document(request: Request, shared: Context, record: JobRecord) -> Job:
    """Return the document of a job with what has to be looked up."""
    position = None
    diagnostics = None
    if record.status == "queued":
        position = await to_thread.run_sync(shared.queue.position, record.id)
    if record.result_prefix is not None:
        try:
            key = f"{record.result_prefix}report.json"
            report = await to_thread.run_sync(shared.storage.get, key)
        except ObjectMissing:  # deleted a moment ago; the record says the rest
            pass
        else:
            diagnostics = diagnostics_of(report)
    return job_document(record, root=root_of(request), position=position, diagnostics=diagnostics)


@router.patch(
    "/{job_id}",
    summary="Keep a job longer or shorter",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": dict.fromkeys(_CHANGES, _CHANGE),
        }
    },
    responses=example_responses(
        "malformed-json",
        "unknown-job",
        "unsupported-media-type",
        "unknown-part",
        "invalid-setting",
        "invalid-request",
        "queue-unavailable",
    ),
)
async def change_job(request: Request, shared: Shared, job_id: JobId) -> Job:
    """Set how long a job is kept after its end, before or after that; nothing else can be changed.

    The body is a JSON document with the member `ttl` (RFC 7396). A job that ended longer ago than
    that is removed within moments.
    """
    await shared.record(job_id)
    kind = content_type(request.headers)
    if kind not in _CHANGES:
        raise Problem(
            "unsupported-media-type",
            f"A change is sent as {_CHANGES[1]} or {_CHANGES[0]}, not as "
            f"{kind or 'a body of unknown type'}.",
            headers={"Accept-Patch": ", ".join(_CHANGES)},  # RFC 5789, section 2.2
        )
    document = await read_json(request)
    if list(document) != ["ttl"]:
        raise Problem("unknown-part", "The document has one member, `ttl`.", parts=["ttl"])
    ttl = read_settings(document, shared.settings).ttl
    kept = await to_thread.run_sync(shared.queue.records.keep, job_id, ttl)
    record = await shared.feed.get(job_id) if kept else None
    if record is None:
        raise unknown_job(job_id)
    return job_document(record, root=root_of(request))


@router.delete(
    "/{job_id}",
    status_code=204,
    summary="Delete a job and all its files",
    responses=example_responses("unknown-job", "queue-unavailable"),
)
async def delete_job(shared: Shared, job_id: JobId) -> None:
    """Remove a job, its inputs and its results; a running one is stopped."""
    await shared.record(job_id)
    if not await to_thread.run_sync(shared.queue.delete, job_id):
        raise unknown_job(job_id)


@router.post(
    "/{job_id}/cancel",
    summary="Cancel a job",
    responses={
        200: {"description": "The job was queued and is cancelled."},
        202: {
            "model": Job,
            "description": "The job runs and has been asked to stop, which takes seconds.",
        },
        **example_responses("unknown-job", "job-finished", "queue-unavailable"),
    },
)
async def cancel_job(request: Request, response: Response, shared: Shared, job_id: JobId) -> Job:
    """Stop a job that is queued or running; asking twice is no error."""
    before = await shared.record(job_id)
    record = await to_thread.run_sync(shared.queue.cancel, job_id)
    if record is None:
        raise unknown_job(job_id)
    if record.status in ("succeeded", "failed") or before.status == "cancelled":
        raise Problem(
            "job-finished",
            f"The job has {record.status}; there is nothing to cancel."
            if record.status != "cancelled"
            else "The job has been cancelled already.",
            job_status=record.status,
        )
    if not record.final:
        response.status_code = 202
    return job_document(record, root=root_of(request))


@router.post(
    "/{job_id}/retry",
    status_code=202,
    summary="Run a finished job again",
    responses=example_responses(
        "unknown-job",
        "job-unfinished",
        "inputs-gone",
        "too-many-requests",
        "too-many-jobs",
        "queue-unavailable",
    ),
)
async def retry_job(request: Request, shared: Shared, job_id: JobId) -> Job:
    """Queue a job that has ended once more, with the same files and options; its result goes."""
    await shared.record(job_id)
    try:
        record = await to_thread.run_sync(shared.queue.retry, job_id, shared.allowance)
    except JobActive:
        raise Problem("job-unfinished", "The job is still queued or running.") from None
    except InputsGone:
        raise Problem(
            "inputs-gone", "The job failed for its input and keeps no files; submit it again."
        ) from None
    if record is None:
        raise unknown_job(job_id)
    return job_document(record, root=root_of(request))
