"""Downloading results."""

from collections.abc import Sequence
from http import HTTPStatus
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Path, Query, Request
from starlette.responses import RedirectResponse, Response, StreamingResponse

from service.conditional import Validators
from service.content import stored_content
from service.context import Context, JobId, Shared
from service.downloads import (
    ARRAYS,
    Download,
    ResultFiles,
    result_validators,
    safe_media_type,
)
from service.problems import Problem, example_responses
from smsr import figures
from smsr.files.glb import GlbOptions, ImageV
from worker.records import JobRecord
from worker.storage import ObjectMissing

RETRY_SECONDS = 2
"""What ``Retry-After`` says while a job is queued or runs."""

_SHOWN = 60

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["results"])

_CONDITIONAL = {
    304: {"description": "The client has this version already."},
    **example_responses("precondition-failed", "range-not-satisfiable"),
}
_PROBLEMS = _CONDITIONAL | example_responses(
    "unknown-job",
    "job-unfinished",
    "job-failed",
    "job-cancelled",
    "result-gone",
    "queue-unavailable",
    "storage-unavailable",
)

ImageVertical = Annotated[
    ImageV,
    Query(
        description="Where the second image coordinate grows to: `down` for pixels; `auto` is "
        "`down` where the first frame has no negative coordinates."
    ),
]


_BYTES = {"schema": {"type": "string", "format": "binary"}}


