"""The JSON documents of the service, as both sides read and write them."""

from __future__ import annotations

from datetime import datetime  # noqa: TC003 - pydantic reads the annotations at run time
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

JobStatus = Literal["queued", "running", "succeeded", "failed", "cancelled"]

FINAL: Final = frozenset({"succeeded", "failed", "cancelled"})
"""Statuses of a job that has ended."""

_ID = "0f8fad5bd9cb469fa16570867728950e"
_SELF = f"/v1/jobs/{_ID}"


class ProblemDocument(BaseModel):
    """A problem document (RFC 9457); more members may stand in it."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "examples": [
                {
                    "type": "/problems/odd-row-count",
                    "title": "The measurement matrix has an odd number of rows",
                    "status": 422,
                    "detail": "The matrix has 7 rows; it needs two, u and v, for every frame.",
                    "instance": "/v1/jobs",
                }
            ]
        },
    )

    type: str = Field(description="Stable type; GET it for its documentation.")
    title: str = Field(description="What is wrong in general.")
    status: int = Field(description="HTTP status.")
    detail: str | None = Field(None, description="What is wrong here and what would be right.")
    instance: str | None = Field(None, description="Path of the request or of the job.")


class InputFile(BaseModel):
    """An uploaded file."""

    name: str = Field(description="File name as it was sent, without folders.")
    bytes: int
    content_type: str | None
    sha256: str = Field(description="Hexadecimal digest of the bytes that were stored.")
    link: str = Field(description="Path of the file; a job that failed for its input keeps none.")


class UploadLinks(BaseModel):
    """Where to go from an upload; paths relative to the service."""

    self: str
    job: str | None = Field(description="The job that took it.")


class UploadDocument(BaseModel):
    """An upload on its own."""

    id: str = Field(examples=[_ID])
    name: str = Field(description="File name as it was sent, without folders.")
    content_type: str | None
    role: str | None = Field(description="measurements, ground_truth or faces, where it was said.")
    bytes: int = Field(description="In all.")
    offset: int = Field(description="Bytes that are safe: an upload goes on from here.")
    complete: bool = Field(description="Whether a job can be made of it.")
    sha256: str | None = Field(description="Hexadecimal digest, once it is complete.")
    created_at: datetime
    expires_at: datetime = Field(description="When it is removed if no job takes it.")
    links: UploadLinks


class UploadList(BaseModel):
    """Uploads that no job has taken, newest first."""

    uploads: list[UploadDocument]


class JobProgress(BaseModel):
    """Last report of a run."""

    stage: str
    fraction: float = Field(description="Part of the run that is done, 0 to 1.")
    iteration: int = Field(description="Iteration within the stage; 0 where it has none.")
    residual: float | None = Field(description="Stopping residual of the stage, where it has one.")


class JobCaution(BaseModel):
    """A weakness of the input that the solver noticed."""

    code: str
    message: str


class DiagnosticsSummary(BaseModel):
    """How the result came about; report.json has the whole."""

    converged: bool = Field(description="Whether every iterative stage met its tolerance.")
    basis_size: int = Field(description="K, the number of basis shapes that was found.")
    camera_model: str
    camera_reason: str
    cautions: list[JobCaution]


class JobLinks(BaseModel):
    """Where to go from a job; paths relative to the service, null where nothing is there (yet)."""

    self: str
    cancel: str | None
    retry: str | None = Field(description="To run a job again that has ended.")
    result: str | None = Field(description="result.npz")
    frames: str | None = Field(description="ZIP of all frames as PLY")
    frame: str | None = Field(description="URI template (RFC 6570) of one frame as PLY, t from 0")
    shapes: str | None = Field(description="shapes.npy, float32 (T, N, 3)")
    cameras: str | None = Field(description="cameras.npy, float64 (T, 2, 3)")
    translations: str | None = Field(description="translations.npy, float64 (T, 2)")
    faces: str | None = Field(description="faces.npy, (F, 3), where faces were sent")
    glb: str | None = Field(description="result.glb, the animated surface (glTF 2.0)")
    figure: str | None = Field(
        description="URI template (RFC 6570) of a figure: `name` is `convergence`, "
        "`singular-values`, `error`, `shapes` or `cameras`, `form` is `png` or `svg`"
    )
    report: str | None = Field(description="report.json")


class JobWebhook(BaseModel):
    """How the webhook of a job stands."""

    host: str = Field(description="Host that is told; the rest of the address is not shown.")
    state: Literal["waiting", "pending", "delivered", "given_up"] = Field(
        description="`waiting` for the job to end and a first attempt, `pending` for another one."
    )
    attempts: int = Field(description="Attempts for the last end of the job.")
    delivered_at: datetime | None = None
    next_attempt_at: datetime | None = None
    status: int | None = Field(None, description="HTTP status of the last answer.")
    error: str | None = Field(None, description="What went wrong in the last attempt.")


class Job(BaseModel):
    """A job and all that is known of it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": _ID,
                    "status": "succeeded",
                    "name": "tracks.npy",
                    "batch": "walk-17",
                    "priority": "normal",
                    "ttl": None,
                    "reused_from": None,
                    "created_at": "2026-03-01T12:00:00.120000Z",
                    "started_at": "2026-03-01T12:00:00.180000Z",
                    "finished_at": "2026-03-01T12:00:03.910000Z",
                    "expires_at": "2026-03-08T12:00:03.910000Z",
                    "attempt": 1,
                    "queue_position": None,
                    "cancel_requested": False,
                    "options": {"preset": "default", "layout": "auto"},
                    "inputs": {
                        "measurements": {
                            "name": "tracks.npy",
                            "bytes": 2304128,
                            "content_type": "application/octet-stream",
                            "sha256": "9f86d081884c7d659a2feaa0c55ad015"
                            "a3bf4f1b2b0b822cd15d6c15b0f00a08",
                            "link": f"{_SELF}/inputs/measurements",
                        }
                    },
                    "frames": 60,
                    "points": 2400,
                    "progress": {
                        "stage": "shapes",
                        "fraction": 1.0,
                        "iteration": 42,
                        "residual": 8.1e-7,
                    },
                    "timings": {"queued": 0.06, "total": 3.73},
                    "metrics": {"e3d": 0.0312},
                    "diagnostics": {
                        "converged": True,
                        "basis_size": 5,
                        "camera_model": "orthographic",
                        "camera_reason": "smallest residual",
                        "cautions": [],
                    },
                    "problem": None,
                    "webhook": None,
                    "links": {
                        "self": _SELF,
                        "cancel": None,
                        "retry": f"{_SELF}/retry",
                        "result": f"{_SELF}/result.npz",
                        "frames": f"{_SELF}/frames.zip",
                        "frame": f"{_SELF}/frames/{{t}}.ply",
                        "shapes": f"{_SELF}/shapes.npy",
                        "cameras": f"{_SELF}/cameras.npy",
                        "translations": f"{_SELF}/translations.npy",
                        "faces": None,
                        "glb": f"{_SELF}/result.glb",
                        "figure": f"{_SELF}/figures/{{name}}.{{form}}",
                        "report": f"{_SELF}/report.json",
                    },
                }
            ]
        }
    )

    id: str
    status: JobStatus
    name: str | None = Field(description="Name of the measurement file.")
    batch: str | None = Field(description="Label of the batch that the job belongs to.")
    priority: Literal["high", "normal", "low"]
    ttl: float | None = Field(
        description="Seconds that the job asked to be kept after its end, 0 for ever; null where "
        "it left that to the service."
    )
    reused_from: str | None = Field(
        description="Id of the equal job that made the result, where this one was not run; that "
        "job may be gone."
    )
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    expires_at: datetime | None = Field(
        description="When a finished job and its files go; null while it has not ended, and where "
        "it is kept for ever."
    )
    attempt: int = Field(description="How often a worker has started it.")
    queue_position: int | None = Field(
        description="Number of jobs before a queued one, in the document of one job."
    )
    cancel_requested: bool
    options: dict[str, Any] = Field(description="All options in force.")
    inputs: dict[str, InputFile] = Field(description="Files by part name.")
    frames: int | None = Field(description="T, once it is known.")
    points: int | None = Field(description="N, once it is known.")
    progress: JobProgress | None
    timings: dict[str, float] = Field(description="Seconds by stage, in the queue and in total.")
    metrics: dict[str, Any] | None = Field(
        description="Errors against the ground truth, where one was sent; `e3d` above all. In a "
        "list without those of single frames."
    )
    diagnostics: DiagnosticsSummary | None = Field(
        description="Of a job that succeeded, in the document of one job."
    )
    problem: ProblemDocument | None = Field(description="Why a job failed.")
    webhook: JobWebhook | None = Field(None, description="Where one was asked for.")
    links: JobLinks


