"""What RQ runs: one attempt at a job, from its inputs to published results."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import structlog
from redis.exceptions import RedisError
from rq import get_current_job

import smsr
from smsr.errors import Cancelled, InputError, SmsrError
from smsr.files import load_faces, open_array
from smsr.measurements import as_source
from smsr.metrics import as_shapes
from smsr.options import parse
from smsr.progress import Progress
from worker.checksums import CHECKSUMS, FRAME_CHECKSUMS, write_checksums
from worker.connections import connect
from worker.memory import memory_budget
from worker.options import JobOptions
from worker.problems import (
    InputMissing,
    InternalError,
    OutOfMemory,
    StorageUnavailable,
    TimeLimitExceeded,
    problem_document,
)
from worker.processes import raise_after
from worker.progress import AttemptOver, ProgressReporter
from worker.queue import JobQueue
from worker.records import RecordStore, Verdict, result_prefix, upload_prefix
from worker.settings import environment_settings
from worker.storage import ObjectMissing, ObjectStorage, StorageError
from worker.tracing import Tracing

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from worker.records import JobRecord
    from worker.settings import Settings
    from worker.tracing import Span

T = TypeVar("T")

SOLVER_SHARE = 0.9
"""Part of the progress bar that is the solver's; evaluating and publishing have the rest."""

_INSIST_SECONDS = 600.0
_REPORT_TIMEOUT = 1.0
ARRAYS = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy")
RESULTS = (*ARRAYS, "report.json", CHECKSUMS, FRAME_CHECKSUMS)
"""Objects of a result; faces only where some were given."""

_PAUSES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)

log = structlog.get_logger(__name__)


def run(job_id: str) -> None:
    """Run one attempt at a job; nothing happens when the job needs none.

    Parameters
    ----------
    job_id : str
    """
    ticket = get_current_job()
    settings = environment_settings()
    if ticket is None or settings.redis_url is None:
        raise RuntimeError("a job runs in a worker only")
    records = RecordStore(ticket.connection, result_ttl=settings.result_ttl_seconds)
    begin = partial(
        records.begin_attempt,
        job_id,
        worker=ticket.worker_name or ticket.id,
        ticket=ticket.id,
        lease=settings.lease_seconds,
    )
    attempt = _insist(begin)
    if attempt is None:
        log.info("nothing to do", job=job_id)
        return
    with structlog.contextvars.bound_contextvars(job=job_id, attempt=attempt):
        record = _insist(partial(records.get, job_id))
        if record is not None:
            if record.request is not None:
                structlog.contextvars.bind_contextvars(request=record.request)
            _run(settings, records, record, attempt)


def _run(settings: Settings, records: RecordStore, record: JobRecord, attempt: int) -> None:
    """Run an attempt as a span of the trace that its submission began."""
    tracing = Tracing("smsr-worker")
    try:
        with tracing.span(
            "run job",
            parent=record.trace,
            kind="consumer",
            smsr__job=record.id,
            smsr__attempt=attempt,
            smsr__request=record.request,
        ) as span:
            if span.trace_id is not None:
                structlog.contextvars.bind_contextvars(trace=span.trace_id)
            log.info("attempt began", queued_seconds=_queued_seconds(record))
            _Attempt(settings, records, record, attempt, tracing, span).run()
    finally:
        tracing.close()


