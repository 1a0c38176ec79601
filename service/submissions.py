"""What a client may say about a job, and how a submission becomes a job.

A job is submitted as a multipart body (`service.uploads`) or as a JSON document that names finished
uploads; either way it has solver options (`worker.options.JobOptions`) and `JobSettings`, which say
how the job is to be treated. Each setting is a part of its own in the one form and a member in the
other.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import structlog
from anyio import to_thread
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic_core import PydanticCustomError
from redis.exceptions import RedisError

import smsr
from service.idempotency import in_progress
from service.problems import Problem
from service.targets import MAX_URL, TargetRefused, Targets
from worker.records import (
    JobRecord,
    KeyTaken,
    Priority,
    TooManyBytes,
    TooManyJobs,
    upload_prefix,
)
from worker.settings import Settings
from worker.storage import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import ValidationInfo

    from service.context import Context
    from smsr.files import Role
    from worker.options import JobOptions
    from worker.records import IdempotencyKey, InputFile
    from worker.storage import Sink

_log = structlog.get_logger(__name__)

_NOT_IN_RESULTS = ("time_limit",)
"""Options that do not change what a job that succeeds gives."""

LABEL_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
"""Of a batch; a label is a part of paths and of file names as it is."""

Label = Annotated[str, Field(pattern=LABEL_PATTERN, max_length=64)]

SETTING_BYTES = 4096
"""Largest part of a multipart body that holds one setting."""


class JobSettings(BaseModel):
    """How a job is to be treated; nothing here changes its result.

    Validated with the `Settings` of the operator as context, which bound what may be asked for.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    batch: Label | None = Field(
        default=None,
        description="Label of the batch that the job belongs to.",
        examples=["walk-17"],
    )
    priority: Priority = Field(
        default="normal",
        description="Jobs of a higher priority start first; those of one priority in their order.",
    )
    ttl: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Seconds that the job is kept after it has ended; 0 keeps it for ever, where "
        "the service allows that. Without it the service's own time holds.",
        examples=[86400],
    )
    reuse: bool | None = Field(
        default=None,
        description="Whether the finished result of an equal job, one with the same files and "
        "options, may be taken: the job has succeeded at once then. `false` makes a new run. "
        "Without it the service decides, which says yes unless its operator has chosen otherwise.",
    )

    webhook: Annotated[str, Field(max_length=MAX_URL)] | None = Field(
        default=None,
        description="https:// address on the public Internet that is told when the job has ended, "
        "by a signed POST (Standard Webhooks).",
        examples=["https://example.org/hooks/smsr"],
    )

    @field_validator("webhook")
    @classmethod
    def _acceptable(cls, webhook: str | None, info: ValidationInfo) -> str | None:
        operator = info.context
        if webhook is not None and isinstance(operator, Settings):
            if not operator.webhook_secret:
                raise PydanticCustomError("no_webhooks", "this service sends no webhooks")
            try:
                Targets(operator).parse(webhook)
            except TargetRefused as refusal:
                raise _bad_target(refusal) from None
        return webhook

    @field_validator("ttl")
    @classmethod
    def _within_bounds(cls, ttl: float | None, info: ValidationInfo) -> float | None:
        operator = info.context
        if ttl is not None and isinstance(operator, Settings):
            longest = operator.longest_ttl
            if (ttl or float("inf")) > longest:
                asked = "" if ttl else "0 would keep the job for ever, which is not allowed here; "
                raise PydanticCustomError(
                    "ttl_too_long",
                    "{asked}the service keeps jobs for at most {most} s",
                    {"asked": asked, "most": f"{longest:.15g}"},
                )
        return ttl


def _bad_target(refusal: TargetRefused) -> PydanticCustomError:
    return PydanticCustomError(
        "webhook_refused", "webhooks cannot go to this address: {why}", {"why": str(refusal)}
    )


SETTINGS = tuple(JobSettings.model_fields)
"""Names of the settings: parts of a multipart body, members of a JSON document."""


def settings_schema() -> dict[str, Any]:
    """Return the JSON Schemas of the settings by name, without the null of those not given."""
    schema = JobSettings.model_json_schema()["properties"]
    properties: dict[str, Any] = {}
    for name, described in schema.items():
        known = {k: v for k, v in described.items() if k not in ("title", "anyOf")}
        for choice in described.get("anyOf", ()):
            if choice != {"type": "null"}:
                known |= choice
        if known.get("default", 0) is None:
            del known["default"]
        properties[name] = known
    return properties