class JobList(BaseModel):
    """One page of jobs, newest first."""

    jobs: list[Job]
    next: str | None = Field(description="Path of the next page, as in the Link header (RFC 8288).")


class Spread(BaseModel):
    """How some numbers lie."""

    count: int
    mean: float
    median: float
    min: float
    max: float


class BatchLinks(BaseModel):
    """Where to go from a batch; paths relative to the service, null where nothing is there."""

    self: str
    jobs: str
    cancel: str | None
    retry: str | None
    results: str | None = Field(description="ZIP of the results of all jobs that succeeded")


class BatchEntry(BaseModel):
    """A batch in a list."""

    label: str
    total: int = Field(description="Number of jobs.")
    jobs: dict[JobStatus, int] = Field(description="Number of jobs by status.")
    created_at: datetime = Field(description="When its first job was submitted.")
    latest_at: datetime = Field(description="When its latest job was submitted.")
    links: BatchLinks


class BatchTimings(BaseModel):
    """Seconds of a batch."""

    elapsed: float | None = Field(
        description="From its first submission to its last end, once all jobs have ended."
    )
    run_total: float = Field(description="Run time of all jobs that succeeded, together.")
    run: Spread | None = Field(description="Run times of the jobs that succeeded.")


class BatchDocument(BatchEntry):
    """A batch and what became of it so far."""

    progress: float = Field(
        description="Part that is done, 0 to 1: the mean over all jobs; ended ones count as done."
    )
    finished_at: datetime | None = Field(description="When its last job ended, once all have.")
    e3d: Spread | None = Field(
        description="Errors of the jobs that succeeded and had a ground truth."
    )
    timings: BatchTimings


