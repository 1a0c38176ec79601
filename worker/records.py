"""Job records: what is known of a job, and the atomic steps that change it.

A record is a hash in Redis; `transitions.lua` documents all keys and is the only code that writes
them. The record is the truth about a job: RQ merely carries its id to some worker.
"""

from __future__ import annotations

import dataclasses
import json
import re
import time
import uuid
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast, get_args

from smsr.progress import Progress
from worker import counters
from worker.connections import server_time

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from redis import Redis

PREFIX = "smsr"
"""First part of every key."""

Priority: TypeAlias = Literal["high", "normal", "low"]
PRIORITIES: tuple[Priority, ...] = get_args(Priority)
"""In the order in which workers serve them."""

Status: TypeAlias = Literal["queued", "running", "succeeded", "failed", "cancelled"]
STATUSES: tuple[Status, ...] = get_args(Status)
FINAL: tuple[Status, ...] = ("succeeded", "failed", "cancelled")

_DOCUMENTS = ("options", "inputs", "progress", "metrics", "timings", "problem", "webhook_state")
_OPTIONAL = (
    *("name", "batch", "priority", "ttl", "digest", "frames", "points", "webhook"),
    *("request", "trace"),
)
_NO_STAGES = ("queued", "total")
_PAGE_LIMIT = 1000
_SCRIPT = counters.LUA + (
    resources.files("worker").joinpath("transitions.lua").read_text(encoding="utf-8")
)
_WORKERS = f"{PREFIX}:workers"
"""Sorted set of the names of worker processes by their last sign of life."""


class JobExists(Exception):
    """There is a job of this id already."""


class KeyTaken(Exception):
    """The key of idempotency belongs to another submission."""


class JobActive(Exception):
    """The job is queued or running, and the step needs one that has ended."""


class TooManyJobs(Exception):
    """The owner has as many queued and running jobs as it may."""


class TooManyBytes(Exception):
    """The owner stores as much as it may."""


@dataclass(frozen=True, slots=True)
class Allowance:
    """What an owner may have at a time; None for any number.

    Attributes
    ----------
    jobs : int or None
        Queued and running jobs.
    bytes : int or None
        Inputs, uploads under way and results, together.
    """

    jobs: int | None = None
    bytes: int | None = None


ANY = Allowance()
"""No limits."""


