"""Problem documents (RFC 9457): every error of the service has one form and a stable type.

The catalogue below is the only place where a slug gets its HTTP status and its documentation; the
pages under ``/problems`` and the responses in the OpenAPI document are made from it.
"""

from __future__ import annotations

import inspect
import logging
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, cast

import redis.exceptions
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.routing import compile_path

from service.requests import REQUEST_ID, request_id
from service.security import protect
from smsr import errors
from worker import problems as worker_problems
from worker.connections import UNREACHABLE
from worker.problems import InternalError, StorageUnavailable
from worker.records import TooManyBytes, TooManyJobs
from worker.storage import ObjectMissing, StorageError, StorageFull

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import ModuleType

    from fastapi import FastAPI
    from starlette.requests import Request

MEDIA_TYPE = "application/problem+json"
SCHEMA = {"$ref": "#/components/schemas/ProblemDocument"}
"""Of a problem document, in the OpenAPI document."""
FULL_RETRY_SECONDS = 60
"""When a full disk may have room again: jobs expire, and operators come."""

RETRY_SECONDS = 5
"""What ``Retry-After`` says when Redis or the storage is away."""
JOBS_RETRY_SECONDS = 5
"""What it says while an owner has too many jobs, which end one by one."""
BYTES_RETRY_SECONDS = 600
"""What it says when an owner's storage is full, which someone has to see to."""

