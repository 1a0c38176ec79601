"""The queue: submit, cancel, delete and retry jobs, and repair what crashes leave behind.

The record of a job (`worker.records`) is the truth; an RQ job is only a ticket that leads some
worker to it. A ticket may be lost or come twice without harm: `JobQueue.recover` gives a new one to
a queued record that has none, and a second ticket finds that its job is taken.
"""

from __future__ import annotations

import re
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import structlog
from rq import Queue
from rq.exceptions import InvalidJobOperation, NoSuchJobError
from rq.job import Job
from rq.serializers import JSONSerializer

from worker.connections import connect
from worker.problems import WorkerLost, problem_document
from worker.records import (
    ANY,
    PREFIX,
    PRIORITIES,
    Allowance,
    JobActive,
    JobRecord,
    RecordStore,
    TooManyJobs,
    record_key,
)
from worker.storage import ObjectMissing, ObjectStorage, StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from redis import Redis

    from worker.records import IdempotencyKey, Priority
    from worker.settings import Settings

TASK = "worker.task.run"
"""Name of the function that RQ runs; its only argument is the job id."""

TICKET_TTL = 60
"""Seconds for which RQ remembers a ticket whose work-horse died."""

FORMER_TICKET_TTL = 600
"""Seconds for which a ticket that was replaced may still lead a worker to its job."""

_LATE_WRITER_SECONDS = 15.0
"""After a deletion a worker that has not noticed may write for a while; look again after that."""

_KEY_OF_A_TICKET = re.compile(
    r"rq:(?:job|executions|results):(?P<ticket>(?P<job>[0-9a-f]{32})-[0-9a-f]{12})(?::.*)?"
)

log = structlog.get_logger(__name__)


def queue_names(name: str) -> dict[Priority, str]:
    """Return the names of the RQ queues, in the order in which workers serve them.

    The normal one has no suffix: it is the queue that there was before there were priorities, so
    that jobs which an earlier version queued are run, and its workers run normal jobs.
    """
    return {
        priority: name if priority == "normal" else f"{name}-{priority}" for priority in PRIORITIES
    }