class Verdict(StrEnum):
    """Whether an attempt may go on.

    CANCELLED: it was asked to stop. LOST: the job was given to another attempt or has ended.
    GONE: the job was deleted.
    """

    OK = "ok"
    CANCELLED = "cancelled"
    LOST = "lost"
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class InputFile:
    """An uploaded file: its object, what the client called it, and what was counted."""

    key: str
    name: str
    bytes: int
    sha256: str
    content_type: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRecord:
    """All that is known of a job; times are Unix seconds.

    Attributes
    ----------
    id : str
        32 hexadecimal digits.
    status : {'queued', 'running', 'succeeded', 'failed', 'cancelled'}
    created_at, queued_at, started_at, finished_at, expires_at : float or None
        `queued_at` is when it was last queued, which a retry or a lost worker does again;
        `started_at` is that of the current attempt.
    options : dict
        Fields of `worker.options.JobOptions`.
    inputs : dict of str to InputFile
        By role: 'measurements', 'ground_truth', 'faces'.
    name, owner : str or None
        A name for people; whose job it is (listings can be restricted to an owner).
    batch : str or None
        Label of the batch that it belongs to.
    priority : {'high', 'normal', 'low'}
    ttl : float or None
        Seconds to keep it once it has ended, 0 for ever; None for the time that holds for all.
    digest : str or None
        Equal for jobs that have equal results; None for a job that shares none.
    reused_from : str or None
        Id of the job that made the result, where this one took it over.
    frames, points : int or None
        T and N, as soon as they are known.
    attempt : int
        Number of starts, and the fencing token of the current one.
    lost_attempts : int
        How many of them ended with their worker.
    progress : Progress or None
    result_prefix : str or None
        Where the objects of the result lie; only ever set together with 'succeeded'.
    metrics : dict or None
        Error against the ground truth, when one was given.
    timings : dict of str to float
        Seconds: queued, each stage, total.
    problem : dict or None
        RFC 9457 problem document (without instance) of a failed job.
    cancel_requested : bool
    worker : str or None
        Name of the worker that runs it.
    version : int
        Grows with every visible change.
    webhook : str or None
        Address that is told when the job ends.
    webhook_state : dict or None
        How that stands: 'state', 'attempts' and what else `outbox.lua` notes.
    request : str or None
        Id of the request that submitted it, which is in the logs of the API and of the workers.
    trace : str or None
        Span of the submission, as a ``traceparent`` (W3C Trace Context).
    """

    id: str
    status: Status
    created_at: float
    options: Mapping[str, Any]
    inputs: Mapping[str, InputFile]
    name: str | None = None
    owner: str | None = None
    batch: str | None = None
    priority: Priority = "normal"
    ttl: float | None = None
    digest: str | None = None
    reused_from: str | None = None
    frames: int | None = None
    points: int | None = None
    attempt: int = 0
    lost_attempts: int = 0
    started_at: float | None = None
    finished_at: float | None = None
    expires_at: float | None = None
    progress: Progress | None = None
    result_prefix: str | None = None
    metrics: Mapping[str, Any] | None = None
    timings: Mapping[str, float] = field(default_factory=dict)
    problem: Mapping[str, Any] | None = None
    cancel_requested: bool = False
    worker: str | None = None
    version: int = 0
    webhook: str | None = None
    webhook_state: Mapping[str, Any] | None = None
    queued_at: float | None = None
    request: str | None = None
    trace: str | None = None

    @classmethod
    def new(
        cls,
        job_id: str | None = None,
        *,
        options: Mapping[str, Any],
        inputs: Mapping[str, InputFile],
        name: str | None = None,
        owner: str | None = None,
        batch: str | None = None,
        priority: Priority = "normal",
        ttl: float | None = None,
        digest: str | None = None,
        frames: int | None = None,
        points: int | None = None,
        webhook: str | None = None,
        request: str | None = None,
        trace: str | None = None,
    ) -> JobRecord:
        """Return the record of a job to submit; Redis stamps its time of creation."""
        return cls(
            id=job_id or new_job_id(),
            status="queued",
            created_at=time.time(),
            options=options,
            inputs=inputs,
            name=name,
            owner=owner,
            batch=batch,
            priority=priority,
            ttl=ttl,
            digest=digest,
            frames=frames,
            points=points,
            webhook=webhook,
            request=request,
            trace=trace,
        )

    @property
    def final(self) -> bool:
        """Whether the job has ended."""
        return self.status in FINAL


@dataclass(frozen=True, slots=True)
class Page:
    """A part of a listing, and where the next part begins."""

    records: tuple[JobRecord, ...]
    next_cursor: str | None


@dataclass(frozen=True, slots=True)
class IdempotencyKey:
    """A key under which a submission makes one job, however often it is sent.

    Attributes
    ----------
    name : str
        Of the key in Redis; it contains whose key it is.
    fingerprint : str
        Tells submissions apart.
    seconds : float
        How long the key is kept.
    """

    name: str
    fingerprint: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Claim:
    """How a claim to a key of idempotency went.

    Attributes
    ----------
    state : {'ok', 'busy', 'bound'}
        'busy': another submission holds the claim; 'bound': it has become a job.
    seconds : float
        Of a busy one: after which it lapses, unless it is renewed.
    job, fingerprint : str
        Of a bound one; the job may have been deleted.
    """

    state: Literal["ok", "busy", "bound"]
    seconds: float = 0.0
    job: str = ""
    fingerprint: str = ""


@dataclass(frozen=True, slots=True)
class Survey:
    """The whole queue at one moment.

    Attributes
    ----------
    jobs : dict of str to int
        Records by status.
    queued : dict of str to int
        Queued ones by priority.
    workers : int
        Worker processes that live.
    counters : Counters
    """

    jobs: Mapping[Status, int]
    queued: Mapping[Priority, int]
    workers: int
    counters: counters.Counters


