"""Uploads on their own: by the tus protocol, version 1.0.0, or whole by PUT."""

from __future__ import annotations

import base64
import binascii
from email.utils import formatdate
from typing import TYPE_CHECKING, Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from multipart import parse_options_header
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect

from service import quotas
from service.context import Context, Shared, root_of
from service.digests import CHECKSUMS
from service.incoming import (
    check_head,
    find,
    hold,
    is_id,
    limits_of,
    receive_piece,
    receive_whole,
    remove,
    unknown_upload,
)
from service.problems import Problem, example_responses
from service.schemas import upload_document
from service.uploads import FILES, safe_name
from service.watermark import check_room, watched
from smsr_client.documents import UploadDocument, UploadList
from worker.records import new_job_id
from worker.uploads import Upload, new_folder

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

VERSION = "1.0.0"
EXTENSIONS = "creation,creation-with-upload,expiration,checksum,termination"
PIECE_TYPE = "application/offset+octet-stream"
METADATA_BYTES = 4096

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])


def _upload_id(
    upload_id: Annotated[
        str,
        Path(description="Id of the upload.", examples=["0f8fad5bd9cb469fa16570867728950e"]),
    ],
) -> str:
    """Refuse what is no id before it gets near a key of Redis or of the storage."""
    if not is_id(upload_id):
        raise Problem("unknown-upload", "There is no such upload; ids are 32 hexadecimal digits.")
    return upload_id


UploadId = Annotated[str, Depends(_upload_id)]