class _Attempt:
    """One attempt: does the work, and says how it ended."""

    def __init__(
        self,
        settings: Settings,
        records: RecordStore,
        record: JobRecord,
        attempt: int,
        tracing: Tracing,
        span: Span,
    ) -> None:
        self.tracing = tracing
        self.span = span
        self.stage: tuple[str, Span] | None = None
        self.settings = settings
        self.records = records
        self.record = record
        self.attempt = attempt
        # Insisted upon like all else that the storage does: a start costs one of a few attempts.
        self.storage = self._with_storage(partial(ObjectStorage, settings.objects_url))
        self.prefix = result_prefix(record.id, attempt)
        self.folder = settings.scratch / f"{record.id}-{attempt}"
        self.report = ProgressReporter(
            RecordStore(connect(str(settings.redis_url), timeout=_REPORT_TIMEOUT)),
            record.id,
            attempt,
            interval=settings.progress_interval_seconds,
            lease=settings.lease_seconds,
        )
        self.timings = {"queued": _queued_seconds(record)}
        self.began = time.perf_counter()

    def run(self) -> None:
        """Do the work and end the attempt, whatever comes."""
        try:
            options = parse(JobOptions, self.record.options)
            limit = self.settings.time_limit(options.time_limit)
            self.folder.mkdir(parents=True, exist_ok=True)
            with (
                memory_budget(self.settings.memory_per_job),
                raise_after(limit, TimeLimitExceeded(limit)),
            ):
                evaluation = self._compute(options)
            self._publish(evaluation)
        except AttemptOver as over:
            log.warning("attempt is over", verdict=str(over.verdict))
            self._discard()
        except Cancelled:
            self._discard()
            self._end("cancelled", lambda: self.records.stop(self.record.id, self.attempt))
        except StorageError as error:
            self._discard()
            self._give_back(error)
        except MemoryError:
            self._fail(OutOfMemory.budget(self.settings.memory_per_job))
        except SmsrError as error:
            self._fail(error)
        except Exception:
            reference = uuid.uuid4().hex[:12]
            log.exception("attempt failed unexpectedly", reference=reference)
            self._fail(InternalError(reference))
        finally:
            self._end_stage()
            shutil.rmtree(self.folder, ignore_errors=True)

    # The work

    def _compute(self, options: JobOptions) -> smsr.Evaluation | None:
        """Reconstruct into the scratch folder, and compare with ground truth if there is some."""
        measurements, truth, faces = self._open_inputs(options)
        reconstruction = smsr.reconstruct(
            measurements,
            out=self.folder,
            progress=self._solver_progress,
            options=options.solver_options(),
        )
        self.timings |= reconstruction.diagnostics.seconds
        if faces is not None:
            np.save(self.folder / "faces.npy", faces)
        if truth is None:
            return None
        self._stage("evaluating", SOLVER_SHARE)
        started = time.perf_counter()
        evaluation = smsr.evaluate(truth, reconstruction, frame=options.ground_truth_frame)
        self.timings["evaluating"] = time.perf_counter() - started
        return evaluation

    def _open_inputs(
        self, options: JobOptions
    ) -> tuple[smsr.measurements.MeasurementSource, NDArray[Any] | None, NDArray[Any] | None]:
        """Open all inputs and check them against each other before the long work begins."""
        self._stage("opening", 0.0)
        started = time.perf_counter()
        source = as_source(
            self._open("measurements", options.measurements_key),
            options.layout,
            check=options.missing == "refuse",
        )
        self.report.set_size(source.frames, source.points)
        truth = faces = None
        if "ground_truth" in self.record.inputs:
            truth = self._open("ground_truth", options.ground_truth_key)
            as_shapes(truth, source.frames, source.points)
        if "faces" in self.record.inputs:
            faces = load_faces(
                self._local("faces"),
                source.points,
                key=options.faces_key,
                limit=self.settings.max_array_bytes,
                name=self.record.inputs["faces"].name,
            )
        self.timings["opening"] = time.perf_counter() - started
        return source, truth, faces

    def _open(self, role: smsr.files.Role, key: str | None) -> NDArray[Any]:
        return open_array(
            self._local(role),
            key=key,
            role=role,
            limit=self.settings.max_array_bytes,
            name=self.record.inputs[role].name,
        )

    def _local(self, role: str) -> Path:
        file = self.record.inputs[role]
        try:
            return self._with_storage(lambda: self.storage.open_local(file.key, self.folder))
        except ObjectMissing:
            raise InputMissing(
                f"The uploaded file {file.name!r} is no longer in the storage.", role=role
            ) from None

    def _publish(self, evaluation: smsr.Evaluation | None) -> None:
        """Upload the results of this attempt, then make them those of the job."""
        self._stage("publishing", 0.95)
        started = time.perf_counter()
        metrics = None if evaluation is None else evaluation.to_dict()
        report_path = self.folder / "report.json"
        report = json.loads(report_path.read_text(encoding="utf-8"))
        report |= {"metrics": metrics, "timings": self.timings}
        report_path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        write_checksums(self.folder, ARRAYS)
        paths = [path for name in RESULTS if (path := self.folder / name).exists()]
        stored = sum(path.stat().st_size for path in paths)
        # At the same time: each waits for a disk or a network to say that it has the bytes.
        with ThreadPoolExecutor(len(paths)) as pool:
            for upload in [pool.submit(copy_context().run, self._upload, path) for path in paths]:
                upload.result()
        self.timings["publishing"] = time.perf_counter() - started
        self.timings["total"] = self.timings["queued"] + time.perf_counter() - self.began
        verdict = self._end(
            "succeeded",
            lambda: self.records.publish(
                self.record.id,
                self.attempt,
                frames=report["frames"],
                points=report["points"],
                timings=self.timings,
                metrics=metrics,
                result_bytes=stored,
            ),
        )
        if verdict is Verdict.CANCELLED:
            raise Cancelled("The job was cancelled while its results were published.")
        if verdict is not Verdict.OK:
            raise AttemptOver(verdict)

    def _upload(self, path: Path) -> None:
        put = partial(self.storage.put_file, self.prefix + path.name, path, move=True)
        self._with_storage(put)

    # Progress

    def _solver_progress(self, progress: Progress) -> bool:
        self._trace(progress.stage)
        if not self.report.due(progress.stage):
            return True
        return self.report(dataclasses.replace(progress, fraction=SOLVER_SHARE * progress.fraction))

    def _trace(self, stage: str) -> None:
        """Have a span for the stage, which ends that of the one before."""
        if self.tracing.on and (self.stage is None or self.stage[0] != stage):
            self._end_stage()
            self.stage = stage, self.tracing.begin(stage)

    def _end_stage(self) -> None:
        if self.stage is not None:
            self.stage[1].end()
            self.stage = None

    def _stage(self, name: str, fraction: float) -> None:
        self._trace(name)
        if not self.report(Progress(name, fraction)):
            raise Cancelled(f"The run was cancelled in stage {name!r}.", stage=name)

    # Ends

    def _fail(self, error: SmsrError) -> None:
        self._discard()
        problem = problem_document(error)
        verdict = self._end(
            "failed", lambda: self.records.fail(self.record.id, self.attempt, problem)
        )
        if verdict is Verdict.CANCELLED:
            self._end("cancelled", lambda: self.records.stop(self.record.id, self.attempt))
        elif verdict is Verdict.OK and isinstance(error, InputError):
            # No other run can do better with these files.
            self._remove(upload_prefix(self.record.id))
            _insist(lambda: self.records.forget_inputs(self.record.id))

    def _give_back(self, error: StorageError) -> None:
        """Let the job be run again, here or where the storage can be reached."""
        log.error("storage does not work", reason=str(error))
        problem = problem_document(
            StorageUnavailable("The object storage could not be read or written for a long time.")
        )
        outcome = _insist(
            lambda: self.records.release(
                self.record.id,
                self.attempt,
                lost=True,
                max_attempts=self.settings.max_attempts,
                problem=problem,
            )
        )
        if outcome == "queued":
            queue = JobQueue(self.settings, self.records.redis, self.storage)
            _insist(lambda: queue.enqueue(self.record.id))

    def _end(self, outcome: str, step: Callable[[], Verdict]) -> Verdict:
        """Take the last step of the attempt, however long Redis is away."""
        verdict = _insist(step)
        self._end_stage()
        self.span.set(smsr__outcome=outcome)
        if outcome == "failed":
            self.span.fail(outcome)
        log.info("attempt ended", outcome=outcome, verdict=str(verdict), timings=self.timings)
        return verdict

    def _discard(self) -> None:
        """Remove what this attempt has uploaded; maintenance does it where this fails."""
        self._remove(self.prefix)

    def _remove(self, prefix: str) -> None:
        """Remove objects; those that cannot be removed now go by maintenance or with the job."""
        try:
            self.storage.delete_prefix(prefix)
        except StorageError as error:
            log.warning("objects are left for later", prefix=prefix, reason=str(error))

    def _with_storage(self, action: Callable[[], T]) -> T:
        """Do something with the storage, again and again for a while when it fails."""
        return _persist(action, StorageError, self.settings.storage_retry_seconds)


def _insist(step: Callable[[], T]) -> T:
    """Take a step in Redis, however long it is away (within reason)."""
    return _persist(step, RedisError, _INSIST_SECONDS)


def _persist(action: Callable[[], T], errors: type[Exception], seconds: float) -> T:
    """Try again, with growing pauses, until an action succeeds or time is up."""
    deadline = time.monotonic() + seconds
    pauses = itertools.chain(_PAUSES, itertools.repeat(_PAUSES[-1]))
    while True:
        try:
            return action()
        except ObjectMissing:
            raise
        except errors as error:
            pause = next(pauses)
            if time.monotonic() + pause > deadline:
                raise
            log.warning("trying again", reason=str(error))
            time.sleep(pause)


def _queued_seconds(record: JobRecord) -> float:
    queued_at = record.queued_at or record.created_at
    return max(0.0, (record.started_at or queued_at) - queued_at)
