"""Reports of a running job: to the record, a few times a second at most."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import TYPE_CHECKING

import structlog
from redis.exceptions import RedisError

from smsr.progress import Progress
from worker.records import Verdict

if TYPE_CHECKING:
    from worker.records import RecordStore

_PAUSE_AFTER_FAILURE = 1.0

log = structlog.get_logger(__name__)


class AttemptOver(Exception):
    """The attempt holds the job no more: it was given to another worker, ended or deleted.

    Parameters
    ----------
    verdict : Verdict
        LOST or GONE.
    """

    def __init__(self, verdict: Verdict) -> None:
        super().__init__(f"the attempt is {verdict}")
        self.verdict = verdict


class ProgressReporter:
    """Writes reports of one attempt into its record, and hears whether to go on.

    An instance is a `smsr.progress.ProgressCallback`. A new stage is reported at once; within a
    stage reports are thinned out. While Redis is away the work goes on unreported.

    Parameters
    ----------
    records : RecordStore
        With a client that gives up soon: a report is not worth waiting for.
    job_id : str
    attempt : int
    interval : float
        Least seconds between two reports of a stage.
    lease : float
        Seconds for which a report prolongs the hold on the job.
    """

    def __init__(
        self, records: RecordStore, job_id: str, attempt: int, *, interval: float, lease: float
    ) -> None:
        self._records = records
        self._job_id = job_id
        self._attempt = attempt
        self._interval = interval
        self._lease = lease
        self._size: dict[str, int] = {}
        self._last = Progress("", 0.0)
        self._next = 0.0
        self._failing = False

    def set_size(self, frames: int, points: int) -> None:
        """Put T and N into the record with the next report."""
        self._size = {"frames": frames, "points": points}

    def due(self, stage: str) -> bool:
        """Whether it is time for a report of a stage; solvers call back thousands of times."""
        new_stage = stage != self._last.stage and not self._failing
        return new_stage or time.monotonic() >= self._next

    def __call__(self, progress: Progress) -> bool:
        """Report, if it is time to; False when the job was asked to stop.

        Raises
        ------
        AttemptOver
            The job is no longer this attempt's.
        """
        if not self.due(progress.stage):
            return True
        now = time.monotonic()
        residual = progress.residual
        if residual is not None and not math.isfinite(residual):
            residual = None
        fraction = max(self._last.fraction, min(progress.fraction, 1.0))
        self._last = dataclasses.replace(progress, fraction=fraction, residual=residual)
        try:
            verdict = self._records.report_progress(
                self._job_id, self._attempt, self._last, lease=self._lease, **self._size
            )
        except RedisError as error:
            log.warning("progress not reported", reason=str(error))
            self._failing = True
            self._next = time.monotonic() + _PAUSE_AFTER_FAILURE
            return True
        self._failing = False
        self._next = now + self._interval
        if verdict in (Verdict.LOST, Verdict.GONE):
            raise AttemptOver(verdict)
        return verdict is not Verdict.CANCELLED