_CONTENT = {
    "requestBody": {
        "content": {PIECE_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}


def _field(name: str, description: str, *, required: bool = False) -> dict[str, Any]:
    return {
        "in": "header",
        "name": name,
        "required": required,
        "description": description,
        "schema": {"type": "string"},
    }


_VERSION = _field("Tus-Resumable", "The version of the protocol: 1.0.0.", required=True)
_DIGESTS = [
    _field("Content-Digest", "Of the body, sha-256 or sha-512 (RFC 9530); verified."),
    _field("Repr-Digest", "The same; verified."),
]
_CHECKSUM = _field("Upload-Checksum", "ALGORITHM BASE64 of the body, sha1, sha256 or sha512.")
_SHOWN = {
    name: {"schema": {"type": "string"}, "description": description}
    for name, description in {
        "Upload-Offset": "Bytes that are safe.",
        "Upload-Expires": "When the upload is removed unless more comes, or a job takes it.",
    }.items()
}
_LOCATION = {"Location": {"schema": {"type": "string"}, "description": "The upload."}}


@router.options("", status_code=204, summary="What of tus is spoken", responses=example_responses())
@router.options("/{upload_id}", status_code=204, include_in_schema=False)
async def describe_uploads(shared: Shared) -> Response:
    """Return versions, extensions, the largest upload and the checksums of the tus protocol."""
    return Response(
        status_code=204,
        headers={
            "Tus-Version": VERSION,
            "Tus-Extension": EXTENSIONS,
            "Tus-Max-Size": str(shared.settings.max_upload_bytes),
            "Tus-Checksum-Algorithm": ",".join(CHECKSUMS),
        },
    )


@router.post(
    "",
    status_code=201,
    summary="Begin an upload (tus)",
    openapi_extra=_CONTENT
    | {
        "parameters": [
            _VERSION,
            _field("Upload-Length", "Bytes in all.", required=True),
            _field(
                "Upload-Metadata",
                "Names and base64 values: filename, filetype, role (what the file is for).",
            ),
            _CHECKSUM,
            *_DIGESTS,
        ]
    },
    response_class=Response,
    responses={
        201: {"description": "The upload was begun.", "headers": _LOCATION | _SHOWN},
        **example_responses(
            "malformed-upload",
            "unsupported-tus-version",
            "upload-too-large",
            "unsupported-media-type",
            "unsupported-format",
            "malformed-digest",
            "digest-mismatch",
            "checksum-mismatch",
            "invalid-request",
            "empty-file",
            "upload-stalled",
            "queue-unavailable",
            "storage-unavailable",
            "storage-full",
            "too-many-bytes",
        ),
    },
)
async def create_upload(request: Request, shared: Shared) -> Response:
    """Begin an upload by the tus protocol; the body may already be a piece of the file.

    The bytes are sent by `PATCH` to the answer's `Location`. A file that cannot be used is refused
    as soon as its first bytes are there, and its upload removed.
    """
    _check_version(request)
    limits = limits_of(shared)
    length = _number(request, "upload-length")
    if length > limits.bytes:
        raise limits.too_large()
    given = request.headers.get("upload-metadata", "")
    metadata = _metadata(given)
    kind = metadata.get("filetype") or metadata.get("type")
    upload = Upload(
        id=new_job_id(),
        owner=shared.owner,
        folder=new_folder(),
        name=safe_name(metadata.get("filename") or metadata.get("name"), "upload"),
        content_type=_media_type(kind),
        role=_role(metadata.get("role")),
        metadata=given,
        length=length,
    )
    if length == 0:
        check_head(b"", 0, upload, limits)
    with_piece = "content-type" in request.headers and _has_body(request)
    if with_piece:
        _check_type(request)
    await check_room(shared, length)
    await hold(shared, upload)
    await to_thread.run_sync(shared.uploads.create, upload)
    if with_piece:
        try:
            upload = await _receive(request, shared, upload, 0)
        except Problem as problem:
            if problem.type.slug != "upload-stalled":  # the client never learns of the upload
                await remove(shared, upload.id)
            raise
    else:
        upload = await find(shared, upload.id)
    location = f"{root_of(request)}/v1/uploads/{upload.id}"
    return Response(status_code=201, headers={"Location": location, **_headers(upload)})


@router.get(
    "",
    summary="List uploads",
    responses=example_responses("queue-unavailable"),
)
async def list_uploads(request: Request, shared: Shared) -> UploadList:
    """Return the uploads that no job has taken, newest first, 1000 at most."""
    found = await to_thread.run_sync(shared.uploads.list, shared.owner)
    root = root_of(request)
    return UploadList(uploads=[upload_document(upload, root=root) for upload in found])


@router.get(
    "/{upload_id}",
    summary="An upload: how far it is",
    responses={
        200: {"headers": _SHOWN},
        **example_responses("unknown-upload", "queue-unavailable"),
    },
)
async def get_upload(
    request: Request, response: Response, shared: Shared, upload_id: UploadId
) -> UploadDocument:
    """Return how far an upload is; `HEAD` says it in the fields of tus alone."""
    upload = await find(shared, upload_id)
    response.headers.update(_headers(upload))
    response.headers["Upload-Length"] = str(upload.length)
    if upload.metadata:
        response.headers["Upload-Metadata"] = upload.metadata
    response.headers["Cache-Control"] = "no-store"
    return upload_document(upload, root=root_of(request))


@router.patch(
    "/{upload_id}",
    status_code=204,
    summary="Send a piece (tus)",
    openapi_extra=_CONTENT
    | {
        "parameters": [
            _VERSION,
            _field("Upload-Offset", "Where the body goes on.", required=True),
            _CHECKSUM,
            *_DIGESTS,
        ]
    },
    responses={
        204: {"headers": _SHOWN},
        **example_responses(
            "malformed-upload",
            "unsupported-tus-version",
            "unknown-upload",
            "upload-offset-mismatch",
            "upload-superseded",
            "upload-used",
            "upload-too-large",
            "unsupported-media-type",
            "unsupported-format",
            "malformed-digest",
            "digest-mismatch",
            "checksum-mismatch",
            "upload-stalled",
            "queue-unavailable",
            "storage-unavailable",
            "storage-full",
            "too-many-bytes",
        ),
    },
)
async def append_to_upload(request: Request, shared: Shared, upload_id: UploadId) -> Response:
    """Add bytes to an upload, where it stands.

    What arrived before a connection broke is kept, unless the request declared a digest of its
    body: then the body counts whole or not at all. Of two requests at once the later one holds.
    """
    _check_version(request)
    _check_type(request)
    offset = _number(request, "upload-offset")
    upload = await _receive(request, shared, await find(shared, upload_id), offset)
    return Response(status_code=204, headers=_headers(upload))


@router.post("/{upload_id}", include_in_schema=False)
async def override_method(request: Request, shared: Shared, upload_id: UploadId) -> Response:
    """Serve clients whose environment allows no PATCH (tus, X-HTTP-Method-Override)."""
    method = request.headers.get("x-http-method-override", "").upper()
    if method == "PATCH":
        return await append_to_upload(request, shared, upload_id)
    if method == "DELETE":
        await delete_upload(request, shared, upload_id)
        return Response(status_code=204)
    raise Problem(
        "method-not-allowed",
        f"{request.url.path} takes DELETE, GET, HEAD, OPTIONS, PATCH, PUT, not POST.",
        headers={"Allow": "DELETE, GET, HEAD, OPTIONS, PATCH, PUT"},
    )


@router.put(
    "/{upload_id}",
    status_code=201,
    summary="Upload a whole file",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        },
        "parameters": [
            _field("Content-Disposition", 'The file name, as in `attachment; filename="w.npy"`.'),
            *_DIGESTS,
        ],
    },
    responses={
        200: {"model": UploadDocument, "description": "The file took the place of an earlier one."},
        201: {"headers": _LOCATION},
        **example_responses(
            "malformed-upload",
            "upload-used",
            "upload-too-large",
            "unsupported-media-type",
            "unsupported-format",
            "malformed-digest",
            "digest-mismatch",
            "invalid-request",
            "empty-file",
            "upload-stalled",
            "queue-unavailable",
            "storage-unavailable",
            "storage-full",
            "too-many-bytes",
        ),
    },
)
async def put_upload(
    request: Request,
    response: Response,
    shared: Shared,
    upload_id: UploadId,
    name: Annotated[
        str | None, Query(max_length=300, description="File name, instead of the header field.")
    ] = None,
    role: Annotated[
        str | None,
        Query(pattern="^(measurements|ground_truth|faces)$", description="What the file is for."),
    ] = None,
) -> UploadDocument:
    """Store a file under an id that the client chose; sending it again is no error.

    The id has 32 hexadecimal digits, best random ones, and is the client's own: others may use the
    same. The file counts whole or not at all; over a network that breaks, tus is the better way.
    """
    if "content-range" in request.headers:  # RFC 9110, section 14.5
        raise Problem("malformed-upload", "PUT takes a whole file; pieces are sent by PATCH.")
    disposition = parse_options_header(request.headers.get("content-disposition", ""))[1]
    upload = Upload(
        id=upload_id,
        owner=shared.owner,
        folder=new_folder(),
        name=safe_name(name or disposition.get("filename"), "upload"),
        content_type=_media_type(request.headers.get("content-type")),
        role=role,
        length=0,
    )
    try:
        request = await watched(shared, request)
        async with quotas.room(shared, request, upload.folder) as body:
            created = await receive_whole(body, shared, upload)
    except ClientDisconnect:
        raise _gone() from None
    document = upload_document(await find(shared, upload_id), root=root_of(request))
    if created:
        response.headers["Location"] = document.links.self
    else:
        response.status_code = 200
    return document