_REDIS_CANNOT = ("MISCONF", "NOREPLICAS", "MASTERDOWN", "CLUSTERDOWN")
"""Errors of a Redis server that cannot write, to a full disk for instance; those of a script have
them within the text before Redis 7."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ProblemType:
    """One kind of problem and its documentation.

    Attributes
    ----------
    slug : str
        Last part of the type URI ``/problems/<slug>``.
    title : str
        What is wrong in general; the same for every occurrence.
    status : int
        HTTP status of an answer of this type.
    meaning : str
        When this happens.
    remedy : str
        What a client or its user can do.
    """

    slug: str
    title: str
    status: int
    meaning: str
    remedy: str

    @property
    def uri(self) -> str:
        """The type URI, relative to the service."""
        return f"/problems/{self.slug}"


class Problem(Exception):
    """A refusal of the service itself, to be answered as a problem document.

    Parameters
    ----------
    slug : str
        A key of `CATALOGUE`.
    detail : str
        What is wrong in this request and what would be right.
    headers : mapping, optional
        More headers of the answer.
    **context : object
        Machine-readable facts, members of the document.
    """

    def __init__(
        self,
        slug: str,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        **context: object,
    ) -> None:
        super().__init__(detail)
        self.type = CATALOGUE[slug]
        self.detail = detail
        self.headers = dict(headers or {})
        self.context = context


_OF_THE_SERVICE = (
    ProblemType(
        "not-found",
        "There is nothing at this address",
        404,
        "No route of the service has this path.",
        "See /docs for the routes. Paths have no trailing slash.",
    ),
    ProblemType(
        "method-not-allowed",
        "This address does not take this method",
        405,
        "The path exists, but not with this HTTP method.",
        "The Allow header of the answer names the methods that the path takes.",
    ),
    ProblemType(
        "invalid-request",
        "A parameter of the request is not valid",
        422,
        "A query parameter or a part of the path has the wrong type or is out of its range, or a "
        "query parameter is not known or was given twice.",
        "The member `errors` says for each parameter where it stands and what is wrong; "
        "`parameters` lists those that are known where one is not.",
    ),
    ProblemType(
        "unauthorized",
        "An API key is needed",
        401,
        "The request gives no API key, or one that does not exist (any more).",
        "Send `Authorization: Bearer smsr_...` or `X-API-Key: smsr_...`. The operator makes keys "
        "with `smsr keys create`.",
    ),
    ProblemType(
        "too-many-requests",
        "Too many requests",
        429,
        "The API key was used more often within a minute than it may; `limit` says how often.",
        "Wait the seconds in Retry-After. The header RateLimit says how many requests are left; "
        "`Prefer: wait=30` saves most polls.",
    ),
    ProblemType(
        "too-many-jobs",
        "Too many jobs at a time",
        429,
        "The owner of the API key has as many queued and running jobs as it may.",
        "Submit again when some have ended; Retry-After says when to try.",
    ),
    ProblemType(
        "too-many-streams",
        "Too many streams of events at a time",
        429,
        "The API key has as many streams of events open as it may; `limit` says how many.",
        "Close some. One stream of `/v1/events` tells of all jobs.",
    ),
    ProblemType(
        "too-many-bytes",
        "The storage of this owner is full",
        507,
        "Inputs, results and uploads under way of the owner of the API key together would be more "
        "bytes than it may store.",
        "Delete jobs that are no longer needed, or ask the operator for more.",
    ),
    ProblemType(
        "unknown-job",
        "There is no such job",
        404,
        "No job has this id: it never existed, was deleted, or its time to live has passed.",
        "Check the id. Deleted and expired jobs cannot be brought back; submit again.",
    ),
    ProblemType(
        "unknown-batch",
        "There is no such batch",
        404,
        "No job has this label: none was submitted with it, or all have been deleted or expired.",
        "Check the label; GET /v1/batches lists all.",
    ),
    ProblemType(
        "unknown-frame",
        "There is no such frame",
        404,
        "The job has a result, but not a frame of this number.",
        "Frames count from 0; the member `frames` says how many there are.",
    ),
    ProblemType(
        "unknown-file",
        "The job has no such file",
        404,
        "There is no array or figure of this name, or no such file was sent with the job, or it is "
        "kept no longer.",
        "The member `files` lists such files; results have faces where faces were sent.",
    ),
    ProblemType(
        "precondition-failed",
        "The file is another than the client expects",
        412,
        "If-Match or If-Unmodified-Since names another version: the job was run again.",
        "Ask without the condition for the present version.",
    ),
    ProblemType(
        "range-not-satisfiable",
        "The range is outside of the file",
        416,
        "Range begins behind the last byte; the member `size` says how many there are.",
        "Ask for a range within the file. A download that has all bytes is complete.",
    ),
    ProblemType(
        "unknown-problem",
        "There is no such problem type",
        404,
        "No problem type of the service has this name.",
        "See /problems for all of them.",
    ),
    ProblemType(
        "unsupported-media-type",
        "The body is of a type that is not taken here",
        415,
        "Jobs are submitted as multipart/form-data (RFC 7578) with a boundary, or as JSON that "
        "names finished uploads; a piece of an upload is application/offset+octet-stream, a change "
        "of a job application/merge-patch+json. No body has a Content-Encoding.",
        "Send the measurement file as the part `measurements`, for instance with "
        "`curl -F measurements=@tracks.npy`.",
    ),
    ProblemType(
        "malformed-multipart",
        "The multipart body cannot be read",
        400,
        "The body ends early, or its boundaries or part headers break RFC 7578.",
        "Let an HTTP library build the body; check that nothing between client and service cuts "
        "requests off.",
    ),
    ProblemType(
        "missing-measurements",
        "The part with the measurements is missing",
        422,
        "A job needs a part named `measurements` with a file in it.",
        "Add the part `measurements`. `ground_truth`, `faces` and `options` are optional.",
    ),
    ProblemType(
        "unknown-part",
        "The body has a part that is not known",
        422,
        "Parts are `measurements`, `ground_truth`, `faces`, `options` and the settings of a job; "
        "nothing else is read, and a misspelt part is refused rather than ignored.",
        "Rename or leave out the part; the member `parts` lists those that are known.",
    ),
    ProblemType(
        "duplicate-part",
        "A part was sent twice",
        422,
        "Each part may stand in the body once.",
        "Send one file for each part.",
    ),
    ProblemType(
        "malformed-options",
        "The options are not a JSON object",
        422,
        "The part `options` must be one JSON object of option names and values, in UTF-8, of at "
        "most 64 KiB.",
        'Send for instance {"layout": "stacked"}. GET /v1/info lists all options.',
    ),
    ProblemType(
        "invalid-setting",
        "A setting of the job is not valid",
        422,
        "A part, or a member, that says how the job is to be treated has a value that is wrong or "
        "that the service does not allow. The member `setting` names it.",
        "Read `detail`; /docs describes every setting, and `settings` lists their names.",
    ),
    ProblemType(
        "invalid-idempotency-key",
        "The Idempotency-Key cannot be used",
        400,
        "The header Idempotency-Key names a submission; it holds 1 to 255 printable ASCII "
        "characters.",
        "Send a random key, a UUID for instance, with each new submission, and the same one again "
        "when the submission is repeated.",
    ),
    ProblemType(
        "idempotency-key-reused",
        "The Idempotency-Key belongs to another submission",
        422,
        "A submission with other files, options or settings was accepted under this key.",
        "Send a key of its own with each new submission.",
    ),
    ProblemType(
        "submission-in-progress",
        "The first submission under this Idempotency-Key is on its way",
        409,
        "Another request with the same key has not been answered yet; it may have broken off a "
        "moment ago.",
        "Send the submission again, under the same key, after the seconds in Retry-After.",
    ),
    ProblemType(
        "submission-gone",
        "The job of this Idempotency-Key is gone",
        410,
        "The submission was accepted before; its job, named by the member `job`, has been deleted "
        "or has expired since.",
        "Submit under a new key if the job is wanted again.",
    ),
    ProblemType(
        "upload-too-large",
        "The upload is larger than the limit",
        413,
        "The files of a job together may have `limit` bytes.",
        "Send float32 rather than float64, fewer frames or fewer points, or ask the operator to "
        "raise SMSR_MAX_UPLOAD_BYTES.",
    ),
    ProblemType(
        "upload-stalled",
        "The upload stopped",
        408,
        "No byte of the body arrived for a long time. Nothing of the upload was kept.",
        "Submit again over a better connection.",
    ),
    ProblemType(
        "unknown-upload",
        "There is no such upload",
        404,
        "No upload has this id: it never existed, was deleted, or expired before a job took it.",
        "Check the id; begin a new upload. `Upload-Expires` says how long one is kept.",
    ),
    ProblemType(
        "upload-used",
        "A job has taken this upload",
        409,
        "An upload becomes the input of one job and is no upload any more.",
        "Upload the file again for another job; POST /v1/jobs/{id}/retry runs a job again.",
    ),
    ProblemType(
        "upload-exists",
        "There is an upload of this id",
        409,
        "The id is that of an upload that goes on by PATCH.",
        "Choose another id, or delete the upload.",
    ),
    ProblemType(
        "upload-unfinished",
        "The upload is not finished",
        409,
        "A job was asked for before all bytes of its file had arrived.",
        "Send the rest from the member `offset` on; then ask for the job again.",
    ),
    ProblemType(
        "upload-offset-mismatch",
        "The upload stands at another offset",
        409,
        "A PATCH must go on where the upload stands, and `Upload-Offset` says something else.",
        "Ask for the offset by HEAD and go on from there.",
    ),
    ProblemType(
        "upload-superseded",
        "Another request goes on with this upload",
        409,
        "A later request began to write the same upload, and the later one holds.",
        "Send one request at a time; ask for the offset by HEAD.",
    ),
    ProblemType(
        "malformed-upload",
        "A header field of the upload cannot be read",
        400,
        "`Upload-Length`, `Upload-Offset` or `Upload-Metadata` is missing or malformed, or the id "
        "is no id.",
        "See https://tus.io/protocols/resumable-upload for the fields; ids have 32 hexadecimal "
        "digits.",
    ),
    ProblemType(
        "unsupported-tus-version",
        "This version of the tus protocol is not spoken",
        412,
        "The field `Tus-Resumable` is missing or names another version than 1.0.0.",
        "Send `Tus-Resumable: 1.0.0`.",
    ),
    ProblemType(
        "malformed-digest",
        "The digest cannot be read",
        400,
        "`Content-Digest`, `Repr-Digest` or `Upload-Checksum` is malformed, or has no algorithm "
        "that is verified here.",
        "Send sha-256 or sha-512 (RFC 9530), or a tus checksum with sha1, sha256 or sha512.",
    ),
    ProblemType(
        "digest-mismatch",
        "The body is not what its digest says",
        400,
        "The body was changed on its way, or the digest is that of something else. Nothing of the "
        "body was kept.",
        "Send it again.",
    ),
    ProblemType(
        "checksum-mismatch",
        "The body is not what its checksum says",
        460,
        "The bytes do not have the checksum of the field `Upload-Checksum` of the tus protocol. "
        "Nothing of the body was kept; the offset is what it was.",
        "Send the same bytes again.",
    ),
    ProblemType(
        "malformed-json",
        "The body is no JSON object",
        400,
        "A job of finished uploads is asked for with one JSON object of at most 128 KiB, in UTF-8.",
        'Send for instance {"measurements": {"upload": "ID"}, "options": {}}.',
    ),
    ProblemType(
        "storage-full",
        "There is no room for the files",
        507,
        "The disk of the service is full, or nearly so: it takes no uploads, that running jobs can "
        "finish. What was accepted is not lost; an upload by tus goes on "
        "from its offset when there is room again.",
        "Try again later; tell the operator if it lasts.",
    ),
    ProblemType(
        "job-unfinished",
        "The job has no result yet",
        409,
        "The job is queued or running.",
        "Ask again after the seconds in Retry-After, or wait for the job with "
        "`GET /v1/jobs/{id}` and the header `Prefer: wait=30`.",
    ),
    ProblemType(
        "inputs-gone",
        "The files of the job are gone",
        409,
        "The job failed because its input cannot be used, and its files were removed then.",
        "Read the job's `problem`, correct the input or the options, and submit again.",
    ),
    ProblemType(
        "job-failed",
        "The job failed",
        409,
        "The job ended without a result. The member `cause` is the problem that ended it.",
        "Read `cause`, correct the input or the options, and submit again.",
    ),
    ProblemType(
        "job-cancelled",
        "The job was cancelled",
        410,
        "The job was cancelled before it had a result, and will have none.",
        "Submit again if the result is wanted after all.",
    ),
    ProblemType(
        "job-finished",
        "The job has finished",
        409,
        "Only a queued or running job can be cancelled.",
        "DELETE /v1/jobs/{id} removes a finished job and its files.",
    ),
    ProblemType(
        "queue-unavailable",
        "The job queue cannot be reached",
        503,
        "The service runs, but its Redis server does not answer. Accepted jobs are not lost.",
        "Try again after the seconds in Retry-After.",
    ),
    ProblemType(
        "storage-unavailable",
        StorageUnavailable.title,
        503,
        "The service runs, but cannot read or write its files; the disk may be full. Nothing of a "
        "refused upload is kept.",
        "Try again after the seconds in Retry-After; tell the operator if it lasts.",
    ),
    ProblemType(
        "not-ready",
        "The service is not ready",
        503,
        "Redis or the storage is not usable; the member `checks` says which and why.",
        "Wait; tell the operator if it lasts.",
    ),
    ProblemType(
        "result-gone",
        "The files of this job are gone",
        410,
        "The job was deleted, or its time to live passed, while it was asked for.",
        "Submit again.",
    ),
    ProblemType(
        "internal",
        InternalError.title,
        500,
        "An error that nobody foresaw. Its trace is in the service's log, never in an answer.",
        "Try again; tell the operator the X-Request-ID of the answer if it lasts.",
    ),
)

_STATUS = {
    "unsupported-format": 415,
    "too-large": 413,
    "numerical-failure": 500,
    "cancelled": 410,
    "figures-unavailable": 501,
    "nothing-to-draw": 404,
    "worker-lost": 500,
    "out-of-memory": 500,
    "input-missing": 500,
}

_REMEDIES = {
    "invalid-input": "Read `detail`, which says what would be right.",
    "unsupported-format": "Send .npy, .npz, .mat or another format that GET /v1/info lists.",
    "unreadable-file": "Write the file again, without pickled objects, and check that the copy is "
    "complete.",
    "empty-file": "Check the path that was uploaded.",
    "array-not-found": "Store a numeric array, or name the right one with the option "
    "`measurements_key`, `ground_truth_key` or `faces_key`.",
    "ambiguous-array": "Name the array with the option `measurements_key`, `ground_truth_key` or "
    "`faces_key`; `detail` lists the candidates.",
    "too-large": "Send fewer points or frames, or ask the operator to raise SMSR_MAX_ARRAY_BYTES.",
    "not-numeric": "Store the array as float32, float64 or integers.",
    "wrong-shape": "Measurements are (2T, N), (T, 2, N) or (T, N, 2); ground truth is (T, N, 3) or "
    "(3T, N); faces are (F, 3).",
    "odd-row-count": "Give two rows, u and v, for every frame.",
    "ambiguous-layout": "Say the row order with the option `layout`.",
    "too-few-frames": "Give at least 3 frames; a usable surface needs dozens.",
    "too-few-points": "Give at least 4 points.",
    "not-finite": "Where NaN marks points that are not seen in a frame, set the option `missing` "
    "to `complete`; `detail` says where the first bad entry stands.",
    "too-few-observations": "Leave out the frame or the point that `detail` names.",
    "constant-measurements": "Check that the file holds tracks in pixels and was not cleared.",
    "ground-truth-mismatch": "Give the true 3D points of the same frames and points, in the same "
    "order.",
    "invalid-faces": "Give triangles as rows of three point numbers, counted from 0.",
    "unknown-option": "GET /v1/info lists all options.",
    "invalid-option": "GET /v1/info lists type, range and choices of every option.",
    "animation-too-large": "Ask for fewer frames by the parameter `every`; the problem's member "
    "`every` has a value that fits. The NPZ and the PLY files have no such limit.",
    "figures-unavailable": "Ask the operator to install the extra `smsr[plot]`.",
    "nothing-to-draw": "Ask for another figure; the error needs ground truth with the job.",
    "cancelled": "Submit again if the result is wanted after all.",
    "numerical-failure": "Tell the operator the id of the job.",
    "time-limit": "Raise the option `time_limit`, or send fewer points or frames.",
    "worker-lost": "Try a smaller input; tell the operator the id of the job.",
    "out-of-memory": "Send fewer frames or points, or ask the operator for more memory.",
    "input-missing": "Submit again; tell the operator, since something else removes files.",
}


def _of_exceptions(module: ModuleType) -> list[ProblemType]:
    """Turn the exceptions of a module of the lower floors into problem types."""
    found = []
    for error in vars(module).values():
        if not inspect.isclass(error) or not issubclass(error, errors.SmsrError):
            continue
        if error is not errors.SmsrError:
            meaning = inspect.cleandoc(error.__doc__ or "").partition("\n\n")[0]
            found.append(
                ProblemType(
                    error.slug,
                    error.title,
                    _STATUS.get(error.slug, 422),
                    meaning.replace("\n", " "),
                    _REMEDIES.get(error.slug, "Read `detail`, which says what would be right."),
                )
            )
    return found


_OF_JOBS = (*_of_exceptions(errors), *_of_exceptions(worker_problems))

CATALOGUE: dict[str, ProblemType] = {kind.slug: kind for kind in (*_OF_JOBS, *_OF_THE_SERVICE)}

_OF_VIEWS = {"animation-too-large", "figures-unavailable", "nothing-to-draw"}

JOB_PROBLEMS = frozenset(kind.slug for kind in _OF_JOBS) - _OF_VIEWS
"""Problems that may end a job."""


def example_responses(*slugs: str) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI response objects, by status, with an example of each of some problems."""
    responses: dict[int | str, dict[str, Any]] = {}
    for slug in slugs:
        kind = CATALOGUE[slug]
        fresh = {"schema": SCHEMA, "examples": {}}
        response = responses.setdefault(
            kind.status, {"description": "", "content": {MEDIA_TYPE: fresh}}
        )
        response["description"] += f"{', ' * bool(response['description'])}{slug}"
        response["content"][MEDIA_TYPE]["examples"][slug] = {
            "summary": kind.title,
            "value": {
                "type": kind.uri,
                "title": kind.title,
                "status": kind.status,
                "detail": kind.meaning,
                "instance": "/v1/jobs",
            },
        }
    return responses


