"""Batches: jobs that share a label, looked at and dealt with together.

The indices are kept by `transitions.lua`, so that a summary costs one round trip and some numbers
per job that has succeeded, and no record is read. What is done to a batch is done to the jobs that
it has at that moment, each by the same atomic step as for one job, many steps to a round trip.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from worker.records import (
    ANY,
    PREFIX,
    STATUSES,
    Allowance,
    RecordStore,
    Status,
    index_key,
    record_key,
    scope_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from redis import Redis

    from worker.queue import JobQueue

_AT_ONCE = 200
"""Steps to a round trip: a server that is busy with them keeps nobody waiting for long."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How some numbers lie."""

    count: int
    total: float
    mean: float
    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread | None:
        """Return that of some numbers in ascending order, None of none."""
        if not values:
            return None
        total = sum(values)
        return cls(
            count=len(values),
            total=total,
            mean=total / len(values),
            median=statistics.median(values),
            least=values[0],
            most=values[-1],
        )


@dataclass(frozen=True, slots=True)
class BatchCounts:
    """A batch in short.

    Attributes
    ----------
    label : str
    jobs : dict of str to int
        By status.
    created_at, latest_at : float
        When its first and its latest job were submitted, of those that are still there.
    """

    label: str
    jobs: Mapping[Status, int]
    created_at: float
    latest_at: float

    @property
    def total(self) -> int:
        """Number of jobs."""
        return sum(self.jobs.values())


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch and what became of it so far.

    Attributes
    ----------
    counts : BatchCounts
    progress : float
        Mean over all jobs of the part of their run that is done; ended jobs count as done.
    finished_at : float or None
        When the last of them ended, once all have.
    e3d : Spread or None
        Of the jobs that succeeded and had a ground truth.
    seconds : Spread or None
        Run times of those that succeeded, from their last start.
    """

    counts: BatchCounts
    progress: float
    finished_at: float | None
    e3d: Spread | None
    seconds: Spread | None


@dataclass(frozen=True, slots=True)
class Retried:
    """What became of the attempt to run jobs again, as numbers of jobs.

    Attributes
    ----------
    queued : int
    inputs_gone : int
        They failed for their input, whose files were removed then.
    refused : int
        Their owner may not have more active jobs.
    """

    queued: int = 0
    inputs_gone: int = 0
    refused: int = 0


def labels(
    records: RecordStore, owner: str | None, cursor: str | None, limit: int
) -> tuple[Sequence[BatchCounts], str | None]:
    """Return some batches, those with the latest jobs first, and the next cursor.

    Raises
    ------
    ValueError
        The cursor is none that a page gave.
    """
    found, following = records.page(f"{PREFIX}:batches{scope_of(owner)}", cursor, limit)
    with records.redis.pipeline() as pipe:
        for label in found:
            _ask_counts(pipe, owner, label)
        answers = pipe.execute()
    size = len(STATUSES) + 2
    counts = (_counts(label, answers[k * size : (k + 1) * size]) for k, label in enumerate(found))
    return [found for found in counts if found is not None], following


def get(records: RecordStore, owner: str | None, label: str) -> Batch | None:
    """Return a batch, None where an owner has no job of this label."""
    scope = scope_of(owner, label)
    with records.redis.pipeline() as pipe:
        _ask_counts(pipe, owner, label)
        pipe.zrange(index_key("running", owner, label), 0, -1)
        pipe.zrange(f"{PREFIX}:ended{scope}", -1, -1, withscores=True)
        pipe.zrange(f"{PREFIX}:e3d{scope}", 0, -1, withscores=True)
        pipe.zrange(f"{PREFIX}:seconds{scope}", 0, -1, withscores=True)
        *answers, running, last, e3d, seconds = pipe.execute()
    counts = _counts(label, answers)
    if counts is None:
        return None
    active = counts.jobs["queued"] + counts.jobs["running"]
    done = counts.total - active + _progress(records.redis, running)
    return Batch(
        counts=counts,
        progress=min(1.0, done / counts.total),
        finished_at=last[0][1] if last and not active else None,
        e3d=Spread.of([score for _, score in e3d]),
        seconds=Spread.of([score for _, score in seconds]),
    )


def _ask_counts(pipe: Redis, owner: str | None, label: str) -> None:
    for status in STATUSES:
        pipe.zcard(index_key(status, owner, label))
    index = index_key(None, owner, label)
    pipe.zrange(index, 0, 0, withscores=True)
    pipe.zrange(index, -1, -1, withscores=True)


def _counts(label: str, answers: Sequence[object]) -> BatchCounts | None:
    *counts, first, last = answers
    if not first or not last:  # deleted in between
        return None
    return BatchCounts(
        label=label,
        jobs=dict(zip(STATUSES, cast("list[int]", counts), strict=True)),
        created_at=cast("list[tuple[bytes, float]]", first)[0][1],
        latest_at=cast("list[tuple[bytes, float]]", last)[0][1],
    )


def _progress(redis: Redis, running: Sequence[bytes]) -> float:
    """Return the sum of the fractions that running jobs have reported."""
    with redis.pipeline(transaction=False) as pipe:
        for job_id in running:
            pipe.hget(record_key(job_id.decode()), "progress")
        documents = pipe.execute()
    return sum(float(json.loads(found)["fraction"]) for found in documents if found)


def _ids(records: RecordStore, owner: str | None, label: str, *statuses: Status) -> list[str]:
    with records.redis.pipeline() as pipe:
        for status in statuses:
            pipe.zrange(index_key(status, owner, label), 0, -1)
        return [job_id.decode() for ids in pipe.execute() for job_id in ids]


def _chunks(ids: Sequence[str]) -> Iterator[Sequence[str]]:
    for start in range(0, len(ids), _AT_ONCE):
        yield ids[start : start + _AT_ONCE]


def cancel(queue: JobQueue, owner: str | None, label: str) -> tuple[int, int]:
    """Cancel all jobs that have not ended; return how many were, and how many will stop soon."""
    records = queue.records
    cancelled = asked = 0
    # The queued ones first, or a worker that gets free would begin with one of them.
    for chunk in _chunks(_ids(records, owner, label, "queued", "running")):
        answers = records.cancel_many(chunk)
        queue.discard_queued([ticket for outcome, ticket in answers if outcome == "cancelled"])
        cancelled += sum(outcome == "cancelled" for outcome, _ in answers)
        asked += sum(outcome == "requested" for outcome, _ in answers)
    return cancelled, asked


def retry(queue: JobQueue, owner: str | None, label: str, allowance: Allowance = ANY) -> Retried:
    """Queue all jobs again that failed or were cancelled."""
    records = queue.records
    queued = gone = refused = 0
    for chunk in _chunks(_ids(records, owner, label, "failed", "cancelled")):
        usable = queue.with_inputs(chunk)
        outcomes = records.retry_many(usable, allowance)
        again = [job for job, outcome in zip(usable, outcomes, strict=True) if outcome == "ok"]
        queue.enqueue_many(again)
        queued += len(again)
        gone += len(chunk) - len(usable)
        refused += outcomes.count("busy")
    return Retried(queued, gone, refused)


def delete(queue: JobQueue, owner: str | None, label: str) -> int:
    """Remove all jobs of a batch; return how many. Their files are removed by maintenance."""
    records = queue.records
    removed = 0
    for job_id in _ids(records, owner, label, "running"):
        removed += queue.delete(job_id)
    others = _ids(records, owner, label, *STATUSES)
    for chunk in _chunks(others):
        answers = records.delete_many(chunk)
        queue.discard_queued([ticket for outcome, ticket in answers if outcome == "ok" and ticket])
        removed += sum(outcome == "ok" for outcome, _ in answers)
    return removed