@dataclass(frozen=True, slots=True)
class Hold:
    """What a worker learns when it renews its lease on a job.

    Attributes
    ----------
    state : {'held', 'queued', 'lost', 'gone'}
        'held' by this worker; still or again 'queued'; 'lost' to another worker or ended; deleted.
    attempt : int
    running_seconds : float
        Since the attempt began.
    cancel_seconds : float or None
        Since the job was asked to stop, None when it was not.
    stage : str
        Last reported stage, empty before the first report.
    """

    state: Literal["held", "queued", "lost", "gone"]
    attempt: int = 0
    running_seconds: float = 0.0
    cancel_seconds: float | None = None
    stage: str = ""


def new_job_id() -> str:
    """Return an id that nobody can guess."""
    return uuid.uuid4().hex


def upload_prefix(job_id: str) -> str:
    """Return the prefix of a job's inputs."""
    return f"uploads/{job_id}/"


def upload_key(job_id: str, role: str) -> str:
    """Return the object key of one input."""
    return upload_prefix(job_id) + role


def results_prefix(job_id: str) -> str:
    """Return the prefix of the results of all attempts of a job."""
    return f"results/{job_id}/"


def result_prefix(job_id: str, attempt: int) -> str:
    """Return the prefix of the results of one attempt."""
    return f"{results_prefix(job_id)}{attempt}/"


def record_key(job_id: str) -> str:
    """Return the key of a record."""
    return f"{PREFIX}:job:{job_id}"


def changed_channel(job_id: str) -> str:
    """Return the channel on which a job's changes are announced."""
    return f"{PREFIX}:changed:{job_id}"