class InputsGone(Exception):
    """The job failed for its input, and its files were removed."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """What a look for lost jobs found, as ids.

    Attributes
    ----------
    requeued : tuple of str
        Given to the queue again: their worker fell silent, or their ticket was lost.
    failed : tuple of str
        Lost too often.
    cancelled : tuple of str
        Their worker fell silent after they were asked to stop.
    """

    requeued: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()
    cancelled: tuple[str, ...] = ()


class JobQueue:
    """The way in for the service, and the keeper of order for the workers.

    Parameters
    ----------
    settings : Settings
    redis : Redis, optional
        Client that does not decode answers; by default one to ``settings.redis_url``.
    storage : ObjectStorage, optional
        By default that of ``settings.objects_url``, opened when it is first needed.
    """

    def __init__(
        self,
        settings: Settings,
        redis: Redis | None = None,
        storage: ObjectStorage | None = None,
    ) -> None:
        if redis is None:
            if settings.redis_url is None:
                raise ValueError("the settings name no Redis server")
            redis = connect(settings.redis_url)
        self.settings = settings
        self.redis = redis
        self.records = RecordStore(redis, result_ttl=settings.result_ttl_seconds)
        self.queues: Mapping[Priority, Queue] = {
            priority: Queue(name, connection=redis, serializer=JSONSerializer)
            for priority, name in queue_names(settings.queue).items()
        }
        self._storage = storage

    @property
    def storage(self) -> ObjectStorage:
        """Where inputs and results are."""
        if self._storage is None:
            self._storage = ObjectStorage(self.settings.objects_url)
        return self._storage

    # For the service

    def submit(
        self,
        record: JobRecord,
        allowance: Allowance = ANY,
        uploads: Sequence[str] = (),
        *,
        reuse: bool = False,
        key: IdempotencyKey | None = None,
    ) -> JobRecord:
        """Accept a job whose inputs are stored, and return its record as it is now.

        Parameters
        ----------
        record : JobRecord
        allowance : Allowance
            What its owner may have.
        uploads : sequence of str
            Ids of the finished uploads that its inputs were, if they were such.
        reuse : bool
            Take the result of a job with the same digest, where there is one.
        key : IdempotencyKey, optional
            Bound to the job.

        Raises
        ------
        JobExists
            There is a job of this id.
        TooManyJobs, TooManyBytes
            The owner may not have another one.
        KeyTaken
            The key is bound or claimed by another submission.
        """
        self.records.create(record, allowance, uploads, reuse=reuse, key=key)
        self.enqueue(record.id)
        return self.records.get(record.id) or record

    def cancel(self, job_id: str) -> JobRecord | None:
        """Cancel a job: a queued one ends at once, a running one within a few seconds.

        Returns its record (of a job that had ended, unchanged), None when there is none.
        """
        outcome, ticket = self.records.cancel(job_id)
        if outcome == "cancelled":
            self.discard_ticket(ticket)
        return self.records.get(job_id)

    def delete(self, job_id: str, *, only_expired: bool = False) -> bool:
        """Remove a job, its inputs and its results; a running one is stopped.

        Returns whether one was removed. Objects that cannot be removed now are removed by
        `worker.maintenance` later.

        Parameters
        ----------
        job_id : str
        only_expired : bool
            Keep it unless its time to live has passed.
        """
        outcome, ticket, unwanted = self.records.delete(
            job_id, only_expired=only_expired, again=_LATE_WRITER_SECONDS
        )
        if outcome != "ok":
            return False
        self.discard_ticket(ticket)
        for prefix in unwanted:
            try:
                self.storage.delete_prefix(prefix)
            except StorageError as error:
                log.warning("objects are left for later", prefix=prefix, reason=str(error))
        return True

    def retry(self, job_id: str, allowance: Allowance = ANY) -> JobRecord | None:
        """Run a job that has ended once more; None when there is none.

        Raises
        ------
        JobActive
            It has not ended.
        TooManyJobs
            Its owner may not have another active one.
        InputsGone
            It failed for its input, whose files were removed then.
        """
        record = self.records.get(job_id)
        if record is not None and record.status == "failed":
            self._check_inputs(record)
        outcome = self.records.retry(job_id, allowance)
        if outcome == "active":
            raise JobActive(job_id)
        if outcome == "busy":
            raise TooManyJobs(job_id)
        if outcome == "ok":
            self.enqueue(job_id)
        return self.records.get(job_id)

    def _check_inputs(self, record: JobRecord) -> None:
        try:
            for file in record.inputs.values():
                self.storage.size(file.key)
        except ObjectMissing:
            raise InputsGone(record.id) from None

    def position(self, job_id: str) -> int | None:
        """Return how many jobs are ahead of a queued one, None when it is not queued."""
        ticket = self.records.ticket(job_id)
        if not ticket:
            return None
        with self.redis.pipeline() as pipe:
            for queue in self.queues.values():
                pipe.lpos(queue.key, ticket)
                pipe.llen(queue.key)
            answers = pipe.execute()
        before = 0
        for place, length in zip(answers[::2], answers[1::2], strict=True):
            if place is not None:
                return before + cast("int", place)
            before += length
        return None

    def length(self) -> int:
        """Return the number of jobs that wait for a worker."""
        return self.records.count()["queued"]

    def workers(self) -> int:
        """Return the number of workers that gave a sign of life within the last seconds."""
        return self.records.workers_since(2 * self.settings.lease_seconds)

    # Tickets

    def enqueue(self, job_id: str, *, first: bool = False) -> None:
        """Give a queued job a ticket; nothing happens when it is not queued."""
        ticket = f"{job_id}-{uuid.uuid4().hex[:12]}"
        assigned = self.records.assign_ticket(job_id, ticket)
        if assigned is None:
            return
        former, priority = assigned
        self.queues[priority].enqueue_call(
            TASK,
            args=(job_id,),
            timeout=-1,  # the worker enforces the job's own limit
            result_ttl=0,
            failure_ttl=TICKET_TTL,
            description=job_id,
            job_id=ticket,
            at_front=first,
        )
        if former:
            # Some worker may still be about to begin with it, so it is left to fade away.
            self.redis.expire(Job.key_for(former), FORMER_TICKET_TTL)

    def discard_ticket(self, ticket: str) -> None:
        """Remove all that RQ knows of a ticket."""
        if not ticket:
            return
        with self.redis.pipeline() as pipe:
            for queue in self.queues.values():
                pipe.lrem(queue.key, 0, ticket)
                pipe.lrem(queue.intermediate_queue_key, 0, ticket)
            pipe.execute()
        try:
            Job.fetch(ticket, connection=self.redis, serializer=JSONSerializer).delete()
        except (NoSuchJobError, InvalidJobOperation, ValueError):
            # InvalidJobOperation: its worker has just finished and removed it.
            # ValueError: the execution's own hash has expired before its entry in the registry.
            self.redis.delete(Job.key_for(ticket))

    def sweep_tickets(self) -> int:
        """Have RQ forget what it keeps of tickets that lead nowhere; return how many keys.

        RQ writes to a ticket without asking whether it is still there. Where it was removed just
        before, and the worker dies before it notices, that would stay for ever.
        """
        found = {
            key: match
            for key in self.redis.scan_iter("rq:*", count=1000)
            if (match := _KEY_OF_A_TICKET.fullmatch(key.decode()))
        }
        with self.redis.pipeline(transaction=False) as pipe:
            for key, match in found.items():
                pipe.ttl(key)
                pipe.hget(record_key(match["job"]), "ticket")
            answers = pipe.execute()
            stale = [
                key
                for (key, match), ttl, current in zip(
                    found.items(), answers[::2], answers[1::2], strict=True
                )
                if ttl == -1 and current != match["ticket"].encode()
            ]
            for key in stale:  # not at once: some worker may have begun with it a moment ago
                pipe.expire(key, FORMER_TICKET_TTL)
            pipe.execute()
        return len(stale)

    # Many at once

    def enqueue_many(self, job_ids: Sequence[str]) -> None:
        """Give queued jobs tickets, as `enqueue` does, in few round trips."""
        tickets = {job_id: f"{job_id}-{uuid.uuid4().hex[:12]}" for job_id in job_ids}
        assigned = self.records.assign_tickets(tickets)
        with self.redis.pipeline() as pipe:
            for priority, queue in self.queues.items():
                chosen = [job for job, found in assigned.items() if found and found[1] == priority]
                queue.enqueue_many(
                    [
                        Queue.prepare_data(
                            TASK,
                            args=(job_id,),
                            timeout=-1,
                            result_ttl=0,
                            failure_ttl=TICKET_TTL,
                            description=job_id,
                            job_id=tickets[job_id],
                        )
                        for job_id in chosen
                    ],
                    pipeline=pipe,
                )
            for found in assigned.values():
                if found and found[0]:
                    pipe.expire(Job.key_for(found[0]), FORMER_TICKET_TTL)
            pipe.execute()

    def discard_queued(self, tickets: Sequence[str]) -> None:
        """Remove tickets that wait in a queue, or are over, in one round trip."""
        with self.redis.pipeline(transaction=False) as pipe:
            for ticket in tickets:
                for queue in self.queues.values():
                    pipe.lrem(queue.key, 0, ticket)
                pipe.delete(Job.key_for(ticket))
            pipe.execute()

    def with_inputs(self, job_ids: Sequence[str]) -> Sequence[str]:
        """Return those jobs whose input files have not been removed."""
        with self.redis.pipeline(transaction=False) as pipe:
            for job_id in job_ids:
                pipe.hget(record_key(job_id), "input_bytes")
            known = pipe.execute()
        usable = []
        for job_id, size in zip(job_ids, known, strict=True):
            if size == b"0":
                continue
            if size is None and (record := self.records.get(job_id)) is not None:
                try:  # a record of a version that did not keep account
                    self._check_inputs(record)
                except InputsGone:
                    continue
            usable.append(job_id)
        return usable

    # Keeping order

    def recover(self) -> Recovered:
        """Queue again what was accepted but lost; safe at any time and from any process.

        Jobs whose worker fell silent become queued again (or end, when they were asked to stop or
        were lost too often), and queued jobs without a place in RQ get one.
        """
        settings = self.settings
        outcomes = self.records.expire_leases(
            grace=2 * settings.heartbeat_seconds,
            max_attempts=settings.max_attempts,
            problem=problem_document(WorkerLost(settings.max_attempts)),
        )
        for job_id in outcomes:
            self.discard_ticket(self.records.ticket(job_id))
        silent = [job_id for job_id, outcome in outcomes.items() if outcome == "queued"]
        for job_id in silent:
            log.warning("worker lost, job queued again", job=job_id)
            self.enqueue(job_id, first=True)
        unticketed: Sequence[str] = ()
        if self.redis.set(
            f"{PREFIX}:looking", 1, nx=True, px=int(settings.lost_ticket_seconds * 250)
        ):
            lists = [queue.key for queue in self.queues.values()]
            unticketed = self.records.without_ticket(settings.lost_ticket_seconds, lists)
            for job_id in unticketed:
                log.warning("ticket lost, job queued again", job=job_id)
                self.enqueue(job_id, first=True)
        return Recovered(
            requeued=(*silent, *unticketed),
            failed=tuple(j for j, outcome in outcomes.items() if outcome == "failed"),
            cancelled=tuple(j for j, outcome in outcomes.items() if outcome == "cancelled"),
        )
