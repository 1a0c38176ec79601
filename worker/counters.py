"""What is counted of all jobs: how they ended, and how long they waited and ran.

The counts are one hash in Redis, written by `transitions.lua` in the same atomic step that starts
or ends a job. So each is counted once, whichever process takes the step and however often it is
sent, and the counts outlive every process.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

BOUNDS = tuple(
    round(mantissa * 10.0**exponent, 2) for exponent in range(-2, 4) for mantissa in (1, 2, 5)
)
"""Upper bounds, in seconds, of the buckets of every histogram; one more bucket has the rest."""

SIZES = {"small": 1e5, "medium": 1e7, "large": float("inf")}
"""Size classes of jobs: points times frames are fewer than this."""

UNKNOWN_SIZE = "unknown"
"""Class of a job that failed before its size was known."""

REMOVED = ("expired_job", "abandoned_upload", "orphan", "garbage")
"""What the maintenance removes: jobs, uploads, and prefixes of objects without a job."""

_LUA_BOUNDS = ", ".join(f"'{bound:g}'" for bound in BOUNDS)
_LUA_SIZES = ", ".join(
    f"{{'{name}', {'math.huge' if values == float('inf') else values}}}"
    for name, values in SIZES.items()
)
LUA = f"local bounds, sizes = {{{_LUA_BOUNDS}}}, {{{_LUA_SIZES}}} "
"""What `transitions.lua` knows of this; on one line, so that its own keep their numbers."""


@dataclass(slots=True)
class Histogram:
    """Durations, sorted into buckets.

    Attributes
    ----------
    buckets : list of int
        Number of durations up to each of `BOUNDS` and above the one before; the last has those
        above all.
    sum : float
        Seconds of all together.
    """

    buckets: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS) + 1))
    sum: float = 0.0

    @property
    def count(self) -> int:
        """Number of durations."""
        return sum(self.buckets)

    def _add(self, part: str, value: bytes) -> None:
        if part == "sum":
            self.sum = float(value)
        else:
            # Buckets of another version of the program go into the next larger one of this one.
            self.buckets[bisect_left(BOUNDS, float(part))] += int(value)


@dataclass(slots=True)
class Counters:
    """Counts since the queue is there.

    Attributes
    ----------
    ended : dict of str to int
        Ends of jobs by status; a job that is retried ends once more.
    failures : dict of str to int
        Failed ones by the last part of the problem type.
    lost : int
        Attempts that ended with their worker.
    reused : int
        Jobs that took the result of another one; they were not run, and are not in `ended`.
    waits : Histogram
        From being queued to each start.
    runs : dict of str to Histogram
        From the last start to the end, by size class (`SIZES` and `UNKNOWN_SIZE`).
    stages : dict of str to Histogram
        Stages of the jobs that succeeded.
    removed : dict of str to int
        What the maintenance has removed, by kind (`REMOVED`).
    webhooks : dict of str to int
        Attempts to deliver webhooks by how they ended: delivered, failed, given_up.
    """

    ended: dict[str, int] = field(default_factory=dict)
    failures: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    reused: int = 0
    waits: Histogram = field(default_factory=Histogram)
    runs: dict[str, Histogram] = field(default_factory=dict)
    stages: dict[str, Histogram] = field(default_factory=dict)
    webhooks: dict[str, int] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)


def decode(found: Mapping[bytes, bytes]) -> Counters:
    """Read the hash; fields that another version of the program wrote are left out."""
    counters = Counters()
    for key, value in found.items():
        match key.decode().split(":"):
            case ["ended", status]:
                counters.ended[status] = int(value)
            case ["failed", slug]:
                counters.failures[slug] = int(value)
            case ["lost"]:
                counters.lost = int(value)
            case ["reused"]:
                counters.reused = int(value)
            case ["webhook", outcome]:
                counters.webhooks[outcome] = int(value)
            case ["removed", kind]:
                counters.removed[kind] = int(value)
            case ["wait", part]:
                counters.waits._add(part, value)
            case ["run", size, part]:
                counters.runs.setdefault(size, Histogram())._add(part, value)
            case ["stage", stage, part]:
                counters.stages.setdefault(stage, Histogram())._add(part, value)
    return counters
