"""``Idempotency-Key``: a submission that is sent again makes no second job.

A client that got no answer cannot know whether its job was accepted. It names each submission by a
key of its own choice and sends it again under the same key; the service answers with the job that
the first one made. The header is that of draft-ietf-httpapi-idempotency-key-header, and the rest as
it is customary: what was refused is not remembered, keys are kept for a day or more, and an answer
that is a repetition says so in ``Idempotent-Replayed``.

A key is claimed before the body is read; the claim lapses when this process dies. The step that
makes the job binds the key to it, provided the claim is still this submission's.
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import re
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from anyio import CancelScope, to_thread
from redis.exceptions import RedisError

from service.problems import Problem
from worker.records import IdempotencyKey
from worker.storage import StoredObject

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, AsyncIterator

    from service.context import Context
    from worker.records import Claim, JobRecord

REPLAYED = "Idempotent-Replayed"
"""Header of an answer that repeats an earlier one."""

CLAIM_SECONDS = 10.0
"""Silence of a process after which its claims lapse."""

RETRY_SECONDS = 2
"""What ``Retry-After`` says at most while the first submission is on its way."""

_QUOTED = re.compile(r'"((?:[^"\\]|\\["\\])*)"')
_KEY = re.compile(r"[\x21-\x7e](?:[\x20-\x7e]{0,253}[\x21-\x7e])?")


def read_key(header: str) -> str:
    """Return the key in a header: a string of RFC 8941, section 3.3.3, or the same without quotes.

    Raises
    ------
    Problem
        It is empty, longer than 255 characters or not of printable ASCII.
    """
    quoted = _QUOTED.fullmatch(header.strip())
    key = re.sub(r"\\(.)", r"\1", quoted[1]) if quoted else header.strip()
    if not _KEY.fullmatch(key):
        raise Problem(
            "invalid-idempotency-key",
            "The header Idempotency-Key holds 1 to 255 printable ASCII characters.",
        )
    return key


@dataclass(frozen=True, slots=True)
class ClaimedKey:
    """A key that this request holds, or that an earlier submission has bound.

    Attributes
    ----------
    name : str
        Of the key in Redis.
    seconds : float
        How long a bound key is kept.
    claim : Claim
    """

    name: str
    seconds: float
    claim: Claim

    @property
    def bound(self) -> bool:
        """Whether there is a job already."""
        return self.claim.state == "bound"

    def bind(self, fingerprint: str) -> IdempotencyKey:
        """Return what the step that makes the job needs."""
        return IdempotencyKey(self.name, fingerprint, self.seconds)

    async def replay(self, shared: Context, fingerprint: str) -> JobRecord:
        """Return the job of a bound key, as it is now.

        Raises
        ------
        Problem
            The submission is another one, or the job is gone.
        """
        if fingerprint != self.claim.fingerprint:
            raise Problem(
                "idempotency-key-reused",
                "Another submission, with other files, options or settings, was sent under this "
                "Idempotency-Key.",
            )
        record = await shared.feed.get(self.claim.job)
        if record is None:
            raise Problem(
                "submission-gone",
                f"The submission was accepted as job {self.claim.job}, which has been deleted or "
                "has expired.",
                job=self.claim.job,
            )
        return record


@asynccontextmanager
async def claimed(
    shared: Context, header: str | None, job_id: str
) -> AsyncIterator[ClaimedKey | None]:
    """Hold the key of a request, if it has one, while its submission comes in.

    Parameters
    ----------
    shared : Context
    header : str or None
        As it was sent.
    job_id : str
        Id that the job will have.

    Raises
    ------
    Problem
        The key is none, or another submission under it is on its way.
    """
    if header is None:
        yield None
        return
    whose = f"{shared.owner or ''}\n{read_key(header)}"
    name = hashlib.sha256(whose.encode()).hexdigest()
    records = shared.queue.records
    claim = await to_thread.run_sync(records.claim, name, job_id, CLAIM_SECONDS)
    if claim.state == "busy":
        raise in_progress(claim.seconds)
    key = ClaimedKey(name, shared.settings.idempotency_seconds, claim)
    if key.bound:
        yield key
        return
    renewal = asyncio.create_task(_renew(shared, name, job_id))
    try:
        yield key
    except BaseException:
        # Nothing is done where the job was made after all. What cannot be given up lapses.
        with CancelScope(shield=True), suppress(RedisError):
            await to_thread.run_sync(records.unclaim, name, job_id)
        raise
    finally:
        renewal.cancel()


async def _renew(shared: Context, name: str, job_id: str) -> None:
    """Renew a claim for as long as a body takes to arrive."""
    while True:
        await asyncio.sleep(CLAIM_SECONDS / 3)
        with suppress(RedisError):
            await to_thread.run_sync(shared.queue.records.claim, name, job_id, CLAIM_SECONDS)


def in_progress(seconds: float = RETRY_SECONDS) -> Problem:
    """Return the refusal of a submission whose first sending has not been answered."""
    wait = min(RETRY_SECONDS, max(1, math.ceil(seconds)))
    return Problem(
        "submission-in-progress",
        "A submission under this Idempotency-Key is on its way.",
        headers={"Retry-After": str(wait)},
    )


class Digests:
    """Takes the place of the storage for a submission that is only compared with an earlier one."""

    async def put_stream(self, key: str, chunks: AsyncIterable[bytes]) -> StoredObject:
        """Count and hash an object."""
        sha256 = hashlib.sha256()
        size = 0
        async for chunk in chunks:
            await asyncio.to_thread(sha256.update, chunk)
            size += len(chunk)
        return StoredObject(key, size, sha256.hexdigest())

    def delete_prefix(self, prefix: str) -> None:
        """Have nothing to remove."""