class BatchList(BaseModel):
    """One page of batches, latest first."""

    batches: list[BatchEntry]
    next: str | None = Field(description="Path of the next page, as in the Link header (RFC 8288).")


class BatchCancelled(BaseModel):
    """What became of the jobs of a batch that was cancelled."""

    cancelled: int = Field(description="Jobs that were queued and are cancelled.")
    stopping: int = Field(description="Jobs that run and were asked to stop.")


class BatchRetried(BaseModel):
    """What became of the jobs of a batch that was retried."""

    queued: int = Field(description="Jobs that are queued again.")
    inputs_gone: int = Field(description="Jobs that failed for their input and keep no files.")
    refused: int = Field(description="Jobs for which their owner has too many active ones.")


class Option(BaseModel):
    """An option of a job."""

    name: str
    type: Literal["integer", "number", "boolean", "string"]
    default: int | float | bool | str | None
    help: str
    minimum: float | None
    maximum: float | None
    choices: list[str] | None
    nullable: bool


class Limits(BaseModel):
    """What the service accepts."""

    upload_bytes: int = Field(description="All files of a job together.")
    array_bytes: int = Field(description="An array, once decompressed.")
    job_seconds: float = Field(description="Run time of a job.")
    result_ttl_seconds: float = Field(description="How long finished jobs stay; 0 is for ever.")
    wait_seconds: int = Field(description="Longest `Prefer: wait`.")
    page_size: int = Field(description="Largest `limit` of a list.")


class Formats(BaseModel):
    """What goes in and what comes out."""

    measurements: list[str]
    ground_truth: list[str]
    faces: list[str]
    results: list[str]


class Info(BaseModel):
    """What this service is and can."""

    version: str
    limits: Limits
    formats: Formats
    options: list[Option]


class Health(BaseModel):
    """That the process lives."""

    status: Literal["alive"] = "alive"


class Readiness(BaseModel):
    """That the service can take jobs."""

    status: Literal["ready"] = "ready"
    checks: dict[str, str] = Field(
        description="'ok' or what is wrong, of redis, storage, disk, workers and maintenance.",
        examples=[{"redis": "ok", "storage": "ok", "disk": "nearly full: uploads are refused"}],
    )
    workers: int = Field(description="Live worker processes; with none, jobs wait.")
    queued: int | None = Field(
        description="Jobs that wait for a worker; not told where API keys are needed."
    )


class ProblemTypeDocument(BaseModel):
    """Documentation of a problem type."""

    type: str
    title: str
    status: int
    meaning: str
    remedy: str