class ProblemResponse(JSONResponse):
    """A problem document as the answer."""

    media_type = MEDIA_TYPE


def document(
    kind: ProblemType, detail: str, instance: str, context: Mapping[str, object]
) -> dict[str, Any]:
    """Build a problem document; the members of RFC 9457 win over those of the context."""
    return {
        "type": kind.uri,
        "title": kind.title,
        "status": kind.status,
        "detail": detail,
        "instance": instance,
    } | {k: v for k, v in context.items() if k not in _RESERVED}


_RESERVED = frozenset({"type", "title", "status", "detail", "instance"})


def respond(
    request: Request,
    kind: ProblemType,
    detail: str,
    context: Mapping[str, object] | None = None,
    headers: Mapping[str, str] | None = None,
) -> ProblemResponse:
    """Answer a request with a problem document."""
    body = document(kind, detail, request.url.path, context or {})
    answer = ProblemResponse(body, status_code=kind.status, headers=dict(headers or {}))
    # A 500 is answered outside of all middleware, so it gets these headers here.
    headers_of_answer = MutableHeaders(raw=answer.raw_headers)
    protect(headers_of_answer, request.url.path)
    if known_as := request_id(request.scope):
        headers_of_answer[REQUEST_ID] = known_as
    return answer


def answer(request: Request, problem: Problem) -> ProblemResponse:
    """Answer a request with a refusal."""
    return respond(request, problem.type, problem.detail, problem.context, problem.headers)


