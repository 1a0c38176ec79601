"""How records turn into the documents of the service."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from smsr_client.documents import (
    BatchDocument,
    BatchEntry,
    BatchLinks,
    BatchTimings,
    DiagnosticsSummary,
    InputFile,
    Job,
    JobLinks,
    JobProgress,
    JobWebhook,
    Option,
    ProblemDocument,
    Spread,
    UploadDocument,
    UploadLinks,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smsr.options import OptionDescription
    from worker.batches import Batch, BatchCounts
    from worker.batches import Spread as NumberSpread
    from worker.records import JobRecord
    from worker.uploads import Upload


def job_document(
    record: JobRecord,
    *,
    root: str,
    position: int | None = None,
    diagnostics: Mapping[str, Any] | None = None,
    brief: bool = False,
) -> Job:
    """Turn a job record into its document.

    Parameters
    ----------
    record : JobRecord
    root : str
        Path prefix under which the service is reached, without a slash at its end.
    position : int, optional
        Number of jobs before this one.
    diagnostics : mapping, optional
        The diagnostics of report.json.
    brief : bool
        Leave out what has an entry for every frame.
    """
    here = f"{root}/v1/jobs/{record.id}"
    done = record.status == "succeeded"
    active = record.status in ("queued", "running")
    problem = None
    if record.problem is not None:
        problem = ProblemDocument(**{"instance": here, **record.problem})
    return Job(
        id=record.id,
        status=record.status,
        name=record.name,
        batch=record.batch,
        priority=record.priority,
        ttl=record.ttl,
        reused_from=record.reused_from,
        created_at=_moment(record.created_at),
        started_at=_moment_or_none(record.started_at),
        finished_at=_moment_or_none(record.finished_at),
        expires_at=_moment_or_none(record.expires_at),
        attempt=record.attempt,
        queue_position=position,
        cancel_requested=record.cancel_requested,
        options=dict(record.options),
        inputs={
            role: InputFile(
                name=file.name,
                bytes=file.bytes,
                content_type=file.content_type,
                sha256=file.sha256,
                link=f"{here}/inputs/{role}",
            )
            for role, file in record.inputs.items()
        },
        frames=record.frames,
        points=record.points,
        progress=JobProgress.model_validate(record.progress, from_attributes=True)
        if record.progress is not None
        else None,
        timings=dict(record.timings),
        metrics=None if record.metrics is None else _metrics(record.metrics, brief=brief),
        diagnostics=DiagnosticsSummary.model_validate(diagnostics) if diagnostics else None,
        problem=problem,
        webhook=_webhook(record),
        links=JobLinks(
            self=here,
            cancel=f"{here}/cancel" if active else None,
            retry=None if active else f"{here}/retry",
            result=f"{here}/result.npz" if done else None,
            frames=f"{here}/frames.zip" if done else None,
            frame=f"{here}/frames/{{t}}.ply" if done else None,
            shapes=f"{here}/shapes.npy" if done else None,
            cameras=f"{here}/cameras.npy" if done else None,
            translations=f"{here}/translations.npy" if done else None,
            faces=f"{here}/faces.npy" if done and "faces" in record.inputs else None,
            glb=f"{here}/result.glb" if done else None,
            figure=f"{here}/figures/{{name}}.{{form}}" if done else None,
            report=f"{here}/report.json" if done else None,
        ),
    )


def upload_document(upload: Upload, *, root: str = "") -> UploadDocument:
    """Return the document of an upload."""
    return UploadDocument(
        id=upload.id,
        name=upload.name,
        content_type=upload.content_type,
        role=upload.role,
        bytes=upload.length,
        offset=upload.offset,
        complete=upload.complete,
        sha256=upload.sha256,
        created_at=_moment(upload.created_at),
        expires_at=_moment(upload.expires_at),
        links=UploadLinks(
            self=f"{root}/v1/uploads/{upload.id}",
            job=f"{root}/v1/jobs/{upload.job}" if upload.job else None,
        ),
    )


def _webhook(record: JobRecord) -> JobWebhook | None:
    if record.webhook is None:
        return None
    known = dict(record.webhook_state or {"state": "waiting", "attempts": 0})
    for moment in ("delivered_at", "next_attempt_at"):
        known[moment] = _moment_or_none(float(known[moment])) if moment in known else None
    return JobWebhook(host=urlsplit(record.webhook).hostname or "", **known)


def batch_entry(counts: BatchCounts, *, root: str) -> BatchEntry:
    """Turn the counts of a batch into its entry in a list."""
    here = f"{root}/v1/batches/{counts.label}"
    jobs = counts.jobs
    return BatchEntry(
        label=counts.label,
        total=counts.total,
        jobs=dict(jobs),
        created_at=_moment(counts.created_at),
        latest_at=_moment(counts.latest_at),
        links=BatchLinks(
            self=here,
            jobs=f"{root}/v1/jobs?batch={counts.label}",
            cancel=f"{here}/cancel" if jobs["queued"] + jobs["running"] else None,
            retry=f"{here}/retry" if jobs["failed"] + jobs["cancelled"] else None,
            results=f"{here}/results.zip" if jobs["succeeded"] else None,
        ),
    )


def batch_document(batch: Batch, *, root: str) -> BatchDocument:
    """Turn a batch into its document."""
    entry = batch_entry(batch.counts, root=root)
    ended = batch.finished_at
    return BatchDocument(
        **entry.model_dump(),
        progress=batch.progress,
        finished_at=_moment_or_none(ended),
        e3d=_spread(batch.e3d),
        timings=BatchTimings(
            elapsed=None if ended is None else max(0.0, ended - batch.counts.created_at),
            run_total=batch.seconds.total if batch.seconds else 0.0,
            run=_spread(batch.seconds),
        ),
    )


def _spread(found: NumberSpread | None) -> Spread | None:
    if found is None:
        return None
    return Spread(
        count=found.count, mean=found.mean, median=found.median, min=found.least, max=found.most
    )


def _metrics(metrics: Mapping[str, Any], *, brief: bool) -> dict[str, Any]:
    return {
        name: value
        for name, value in metrics.items()
        if not (brief and isinstance(value, list | tuple))
    }


def option_document(option: OptionDescription) -> Option:
    """Turn the description of an option into its document."""
    return Option.model_validate(option, from_attributes=True)


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _moment_or_none(seconds: float | None) -> datetime | None:
    return None if seconds is None else _moment(seconds)