@router.delete(
    "/{upload_id}",
    status_code=204,
    summary="Delete an upload",
    responses=example_responses("unknown-upload", "queue-unavailable"),
)
async def delete_upload(request: Request, shared: Shared, upload_id: UploadId) -> None:
    """Remove an upload with its bytes; the file of a job that took it stays."""
    if "tus-resumable" in request.headers:
        _check_version(request)
    if not await remove(shared, upload_id):
        raise unknown_upload(upload_id)


async def _receive(request: Request, shared: Context, upload: Upload, offset: int) -> Upload:
    try:
        request = await watched(shared, request, upload.length - offset)
        return await receive_piece(request, shared, upload, offset)
    except ClientDisconnect:
        raise _gone() from None


def _gone() -> Problem:
    return Problem("malformed-upload", "The client went away.")


def _headers(upload: Upload) -> dict[str, str]:
    return {
        "Upload-Offset": str(upload.offset),
        "Upload-Expires": formatdate(upload.expires_at, usegmt=True),
    }


def _check_version(request: Request) -> None:
    if request.headers.get("tus-resumable") != VERSION:
        raise Problem(
            "unsupported-tus-version",
            f"The request says Tus-Resumable: {request.headers.get('tus-resumable')}, not "
            f"{VERSION}.",
            headers={"Tus-Version": VERSION},
        )


def _check_type(request: Request) -> None:
    kind = request.headers.get("content-type", "")
    if kind.partition(";")[0].strip().lower() != PIECE_TYPE:
        raise Problem(
            "unsupported-media-type",
            f"A piece of an upload has the type {PIECE_TYPE}.",
            headers={"Accept": PIECE_TYPE},
        )


def _has_body(request: Request) -> bool:
    return (
        "transfer-encoding" in request.headers
        or request.headers.get("content-length", "0").strip() != "0"
    )


def _number(request: Request, field: str) -> int:
    text = request.headers.get(field, "")
    if not (text.isascii() and text.isdecimal() and len(text) <= 18):
        raise Problem("malformed-upload", f"{field.title()} is a number of bytes, not {text!r}.")
    return int(text)


def _metadata(text: str) -> Mapping[str, str]:
    """Parse names and base64 values."""
    if len(text) > METADATA_BYTES:
        raise Problem("malformed-upload", f"Upload-Metadata has more than {METADATA_BYTES} bytes.")
    found: dict[str, str] = {}
    for pair in text.split(",") if text.strip() else ():
        name, _, value = pair.strip().partition(" ")
        try:
            found[name] = base64.b64decode(value.strip(), validate=True).decode("utf-8", "replace")
        except binascii.Error:
            raise Problem(
                "malformed-upload", f"Upload-Metadata: the value of {name[:60]!r} is no base64."
            ) from None
        if not name:
            raise Problem("malformed-upload", "Upload-Metadata has a value without a name.")
    return found


def _role(text: str | None) -> str | None:
    if text and text not in FILES:
        raise Problem("malformed-upload", f"The role of a file is one of {', '.join(FILES)}.")
    return text or None


def _media_type(text: str | None) -> str | None:
    kind = parse_options_header(text or "")[0]
    parts = kind.split("/")
    sound = len(parts) == 2 and all(
        0 < len(p) <= 60 and all(c.isalnum() or c in "._+-" for c in p) for p in parts
    )
    return kind if sound and kind.isascii() else None


class TusHeaders:
    """Adds ``Tus-Resumable`` to every answer about uploads, as the protocol demands."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""

        async def send_marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Tus-Resumable"] = VERSION
            await send(message)

        path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
        about = scope["type"] == "http" and path.startswith(router.prefix)
        await self.app(scope, receive, send_marked if about else send)