async def _on_problem(request: Request, error: Exception) -> ProblemResponse:
    return answer(request, cast("Problem", error))


async def _on_solver_error(request: Request, error: Exception) -> ProblemResponse:
    found = cast("errors.SmsrError", error)
    return respond(request, CATALOGUE[found.slug], found.detail, found.context)


async def _on_invalid_request(request: Request, error: Exception) -> ProblemResponse:
    found = [
        {"in": str(e["loc"][0]), "name": ".".join(map(str, e["loc"][1:])), "detail": e["msg"]}
        for e in cast("RequestValidationError", error).errors()
    ]
    detail = "; ".join(f"{e['in']} {e['name']}: {e['detail']}" for e in found)
    return respond(request, CATALOGUE["invalid-request"], detail, {"errors": found})


async def _on_http_error(request: Request, failure: Exception) -> ProblemResponse:
    error = cast("HTTPException", failure)
    if error.status_code == HTTPStatus.NOT_FOUND:
        detail = f"The service has no {request.url.path}."
        return respond(request, CATALOGUE["not-found"], detail)
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        allowed = ", ".join(_methods_of(request))
        detail = f"{request.url.path} takes {allowed}, not {request.method}."
        headers = {"Allow": allowed}
        return respond(request, CATALOGUE["method-not-allowed"], detail, headers=headers)
    # RFC 9457, section 4.2.1: "about:blank" says no more than the HTTP status does.
    status = HTTPStatus(error.status_code)
    body = {
        "type": "about:blank",
        "title": status.phrase,
        "status": status.value,
        "instance": request.url.path,
    }
    return ProblemResponse(body, status_code=status, headers=error.headers)


