"""The RQ worker that looks after its work-horse.

RQ runs each job in a forked process, the work-horse. Its parent, here, holds the lease of the job
while the work-horse lives: even one that is deep in a library call without giving up the
interpreter stays known to be alive, and one that is killed is known to be dead at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import structlog
from redis.exceptions import RedisError
from rq import Worker
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.timeouts import HorseMonitorTimeoutException
from rq.worker import WorkerStatus

from worker.cgroup import out_of_memory_kills
from worker.problems import OutOfMemory, TimeLimitExceeded, WorkerLost, problem_document
from worker.processes import die_with_parent, raise_after
from worker.queue import queue_names
from worker.scratch import empty_folder

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from redis import Redis
    from rq.executions import Execution
    from rq.job import Job
    from rq.queue import Queue

    from smsr.errors import SmsrError
    from worker.queue import JobQueue

WORKER_TTL = 35
"""Seconds RQ waits for a job at a time, plus 15."""

BEGIN_GRACE = 60.0
"""A work-horse that has not begun after this never will."""

LIMIT_GRACE = 10.0
PUBLISHING_GRACE = 900.0
"""A work-horse past its time limit should have ended by itself after this."""

_OUT_OF_MEMORY_ATTEMPTS = 3
"""Another worker may have had the memory; but a job that is too large is so each time."""

log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Watch:
    """What the supervisor knows of the work-horse it looks after."""

    memory_kills: int | None = None
    """Reading of `worker.cgroup.out_of_memory_kills` at its start."""

    attempt: int = 0
    limit: float | None = None
    lost_at: float | None = None
    handed_back: bool = False
    error: SmsrError | None = None
    killed: bool = False


class Supervisor(Worker):
    """One worker process.

    Parameters
    ----------
    queue : JobQueue
        Its client is used beside RQ's own.
    connection : Redis
        RQ's own client; RQ changes its timeouts.
    name : str
        Used by no other process.
    beat : callable
        Called now and then while waiting and about once a heartbeat while working.
    """

    max_connection_wait_time = 2.0
    log_result_lifespan = False

    def __init__(
        self, queue: JobQueue, connection: Redis, name: str, beat: Callable[[], None]
    ) -> None:
        self.jobs = queue
        self.settings = queue.settings
        self.beat = beat
        self.stop_at: float | None = None
        self._watch = _Watch()
        # A former instance of this process may not have been able to say goodbye. RQ's own client
        # is not to connect before RQ has given it the patience for its long waits.
        queue.redis.delete(self.redis_worker_namespace_prefix + name)
        super().__init__(
            list(queue_names(queue.settings.queue).values()),
            name=name,
            connection=connection,
            serializer=JSONSerializer,
            worker_ttl=WORKER_TTL,
            maintenance_interval=60,
            log_job_description=False,
        )

    # RQ's commands come by a thread, which must not be there when this process forks; leases and
    # the record say all that is needed.
    def subscribe(self) -> None:
        """Do not listen to RQ's commands."""

    def unsubscribe(self) -> None:
        """Have nothing to end."""

    def heartbeat(self, *arguments: Any, **keywords: Any) -> None:
        """Tell RQ and the rest of the process that all is well."""
        super().heartbeat(*arguments, **keywords)
        if not self.is_horse:
            self.beat()
            if self.stop_at is not None and self.get_state() != WorkerStatus.BUSY:
                raise StopRequested  # once more: RQ waits on if anything swallowed the first

    def request_stop(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Stop soon: at once when idle, else after a grace; at a second signal without it."""
        again = self.stop_at is not None
        self.stop_at = time.monotonic() + (0 if again else self.settings.shutdown_grace_seconds)
        self._stop_requested = True
        if self.get_state() != WorkerStatus.BUSY:
            raise StopRequested

    def main_work_horse(self, job: Job, queue: Queue) -> None:
        """Run the job in the work-horse, which must not outlive its parent."""
        die_with_parent(self.pid or 0)
        super().main_work_horse(job, queue)

    def monitor_work_horse(self, job: Job, queue: Queue, execution: Execution) -> None:  # noqa: ARG002
        """Hold the lease while the work-horse lives, then see that the job is not lost."""
        (job_id,) = job.args
        self._watch = _Watch(memory_kills=out_of_memory_kills())
        timer = HorseMonitorTimeoutException()
        while True:
            try:
                with raise_after(self.settings.heartbeat_seconds, timer):
                    _, status, _ = self.wait_for_horse()
                break
            except HorseMonitorTimeoutException:
                try:
                    self._look_after(job_id)
                    self.maintain_heartbeats(job, execution)
                except RedisError as error:
                    log.warning("Redis is away", job=job_id, reason=str(error))
        self._horse_pid = 0
        self.executions.pop(execution.id, None)
        try:
            self._settle(job_id, job.id, status)
        except RedisError as error:
            # The lease runs out, and whoever looks first takes the job.
            log.warning("Redis is away", job=job_id, reason=str(error))
        empty_folder(self.settings.scratch)

    def _look_after(self, job_id: str) -> None:
        """Renew the lease; kill a work-horse that does not do what it should."""
        watch = self._watch
        if self.stop_at is not None and time.monotonic() >= self.stop_at:
            watch.handed_back = True
            self._kill(job_id, "the worker stops")
            return
        hold = self.jobs.records.renew(job_id, worker=self.name, lease=self.settings.lease_seconds)
        if hold.state == "held":
            watch.attempt, watch.lost_at = hold.attempt, None
            if watch.limit is None:
                record = self.jobs.records.get(job_id)
                asked = record.options.get("time_limit") if record else None
                watch.limit = self.settings.time_limit(asked)
            grace = PUBLISHING_GRACE if hold.stage == "publishing" else LIMIT_GRACE
            if (hold.cancel_seconds or 0.0) > self.settings.cancel_grace_seconds:
                self._kill(job_id, "it was cancelled")
            elif hold.running_seconds > watch.limit + grace:
                watch.error = TimeLimitExceeded(watch.limit)
                self._kill(job_id, "it is over its time limit")
        else:
            # It may not have begun yet, be about to notice by itself that the job is no longer
            # its own, or have published and be on its way out.
            not_begun = hold.state == "queued" and not watch.attempt
            grace = BEGIN_GRACE if not_begun else self.settings.cancel_grace_seconds
            watch.lost_at = watch.lost_at or time.monotonic()
            if time.monotonic() - watch.lost_at > grace:
                self._kill(job_id, f"the job is {hold.state}")

    def _kill(self, job_id: str, reason: str) -> None:
        log.warning("work-horse is killed", job=job_id, reason=reason)
        self._watch.killed = True
        self.kill_horse()

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the work-horse and what it has started."""
        with contextlib.suppress(ProcessLookupError):
            group = os.getpgid(self.horse_pid)
            if group == os.getpgrp():  # just forked, it has no group of its own yet
                os.kill(self.horse_pid, sig)
            else:
                os.killpg(group, sig)

    def _killed_for_memory(self) -> bool:
        before, now = self._watch.memory_kills, out_of_memory_kills()
        return before is not None and now is not None and now > before

    def _settle(self, job_id: str, ticket: str, status: int | None) -> None:
        """Take the job back from a dead work-horse that had not brought it to an end."""
        watch, settings = self._watch, self.settings
        problem: SmsrError = WorkerLost(settings.max_attempts)
        most = settings.max_attempts
        if watch.error is not None:
            self.jobs.records.fail(job_id, watch.attempt, problem_document(watch.error))
        elif status == signal.SIGKILL and not watch.killed and self._killed_for_memory():
            most = min(most, _OUT_OF_MEMORY_ATTEMPTS)
            problem = OutOfMemory("The worker was killed because the machine ran out of memory.")
        outcome = self.jobs.records.release(
            job_id,
            self.name,
            lost=not watch.handed_back,
            max_attempts=most,
            problem=problem_document(problem),
        )
        if outcome == "queued":
            log.warning("work-horse died, job queued again", job=job_id, status=status)
            self.jobs.enqueue(job_id, first=True)
        elif outcome == "failed":
            log.error("work-horse died once too often", job=job_id, status=status)
        self.jobs.discard_ticket(ticket)
