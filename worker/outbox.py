"""The outbox of webhooks: messages that wait to be delivered, in Redis.

A message is written in the atomic step that ends its job, so none is lost when a process dies; it
leaves when it was delivered or given up. Whoever delivers claims messages for a while first, so no
two processes send one at the same time, and another takes over where one dies.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast, get_args
from urllib.parse import urlsplit

from worker.records import PREFIX, JobRecord, decode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from redis import Redis

Outcome: TypeAlias = Literal["delivered", "failed", "given_up"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)

_SCRIPT = resources.files("worker").joinpath("outbox.lua").read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Message:
    """A message that was claimed.

    Attributes
    ----------
    id : str
        The same at every attempt.
    attempt : int
        Number of this attempt, from 1.
    url : str
        Where it goes.
    record : JobRecord
        The job as it was when it ended.
    """

    id: str
    attempt: int
    url: str
    record: JobRecord

    @property
    def host(self) -> str:
        """Host and port of the address, as `outbox.lua` tells hosts apart."""
        return urlsplit(self.url).netloc.lower()


class Outbox:
    """Messages in Redis; calls block.

    Parameters
    ----------
    redis : Redis
        A client that does not decode answers.
    """

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self._script = redis.register_script(_SCRIPT)

    def _step(self, step: str, *arguments: str | float) -> Any:
        return self._script(keys=[PREFIX], args=[step, *arguments])

    def claim(
        self,
        lease: float,
        limit: int,
        *,
        each: int | None = None,
        busy: Mapping[str, int] | None = None,
    ) -> list[Message]:
        """Take messages that are due; nobody else gets them for some seconds.

        Parameters
        ----------
        lease : float
            Seconds after which a message that was not settled is due again.
        limit : int
            Most messages.
        each : int, optional
            Most messages of one host, those included that the caller is busy with.
        busy : mapping of str to int, optional
            Number of these by host (`Message.host`).
        """
        messages = []
        known = json.dumps(dict(busy or {}))
        for message_id, attempt, flat in self._step("claim", lease, limit, each or limit, known):
            found = dict(zip(flat[::2], flat[1::2], strict=True))
            record = decode(found[b"of_job"].decode(), found)
            if record is not None and record.webhook is not None:
                messages.append(Message(message_id.decode(), attempt, record.webhook, record))
        return messages

    def settle(
        self,
        message: Message,
        outcome: Outcome,
        *,
        pause: float = 0,
        status: int | None = None,
        error: str | None = None,
    ) -> bool:
        """Note how an attempt ended.

        Parameters
        ----------
        message : Message
            As it was claimed.
        outcome : {'delivered', 'failed', 'given_up'}
            After 'failed' it is tried again.
        pause : float
            Seconds until then.
        status : int, optional
            HTTP status of the answer.
        error : str, optional
            What went wrong, for the client that asked for the webhook.

        Returns
        -------
        bool
            False where the claim had run out and somebody else has the message now.
        """
        answer = self._step(
            "settle",
            message.id,
            message.attempt,
            outcome,
            pause,
            "" if status is None else status,
            error or "",
        )
        return cast("bytes", answer) == b"ok"