def _methods_of(request: Request) -> list[str]:
    """Return all methods of a path; the router knows those of the first route that fits only."""
    path = request.scope["path"].removeprefix(request.scope.get("root_path", ""))
    methods = {
        method.upper()
        for template, operations in request.app.openapi()["paths"].items()
        if compile_path(template)[0].match(path)
        for method in operations
    }
    return sorted(methods | ({"HEAD"} if "GET" in methods else set()))


def redis_away(request: Request, error: Exception) -> ProblemResponse:
    """Answer a request that cannot be served without Redis."""
    _log.warning("Redis does not answer: %s", error)
    return respond(
        request,
        CATALOGUE["queue-unavailable"],
        "The job queue does not answer at the moment. Please try again.",
        headers={"Retry-After": str(RETRY_SECONDS)},
    )


async def _on_redis_away(request: Request, error: Exception) -> ProblemResponse:
    return redis_away(request, error)


async def _on_redis_error(request: Request, error: Exception) -> ProblemResponse:
    """Answer for a Redis that says why it cannot serve, as for one that is away."""
    if any(reason in str(error) for reason in _REDIS_CANNOT):
        return redis_away(request, error)
    _log.error("Redis refused a command", exc_info=error)
    return await _on_anything_else(request, error)


async def _on_too_many_jobs(request: Request, _error: Exception) -> ProblemResponse:
    most = request.state.allowance.jobs
    return respond(
        request,
        CATALOGUE["too-many-jobs"],
        f"{most} jobs of this owner are queued or running, which is as many as may be.",
        {"limit": most},
        headers={"Retry-After": str(JOBS_RETRY_SECONDS)},
    )