def read_settings(
    values: Mapping[str, Any], operator: Settings | None = None, *, texts: bool = False
) -> JobSettings:
    """Read settings as a client gave them.

    Parameters
    ----------
    values : mapping of str to object
        By name.
    operator : Settings, optional
        Bounds what may be asked for.
    texts : bool
        The values are texts, as in a multipart body, not JSON values.

    Raises
    ------
    Problem
        invalid-setting, which names the first setting at fault.
    """
    try:
        if texts:
            return JobSettings.model_validate_strings(dict(values), context=operator)
        return JobSettings.model_validate(dict(values), context=operator, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        name = str(first["loc"][0]) if first["loc"] else ""
        raise Problem(
            "invalid-setting", f"{name}: {first['msg']}.", setting=name, settings=list(SETTINGS)
        ) from None


@dataclass(frozen=True, slots=True)
class Submission:
    """A job as it was asked for, with its files stored.

    Attributes
    ----------
    options : JobOptions
    inputs : dict of str to InputFile
        By part name; 'measurements' is among them.
    frames, points : int or None
        T and N, where the beginning of the measurements tells them.
    settings : JobSettings
    from_uploads : mapping of str to str
        Ids and folders of the uploads that the files were, which are not lost with the submission.
    """

    options: JobOptions
    inputs: dict[Role, InputFile]
    frames: int | None
    points: int | None
    settings: JobSettings = field(default_factory=JobSettings)
    from_uploads: Mapping[str, str] = field(default_factory=dict)


def digest_of(submission: Submission, owner: str | None) -> str:
    """Return what is equal for an owner's submissions with equal results.

    It covers the bytes of all files, what their names say of their formats, the options that have a
    part in the result, and the version of the solver.
    """
    options = dataclasses.asdict(submission.options)
    for name in _NOT_IN_RESULTS:
        del options[name]
    return hash_of(
        {
            "owner": owner,
            "solver": smsr.__version__,
            "options": options,
            "inputs": {
                role: [file.sha256, Path(file.name.lower()).suffixes]
                for role, file in submission.inputs.items()
            },
        }
    )


def hash_of(document: object) -> str:
    """Return the SHA-256 of a JSON document, whatever the order of its members."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint_of(submission: Submission) -> str:
    """Return what tells submissions apart: files and their names, options and settings."""
    return hash_of(
        {
            "options": dataclasses.asdict(submission.options),
            "settings": submission.settings.model_dump(mode="json"),
            "inputs": {role: [f.name, f.sha256] for role, f in submission.inputs.items()},
        }
    )


async def accept(
    shared: Context,
    job_id: str,
    submission: Submission,
    uploads: Sequence[str] = (),
    *,
    key: IdempotencyKey | None = None,
) -> JobRecord:
    """Make a submission a job of this request's owner; Redis may go away at any moment.

    Where there is no job in the end, the files are removed.

    Parameters
    ----------
    shared : Context
    job_id : str
    submission : Submission
    uploads : sequence of str
        Ids of the finished uploads whose files the job has taken (`service.quotas.hold`).
    key : IdempotencyKey, optional
        Bound to the job.

    Raises
    ------
    TooManyJobs, TooManyBytes
        The owner may not have another one.
    Problem
        The claim to the key has lapsed, and it is another submission's now.
    """
    settings = submission.settings
    if not submission.from_uploads:
        try:
            await check_webhook(shared.settings, settings)
        except Problem:
            await discard_uploads(shared.storage, job_id)
            raise
    with shared.tracing.span("submit job", kind="producer", smsr__job=job_id) as span:
        record = await _submit(shared, job_id, submission, uploads, key, span.traceparent)
    _log.info("job accepted", job=job_id, status=record.status, batch=record.batch)
    return record


async def _submit(
    shared: Context,
    job_id: str,
    submission: Submission,
    uploads: Sequence[str],
    key: IdempotencyKey | None,
    trace: str | None,
) -> JobRecord:
    settings = submission.settings
    record = JobRecord.new(
        job_id,
        options=dataclasses.asdict(submission.options),
        inputs={str(role): file for role, file in submission.inputs.items()},
        name=submission.inputs["measurements"].name,
        owner=shared.owner,
        batch=settings.batch,
        priority=settings.priority,
        ttl=settings.ttl,
        digest=digest_of(submission, shared.owner),
        frames=submission.frames,
        points=submission.points,
        webhook=settings.webhook,
        request=shared.request,
        trace=trace,
    )
    held = (*uploads, *submission.from_uploads.values())
    reuse = shared.settings.reuse_results if settings.reuse is None else settings.reuse
    try:
        submit = partial(shared.queue.submit, record, shared.allowance, held)
        return await to_thread.run_sync(partial(submit, reuse=reuse, key=key))
    except (TooManyJobs, TooManyBytes, KeyTaken) as error:
        await _undo(shared, record.id, submission)
        if isinstance(error, KeyTaken):
            raise in_progress() from None
        raise
    except RedisError:
        # A record without a place in the queue gets one by maintenance: it is accepted. Where not
        # even that can be seen now, the files stay until maintenance knows whether there is one.
        accepted = await to_thread.run_sync(shared.queue.records.get, record.id)
        if accepted is not None:
            return accepted
        await _undo(shared, record.id, submission)
        raise


async def check_webhook(operator: Settings, settings: JobSettings) -> None:
    """Refuse a webhook whose host has no address that it may go to."""
    if settings.webhook is None:
        return
    targets = Targets(operator)
    try:
        await targets.addresses(targets.parse(settings.webhook))
    except TargetRefused as refusal:
        raise Problem(
            "invalid-setting",
            f"webhook: {_bad_target(refusal).message()}.",
            setting="webhook",
            settings=list(SETTINGS),
        ) from None


async def _undo(shared: Context, job_id: str, submission: Submission) -> None:
    """Remove the files of a job that will not be, or make them uploads again."""
    if not submission.from_uploads:
        await discard_uploads(shared.storage, job_id)
        return
    with suppress(RedisError):  # without Redis they are given back when they are asked for
        ids = list(submission.from_uploads)
        await to_thread.run_sync(shared.uploads.give_back, shared.owner, ids, job_id)


async def discard_uploads(storage: Sink, job_id: str) -> None:
    """Remove the inputs of a job that will not be; where that fails, maintenance does it later."""
    try:
        await to_thread.run_sync(storage.delete_prefix, upload_prefix(job_id))
    except StorageError:
        _log.warning("the files of a refused upload could not be removed now", exc_info=True)