class RecordStore:
    """Records in Redis.

    Parameters
    ----------
    redis : Redis
        A client that does not decode answers.
    result_ttl : float
        Seconds a finished job is kept; 0 keeps it for ever.
    """

    def __init__(self, redis: Redis, *, result_ttl: float = 0) -> None:
        self.redis = redis
        self.result_ttl = result_ttl
        self._script = redis.register_script(_SCRIPT)

    def _step(self, step: str, job_id: str, *arguments: str | float) -> Any:
        return self._script(keys=[PREFIX], args=[step, job_id, *arguments])

    # Reading

    def get(self, job_id: str) -> JobRecord | None:
        """Return a record, or None when there is no such job."""
        return decode(job_id, cast("dict[bytes, bytes]", self.redis.hgetall(record_key(job_id))))

    def list(
        self,
        status: Status | None = None,
        cursor: str | None = None,
        limit: int = 50,
        *,
        owner: str | None = None,
        batch: str | None = None,
    ) -> Page:
        """Return records, newest first.

        Pages are stable: a job appears on the page that its time of creation says, whatever was
        submitted or deleted in between.

        Raises
        ------
        ValueError
            The cursor is none that a page gave, or the status does not exist.
        """
        if status is not None and status not in STATUSES:
            raise ValueError(f"there is no status {status!r}; there are {', '.join(STATUSES)}")
        index = index_key(status, owner, batch)
        ids, following = self.page(index, cursor, limit)
        with self.redis.pipeline(transaction=False) as pipe:
            for job_id in ids:
                pipe.hgetall(record_key(job_id))
            hashes = pipe.execute()
        records = [decode(job_id, found) for job_id, found in zip(ids, hashes, strict=True)]
        return Page(tuple(r for r in records if r is not None), following)

    def page(self, key: str, cursor: str | None, limit: int) -> tuple[Sequence[str], str | None]:
        """Return some members of a sorted set of times, latest first, and the next cursor.

        Raises
        ------
        ValueError
            The cursor is none that a page gave.
        """
        limit = max(1, min(limit, _PAGE_LIMIT))
        members, more = self._after(key, _parse_cursor(cursor), limit)
        following = f"{members[-1][1]:.6f}:{members[-1][0]}" if more and members else None
        return [member for member, _ in members], following

    def _after(
        self, index: str, after: tuple[float, str] | None, limit: int
    ) -> tuple[Sequence[tuple[str, float]], bool]:
        """Return up to `limit` pairs of member and time, and whether there are more."""
        start = "+inf" if after is None else f"{after[0]:.6f}"
        found: Sequence[tuple[str, float]] = ()
        offset = 0
        while len(found) <= limit:
            # Redis has members of one time in reverse order: those up to the cursor's are skipped.
            chunk = cast(
                "list[tuple[bytes, float]]",
                self.redis.zrevrangebyscore(
                    index, start, "-inf", start=offset, num=limit + 1, withscores=True
                ),
            )
            pairs = [(member.decode(), score) for member, score in chunk]
            found = (*found, *(p for p in pairs if after is None or (p[1], p[0]) < after))
            offset += len(pairs)
            if len(pairs) <= limit:
                break
        return found[:limit], len(found) > limit

    def count(self, owner: str | None = None) -> dict[Status, int]:
        """Return the number of jobs of each status."""
        with self.redis.pipeline() as pipe:
            for status in STATUSES:
                pipe.zcard(index_key(status, owner))
            return dict(zip(STATUSES, pipe.execute(), strict=True))

    def survey(self, seconds: float) -> Survey:
        """Return all that is counted, in one round trip.

        Parameters
        ----------
        seconds : float
            Workers that gave no sign of life for longer are dead.
        """
        with self.redis.pipeline() as pipe:
            pipe.time()
            pipe.zrange(_WORKERS, 0, -1, withscores=True)
            pipe.hgetall(f"{PREFIX}:counters")
            for status in STATUSES:
                pipe.zcard(index_key(status))
            for priority in PRIORITIES:
                pipe.zcard(f"{index_key('queued')}:{priority}")
            (now, microseconds), workers, counted, *counts = pipe.execute()
        since = now + microseconds / 1e6 - seconds
        return Survey(
            dict(zip(STATUSES, counts, strict=False)),
            dict(zip(PRIORITIES, counts[len(STATUSES) :], strict=True)),
            sum(seen >= since for _, seen in workers),
            counters.decode(counted),
        )

    def ticket(self, job_id: str) -> str:
        """Return the RQ job that carries a job, '' for none."""
        ticket = cast("bytes | None", self.redis.hget(record_key(job_id), "ticket"))
        return ticket.decode() if ticket else ""

    def expired(self, limit: int = 100) -> Sequence[str]:
        """Return ids of jobs whose time to live has passed."""
        due = self.redis.zrangebyscore(
            f"{PREFIX}:expiry", "-inf", server_time(self.redis), start=0, num=limit
        )
        return [job_id.decode() for job_id in cast("list[bytes]", due)]

    def garbage(self, limit: int = 100) -> Sequence[str]:
        """Return storage prefixes that are to be removed now."""
        due = self.redis.zrangebyscore(
            f"{PREFIX}:garbage", "-inf", server_time(self.redis), start=0, num=limit
        )
        return [prefix.decode() for prefix in cast("list[bytes]", due)]

    def count_removed(self, kind: str, count: int) -> None:
        """Count what the maintenance has removed, by kind (`worker.counters.REMOVED`)."""
        self.redis.hincrby(f"{PREFIX}:counters", f"removed:{kind}", count)

    def held(self, prefix: str) -> bool:
        """Whether jobs hold the result under this storage prefix that another job made."""
        return bool(self.redis.exists(f"{PREFIX}:holders:{prefix}"))

    def forget_garbage(self, prefix: str) -> None:
        """Note that nothing is left under a storage prefix."""
        self.redis.zrem(f"{PREFIX}:garbage", prefix)

    def put_off_garbage(self, prefix: str, seconds: float) -> None:
        """Have a storage prefix that could not be emptied looked at again after some seconds."""
        self.redis.zadd(f"{PREFIX}:garbage", {prefix: server_time(self.redis) + seconds}, xx=True)

    def sign_of_life(self, worker: str, forget_seconds: float = 3600) -> None:
        """Note that a worker process lives."""
        now = server_time(self.redis)
        with self.redis.pipeline() as pipe:
            pipe.zadd(_WORKERS, {worker: now})
            pipe.zremrangebyscore(_WORKERS, "-inf", now - forget_seconds)
            pipe.execute()

    def sign_off(self, worker: str) -> None:
        """Note that a worker process ends."""
        self.redis.zrem(_WORKERS, worker)

    def workers_since(self, seconds: float) -> int:
        """Return the number of worker processes that gave a sign of life since then."""
        return self.redis.zcount(_WORKERS, server_time(self.redis) - seconds, "+inf")

    # What owners take

    def active(self, owner: str) -> int:
        """Return the number of queued and running jobs of an owner."""
        counts = self.count(owner)
        return counts["queued"] + counts["running"]

    def stored_bytes(self, owner: str) -> int:
        """Return the bytes of an owner's inputs, results and uploads under way."""
        return int(cast("bytes | None", self.redis.hget(f"{PREFIX}:stored", owner)) or 0)

    def hold(
        self, upload_id: str, owner: str, size: int, *, most: int | None, seconds: float
    ) -> None:
        """Count an upload under way as stored, until it is dropped, lapses or becomes a job.

        Doing it again for the same upload sets its bytes and its time anew.

        Parameters
        ----------
        upload_id : str
            That of the upload, or of the job that it will be.
        owner : str
        size : int
            Bytes of the upload: in all where that is known, else so far.
        most : int or None
            Bytes that the owner may store.
        seconds : float
            How long its files will stay when nothing more is heard of it.

        Raises
        ------
        TooManyBytes
            It does not fit; what was held for it before stays held.
        """
        limit = "" if most is None else most
        if self._step("hold", upload_id, owner, size, limit, seconds) != b"ok":
            raise TooManyBytes(owner)

    def drop_hold(self, upload_id: str) -> None:
        """Count an upload no longer: its files are gone."""
        self._step("drop_hold", upload_id)

    def lapse_holds(self) -> int:
        """Drop the holds whose time has passed, up to a hundred; return how many there were."""
        return int(self._step("lapse", "*"))

    # The client's steps

    def claim(self, name: str, job_id: str, lease: float) -> Claim:
        """Claim a key of idempotency for a submission on its way, or learn who has it.

        Doing it again renews the claim.

        Parameters
        ----------
        name : str
            See `IdempotencyKey`.
        job_id : str
            Id that the job of this submission will have.
        lease : float
            Seconds after which the claim lapses.
        """
        state, *rest = self._step("claim", job_id, name, lease)
        match state:
            case b"busy":
                return Claim("busy", seconds=float(rest[0]))
            case b"bound":
                return Claim("bound", job=rest[0].decode(), fingerprint=rest[1].decode())
        return Claim("ok")

    def unclaim(self, name: str, job_id: str) -> None:
        """Give up a claim: the submission was refused or broke off."""
        self._step("unclaim", job_id, name)

    def create(
        self,
        record: JobRecord,
        allowance: Allowance = ANY,
        uploads: Sequence[str] = (),
        *,
        reuse: bool = False,
        key: IdempotencyKey | None = None,
    ) -> None:
        """Store a new record as queued, or as succeeded where there is a result for it.

        Parameters
        ----------
        record : JobRecord
        allowance : Allowance
            What its owner may have, this job included.
        uploads : sequence of str
            Ids of uploads whose files became those of the job; they are held no longer, nor is an
            upload of the job's own id.
        reuse : bool
            Take the result of a job with the same digest, where there is one.
        key : IdempotencyKey, optional
            Bound to the job in the same step.

        Raises
        ------
        JobExists
            There is a record of this id.
        TooManyJobs, TooManyBytes
            The owner may not have another one.
        KeyTaken
            The key of idempotency belongs to another job, or another submission claims it.
        """
        fields: dict[str, str | int] = {
            "options": _encode(record.options),
            "inputs": _encode({r: dataclasses.asdict(f) for r, f in record.inputs.items()}),
        }
        for name in _OPTIONAL:
            value = getattr(record, name)
            if value is not None:
                fields[name] = value
        flat = [part for item in fields.items() for part in item]
        owner = record.owner or ""
        terms = {
            "most_jobs": allowance.jobs,
            "most_bytes": allowance.bytes,
            "bytes": sum(file.bytes for file in record.inputs.values()),
            "uploads": [record.id, *uploads],
            "reuse": reuse,
            "ttl": self.result_ttl,
            "key": None if key is None else dataclasses.asdict(key),
        }
        given = _encode({name: value for name, value in terms.items() if value is not None})
        match self._step("create", record.id, owner, uuid.uuid4().hex, given, *flat):
            case b"exists":
                raise JobExists(record.id)
            case b"taken":
                raise KeyTaken(record.id)
            case b"busy":
                raise TooManyJobs(owner)
            case b"full":
                raise TooManyBytes(owner)

    def assign_ticket(self, job_id: str, ticket: str) -> tuple[str, Priority] | None:
        """Note the RQ job that carries this job; return the one it replaces and the priority.

        '' for none replaced; None when the job is not queued (any more).
        """
        answer = self._step("ticket", job_id, ticket)
        if answer is None:
            return None
        former, priority = answer
        return former.decode(), priority.decode()

    def cancel(
        self, job_id: str
    ) -> tuple[Literal["cancelled", "requested", "finished", "gone"], str]:
        """Cancel a queued job at once (and return its ticket) or ask a running one to stop."""
        outcome, *ticket = self._step("cancel", job_id, self.result_ttl)
        return outcome.decode(), ticket[0].decode() if ticket else ""

    def retry(
        self, job_id: str, allowance: Allowance = ANY
    ) -> Literal["ok", "active", "busy", "gone"]:
        """Make a finished job queued again; 'busy' where its owner has too many active ones."""
        most = "" if allowance.jobs is None else allowance.jobs
        return cast("Literal['ok']", self._step("retry", job_id, most).decode())

    def keep(self, job_id: str, ttl: float | None) -> bool:
        """Have a job kept for some seconds after its end; False when there is no such job.

        Parameters
        ----------
        job_id : str
        ttl : float or None
            0 keeps it for ever; None for the time that holds for all.
        """
        own = "" if ttl is None else ttl
        return bool(self._step("keep", job_id, own, self.result_ttl) == b"ok")

    def forget_inputs(self, job_id: str) -> None:
        """Note that the files of a job's inputs are gone."""
        self._step("forget_inputs", job_id)

    def delete(
        self, job_id: str, *, only_expired: bool = False, again: float = 0
    ) -> tuple[Literal["ok", "gone", "kept"], str, Sequence[str]]:
        """Remove a record and put its objects on the list of garbage.

        Returns what came of it, the job's ticket ('' for none) and the storage prefixes of which
        nothing is needed any more: results that another job has taken over stay.

        Parameters
        ----------
        job_id : str
        only_expired : bool
            Keep it unless its time to live has passed.
        again : float
            Seconds until its objects are removed by maintenance: the caller removes them at once,
            and a worker that did not notice yet may write some more.
        """
        answer = self._step("delete", job_id, str(int(only_expired)), again)
        outcome, ticket, *unwanted = [part.decode() for part in answer]
        return outcome, ticket, unwanted

    # The same for many jobs, in one round trip

    def cancel_many(self, job_ids: Sequence[str]) -> Sequence[tuple[str, str]]:
        """Cancel jobs; return outcome and ticket of each, as `cancel` does."""
        return [_outcome(answer) for answer in self._steps("cancel", job_ids, self.result_ttl)]

    def retry_many(self, job_ids: Sequence[str], allowance: Allowance = ANY) -> Sequence[str]:
        """Make finished jobs queued again; return the outcome of each, as `retry` does."""
        most = "" if allowance.jobs is None else allowance.jobs
        return [answer.decode() for answer in self._steps("retry", job_ids, most)]

    def delete_many(self, job_ids: Sequence[str]) -> Sequence[tuple[str, str]]:
        """Remove records, and put their objects on the list of garbage; as `cancel_many`."""
        return [_outcome(answer) for answer in self._steps("delete", job_ids, "0", 0)]

    def assign_tickets(self, tickets: Mapping[str, str]) -> dict[str, tuple[str, Priority] | None]:
        """Note the RQ jobs that carry some jobs, as `assign_ticket` does; return by job."""
        with self.redis.pipeline(transaction=False) as pipe:
            for job_id, ticket in tickets.items():
                self._script(keys=[PREFIX], args=["ticket", job_id, ticket], client=pipe)
            answers = pipe.execute()
        return {
            job_id: None if answer is None else (answer[0].decode(), answer[1].decode())
            for job_id, answer in zip(tickets, answers, strict=True)
        }

    def _steps(self, step: str, job_ids: Sequence[str], *arguments: str | float) -> Sequence[Any]:
        with self.redis.pipeline(transaction=False) as pipe:
            for job_id in job_ids:
                self._script(keys=[PREFIX], args=[step, job_id, *arguments], client=pipe)
            return pipe.execute()

    # The worker's steps

    def begin_attempt(self, job_id: str, *, worker: str, ticket: str, lease: float) -> int | None:
        """Start a queued job; return its attempt, or None when there is nothing to do.

        Parameters
        ----------
        job_id : str
        worker : str
            Name of the worker process, which will renew the lease.
        ticket : str
            RQ job that led here; beginning again with the same ticket is the same attempt.
        lease : float
            Seconds for which the job is held.
        """
        outcome, *attempt = self._step("begin", job_id, worker, ticket, lease)
        return int(attempt[0]) if outcome == b"ok" else None

    def renew(self, job_id: str, *, worker: str, lease: float) -> Hold:
        """Hold a job for another while and learn how it stands."""
        state, *rest = self._step("renew", job_id, worker, lease)
        if not rest:
            return Hold(state.decode())
        attempt, running, cancel, progress = rest
        return Hold(
            state=state.decode(),
            attempt=int(attempt),
            running_seconds=float(running),
            cancel_seconds=float(cancel) if float(cancel) >= 0 else None,
            stage=json.loads(progress)["stage"] if progress else "",
        )

    def report_progress(
        self,
        job_id: str,
        attempt: int,
        progress: Progress,
        *,
        lease: float,
        frames: int | None = None,
        points: int | None = None,
    ) -> Verdict:
        """Show how far an attempt is; this renews its lease too."""
        size = ("", "") if frames is None or points is None else (frames, points)
        document = _encode(dataclasses.asdict(progress))
        return self._verdict("progress", job_id, attempt, document, lease, *size)

    def publish(
        self,
        job_id: str,
        attempt: int,
        *,
        frames: int,
        points: int,
        timings: Mapping[str, float],
        metrics: Mapping[str, Any] | None = None,
        result_bytes: int = 0,
    ) -> Verdict:
        """Make the results of an attempt those of the job, in one step."""
        fields: list[str | int] = ["frames", frames, "points", points, "timings", _encode(timings)]
        fields += ["progress", _encode(dataclasses.asdict(Progress("done", 1.0)))]
        if metrics is not None:
            fields += ["metrics", _encode(metrics)]
            if "e3d" in metrics:
                fields += ["e3d", metrics["e3d"]]
        stages = {name: s for name, s in timings.items() if name not in _NO_STAGES}
        return self._verdict(
            "publish",
            job_id,
            attempt,
            result_prefix(job_id, attempt),
            result_bytes,
            self.result_ttl,
            _encode(stages),
            *fields,
        )

    def fail(self, job_id: str, attempt: int, problem: Mapping[str, Any]) -> Verdict:
        """End a job with a problem document."""
        return self._verdict(
            "fail", job_id, attempt, _encode(problem), _slug(problem), self.result_ttl
        )

    def stop(self, job_id: str, attempt: int) -> Verdict:
        """End a job that was asked to stop; CANCELLED when it has ended so."""
        return self._verdict("stop", job_id, attempt, self.result_ttl)

    def _verdict(self, step: str, job_id: str, attempt: int, *arguments: str | float) -> Verdict:
        return Verdict(self._step(step, job_id, attempt, *arguments).decode())

    def release(
        self,
        job_id: str,
        holder: str | int,
        *,
        lost: bool,
        max_attempts: int,
        problem: Mapping[str, Any],
    ) -> Literal["queued", "failed", "cancelled", "lost", "gone"]:
        """Take a running job from its worker.

        Parameters
        ----------
        job_id : str
        holder : str or int
            Name of the worker, or the attempt: nothing happens when it does not hold the job.
        lost : bool
            Whether this counts as a lost attempt (a stopping worker's does not).
        max_attempts : int
            Losses after which the job fails with `problem`.
        problem : mapping
        """
        outcome = self._step(
            "release",
            job_id,
            holder,
            int(lost),
            max_attempts,
            _encode(problem),
            _slug(problem),
            self.result_ttl,
        )
        return cast("Literal['queued']", outcome.decode())

    # Recovery

    def expire_leases(
        self, *, grace: float, max_attempts: int, problem: Mapping[str, Any]
    ) -> dict[str, str]:
        """Take jobs from workers that fell silent; return what became of each.

        A job is taken at the second look, `grace` seconds or more after the first one that found
        its lease to have run out.
        """
        ending = (_encode(problem), _slug(problem), self.result_ttl)
        flat = self._step("expire", "*", grace, max_attempts, *ending)
        texts = [part.decode() for part in flat]
        return dict(zip(texts[::2], texts[1::2], strict=True))

    def without_ticket(self, grace: float, lists: Sequence[str]) -> Sequence[str]:
        """Return queued jobs whose ticket is in none of the RQ lists, for `grace` seconds now."""
        return [job_id.decode() for job_id in self._step("unticketed", "*", grace, *lists)]