async def _on_too_many_bytes(request: Request, _error: Exception) -> ProblemResponse:
    most = request.state.allowance.bytes
    return respond(
        request,
        CATALOGUE["too-many-bytes"],
        f"This would be more than the {most} bytes that may be stored. Jobs that are deleted or "
        "expire make room.",
        {"limit": most},
        headers={"Retry-After": str(BYTES_RETRY_SECONDS)},
    )


async def _on_storage_away(request: Request, error: Exception) -> ProblemResponse:
    _log.error("The storage failed", exc_info=error)
    return respond(
        request,
        CATALOGUE["storage-unavailable"],
        "The files of the service cannot be read or written at the moment. Please try again.",
        headers={"Retry-After": str(RETRY_SECONDS)},
    )


async def _on_storage_full(request: Request, error: Exception) -> ProblemResponse:
    _log.error("The storage is full", exc_info=error)
    return respond(
        request,
        CATALOGUE["storage-full"],
        "There is no room for more files at the moment.",
        headers={"Retry-After": str(FULL_RETRY_SECONDS)},
    )


async def _on_object_missing(request: Request, _error: Exception) -> ProblemResponse:
    return respond(
        request, CATALOGUE["result-gone"], "The job and its files were removed a moment ago."
    )


async def _on_anything_else(request: Request, _error: Exception) -> ProblemResponse:
    return respond(
        request,
        CATALOGUE["internal"],
        "The request met an unexpected error, which has been logged.",
    )


def install(app: FastAPI) -> None:
    """Make every error of an application a problem document."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(errors.SmsrError, _on_solver_error)
    app.add_exception_handler(RequestValidationError, _on_invalid_request)
    app.add_exception_handler(HTTPException, _on_http_error)
    for away in (
        *UNREACHABLE,
        redis.exceptions.ReadOnlyError,
        redis.exceptions.OutOfMemoryError,
    ):
        app.add_exception_handler(away, _on_redis_away)
    app.add_exception_handler(redis.exceptions.ResponseError, _on_redis_error)
    app.add_exception_handler(TooManyJobs, _on_too_many_jobs)
    app.add_exception_handler(TooManyBytes, _on_too_many_bytes)
    app.add_exception_handler(StorageError, _on_storage_away)
    app.add_exception_handler(StorageFull, _on_storage_full)
    app.add_exception_handler(ObjectMissing, _on_object_missing)
    app.add_exception_handler(Exception, _on_anything_else)