def _download(content: dict[str, Any], description: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of a file, by its media types, and of a part of it."""
    return {
        200: {"description": description, "content": content},
        206: {
            "description": "The part that Range asks for (RFC 9110, section 14).",
            "content": dict.fromkeys(content, _BYTES),
        },
    }


def _binary(media_type: str, description: str) -> dict[int | str, dict[str, Any]]:
    return _download({media_type: _BYTES}, description)


async def _finished(shared: Context, job_id: str) -> JobRecord:
    """Return the record of a job that has a result."""
    record = await shared.record(job_id)
    match record.status:
        case "queued" | "running":
            raise Problem(
                "job-unfinished",
                f"The job is {record.status}.",
                headers={"Retry-After": str(RETRY_SECONDS)},
                job_status=record.status,
            )
        case "failed":
            cause = dict(record.problem or {})
            raise Problem(
                "job-failed", f"The job failed: {cause.get('detail', '')}".strip(), cause=cause
            )
        case "cancelled":
            raise Problem("job-cancelled", "The job was cancelled before it had a result.")
    return record


async def _open(shared: Context, job_id: str) -> ResultFiles:
    record = await _finished(shared, job_id)
    return await shared.results.open(record)


@router.get(
    "/result.npz",
    summary="Shapes, cameras and translations as one NPZ",
    response_class=StreamingResponse,
    responses=_binary("application/zip", "Read it with numpy.load.") | _PROBLEMS,
)
async def get_npz(shared: Shared, job_id: JobId) -> Download:
    """Return arrays `shapes` (T, N, 3), `cameras` (T, 2, 3), `translations` (T, 2), and `faces`.

    W_t = R_t S_t + t_t. The archive is not compressed; its length is known in advance.
    """
    files = await _open(shared, job_id)
    return files.archive(files.npz_members(), f"smsr-{job_id}.npz")


@router.get(
    "/frames.zip",
    summary="All frames as PLY in one ZIP",
    response_class=StreamingResponse,
    responses=_binary("application/zip", "frame_0000.ply and so on.") | _PROBLEMS,
)
async def get_frames(shared: Shared, job_id: JobId) -> Download:
    """Return every frame as a binary PLY, with the faces where faces were sent."""
    files = await _open(shared, job_id)
    return files.archive(await files.ply_members(), f"smsr-{job_id}-frames.zip")


@router.get(
    "/frames/{frame}.ply",
    summary="One frame as PLY",
    response_class=StreamingResponse,
    responses={
        **_binary("application/octet-stream", "Binary little-endian PLY."),
        **_PROBLEMS,
        **example_responses("unknown-job", "unknown-frame", "invalid-request"),
    },
)
async def get_frame(
    shared: Shared, job_id: JobId, frame: Annotated[int, Path(description="From 0.")]
) -> Download:
    """Return the surface of one frame."""
    files = await _open(shared, job_id)
    if not 0 <= frame < files.frames:
        raise Problem(
            "unknown-frame",
            f"There is no frame {frame}; the job has frames 0 to {files.frames - 1}.",
            frames=files.frames,
        )
    return files.frame(frame, f"smsr-{job_id}-frame-{frame:04d}.ply")


@router.get(
    "/result.glb",
    summary="The sequence as one animated GLB",
    response_class=StreamingResponse,
    responses={
        **_binary("model/gltf-binary", "glTF 2.0 with morph targets, for viewers and Blender."),
        **_PROBLEMS,
        **example_responses("invalid-request", "animation-too-large"),
    },
)
async def get_glb(
    shared: Shared,
    job_id: JobId,
    quantised: Annotated[
        bool,
        Query(description="Integers of 16 and 8 bits (KHR_mesh_quantization): a smaller file."),
    ] = False,
    fps: Annotated[
        float, Query(gt=0, le=1000, description="Frames of the sequence per second.")
    ] = GlbOptions().fps,
    every: Annotated[int, Query(ge=1, le=1_000_000, description="Take every n-th frame.")] = 1,
    image_v: ImageVertical = "auto",
) -> Download:
    """Return the surface, as a mesh where faces were sent and as points otherwise, and its motion.

    It stands upright and as the first camera saw it, y up, and has about the size 2; the node's
    scale leads back to the unit of the measurements.
    """
    files = await _open(shared, job_id)
    options = GlbOptions(fps, quantised, every, image_v)
    return files.animation(options, f"smsr-{job_id}.glb")


@router.get(
    "/report.json",
    summary="The whole report of a run",
    responses={
        **_download({"application/json": {"schema": {"type": "object"}}}, "The report."),
        **_PROBLEMS,
    },
    response_class=StreamingResponse,
)
async def get_report(shared: Shared, job_id: JobId) -> Download:
    """Return all diagnostics: stages, residuals, singular values, cautions."""
    record = await _finished(shared, job_id)
    key = f"{record.result_prefix}report.json"
    size = await to_thread.run_sync(shared.storage.size, key)
    return Download(
        stored_content(shared.storage, key, size),
        name=f"smsr-{job_id}-report.json",
        validators=result_validators(record),
        media_type="application/json",
        inline=True,
    )


def _name(names: Sequence[str], description: str) -> Any:
    """Return the parameter of a file's name, one of some; of others it is said that none exists."""
    return Path(description=description, json_schema_extra={"enum": list(names)})


def _no_file(name: str, there: Sequence[str]) -> Problem:
    return Problem(
        "unknown-file",
        f"The job has no {name[:_SHOWN]!r}. Such files are {', '.join(there)}.",
        files=list(there),
    )


@router.get(
    "/{array}.npy",
    summary="One array of a result",
    response_class=StreamingResponse,
    responses={
        **_binary("application/octet-stream", "Read it with numpy.load."),
        307: {"description": "To a signed address of the store, where the operator wants that."},
        **_PROBLEMS,
        **example_responses("unknown-job", "unknown-file", "invalid-request"),
    },
)
async def get_array(
    request: Request,
    shared: Shared,
    job_id: JobId,
    array: Annotated[str, _name([file.removesuffix(".npy") for file in ARRAYS], "Its name.")],
) -> Response:
    """Return an array as an NPY file, or the range of its bytes that is asked for.

    `shapes` is float32 (T, N, 3), `cameras` float64 (T, 2, 3), `translations` float64 (T, 2) and
    `faces`, where some were sent, (F, 3). A reader that knows the header can fetch single frames.
    """
    files = await _open(shared, job_id)
    file, there = f"{array}.npy", files.arrays()
    found = there.get(file)
    if found is None:
        raise _no_file(file, list(there))
    seconds = shared.settings.presigned_links_seconds
    # A signature is for one method, and HEAD moves no bytes.
    if seconds is not None and request.method == "GET":
        address = await to_thread.run_sync(shared.storage.sign, found.key, seconds)
        if address is not None:
            headers = {"Cache-Control": "no-store"}
            return RedirectResponse(address, HTTPStatus.TEMPORARY_REDIRECT, headers)
    return files.array(file, f"smsr-{job_id}-{file}")


@router.get(
    "/inputs/{role}",
    summary="A file as it was sent",
    response_class=StreamingResponse,
    responses={
        **_binary("application/octet-stream", "The bytes that were uploaded."),
        **_CONDITIONAL,
        **example_responses(
            "unknown-job", "unknown-file", "queue-unavailable", "storage-unavailable"
        ),
    },
)
async def get_input(
    shared: Shared,
    job_id: JobId,
    role: Annotated[str, Path(description="Name of the part: `measurements`, `faces`, ...")],
) -> Download:
    """Return an input file, under the name and of the type that it was sent with.

    A job that failed for its input keeps none.
    """
    record = await shared.record(job_id)
    file = record.inputs.get(role)
    if file is None:
        raise _no_file(f"inputs/{role}", [f"inputs/{sent}" for sent in record.inputs])
    try:
        size = await to_thread.run_sync(shared.storage.size, file.key)
    except ObjectMissing:
        raise Problem("unknown-file", "The job keeps its files no longer.") from None
    return Download(
        stored_content(shared.storage, file.key, size),
        name=file.name,
        validators=Validators(file.sha256, record.created_at, dated=True),
        media_type=safe_media_type(file.content_type),
        sha256=file.sha256,
    )


@router.get(
    "/figures/{name}.{form}",
    summary="A figure of the run",
    response_class=StreamingResponse,
    responses={
        **_download(
            {"image/png": _BYTES, "image/svg+xml": {"schema": {"type": "string"}}}, "The picture."
        ),
        **_PROBLEMS,
        **example_responses(
            "unknown-job",
            "unknown-file",
            "nothing-to-draw",
            "invalid-request",
            "figures-unavailable",
        ),
    },
)
async def get_figure(
    shared: Shared,
    job_id: JobId,
    name: Annotated[str, _name(figures.NAMES, "What it shows.")],
    form: Annotated[str, _name(figures.FORMATS, "Its format.")],
    image_v: ImageVertical = "auto",
) -> Download:
    """Return a picture of the residuals, the singular values, the error, the shapes or the cameras.

    `error` is there where ground truth was sent. Pictures read in black and white.
    """
    files = await _open(shared, job_id)
    if name not in figures.NAMES or form not in figures.FORMATS:
        there = [f"figures/{name}.{form}" for name in figures.NAMES for form in figures.FORMATS]
        raise _no_file(f"figures/{name}.{form}", there)
    return files.figure(
        name, form, image_v, name=f"smsr-{job_id}-{name}.{form}", drawers=shared.results.drawers
    )