def _outcome(answer: Sequence[bytes]) -> tuple[str, str]:
    """Return outcome and ticket, where there is one, of a step."""
    outcome, ticket, *_ = (*answer, b"")
    return outcome.decode(), ticket.decode()


def decode(job_id: str, found: Mapping[bytes, bytes]) -> JobRecord | None:
    """Build a record from its hash; None from an empty one."""
    if not found:
        return None
    texts = {key.decode(): value.decode() for key, value in found.items()}
    documents = {name: json.loads(texts[name]) for name in _DOCUMENTS if name in texts}

    def number(name: str) -> float | None:
        return float(texts[name]) if name in texts else None

    def integer(name: str) -> int | None:
        return int(texts[name]) if name in texts else None

    progress = documents.get("progress")
    return JobRecord(
        id=job_id,
        status=cast("Status", texts["status"]),
        created_at=float(texts["created_at"]),
        options=documents["options"],
        inputs={role: InputFile(**file) for role, file in documents["inputs"].items()},
        name=texts.get("name"),
        owner=texts.get("owner") or None,
        batch=texts.get("batch"),
        priority=cast("Priority", texts.get("priority", "normal")),
        ttl=number("ttl"),
        digest=texts.get("digest"),
        reused_from=texts.get("reused_from"),
        frames=integer("frames"),
        points=integer("points"),
        attempt=int(texts["attempt"]),
        lost_attempts=int(texts["lost_attempts"]),
        started_at=number("started_at"),
        finished_at=number("finished_at"),
        expires_at=number("expires_at"),
        progress=Progress(**progress) if progress else None,
        result_prefix=texts.get("result_prefix"),
        metrics=documents.get("metrics"),
        timings=documents.get("timings", {}),
        problem=documents.get("problem"),
        cancel_requested="cancel_requested_at" in texts or texts["status"] == "cancelled",
        worker=texts.get("worker"),
        version=int(texts["version"]),
        webhook=texts.get("webhook"),
        webhook_state=documents.get("webhook_state"),
        queued_at=number("queued_at"),
        request=texts.get("request"),
        trace=texts.get("trace"),
    )


def _encode(document: object) -> str:
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def _slug(problem: Mapping[str, Any]) -> str:
    return str(problem.get("type", "unknown")).rpartition("/")[2]


def index_key(
    status: Status | None = None, owner: str | None = None, batch: str | None = None
) -> str:
    """Return the key of the sorted set of jobs, of all or of a status, an owner, a batch."""
    return f"{PREFIX}:jobs{scope_of(owner, batch)}" + (f":{status}" if status else "")


def scope_of(owner: str | None, batch: str | None = None) -> str:
    """Return the ending of the names of keys that are kept for an owner, a batch, or all."""
    return (f"@{owner}" if owner else "") + (f"#{batch}" if batch else "")


def _parse_cursor(cursor: str | None) -> tuple[float, str] | None:
    if cursor is None:
        return None
    created, _, job_id = cursor.partition(":")
    if not re.fullmatch(r"\d+\.\d{6}:.+", cursor):
        raise ValueError(f"{cursor!r} is no cursor of a listing")
    return float(created), job_id
