"""Delivery of webhooks: signed, again and again until they arrive (Standard Webhooks).

https://github.com/standard-webhooks/standard-webhooks/blob/main/spec/standard-webhooks.md
"""

from __future__ import annotations

import asyncio
import json
import random
import ssl
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Self

import certifi
import httpx
import structlog
from anyio import to_thread
from redis.exceptions import RedisError
from standardwebhooks import Webhook

import smsr
from service.schemas import job_document
from service.targets import TargetRefused, Targets
from worker.outbox import Outbox

if TYPE_CHECKING:
    from types import TracebackType

    from redis import Redis

    from service.targets import Target
    from worker.outbox import Message, Outcome
    from worker.records import JobRecord
    from worker.settings import Settings

AT_ONCE = 32
"""Most messages that a process delivers at the same time."""
OF_A_HOST = 8
"""Most of these that go to one host: one that does not answer must not hold up the others."""
LOOK_SECONDS = 1.0
"""Time between two looks for messages that are due."""
LEASE_MARGIN_SECONDS = 5.0
JITTER = 0.2
"""Part by which pauses differ at random, so that messages that failed together spread."""
LONGEST_RETRY_AFTER = 86400.0
MOST_ADDRESSES = 3
"""Addresses of a name that one attempt tries to connect to."""
ANSWER_BYTES = 16384
"""What is read of an answer, whose body nobody looks at."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Answer:
    """How an attempt ended.

    Attributes
    ----------
    status : int or None
        HTTP status, where there was an answer.
    error : str or None
        What went wrong, for the client.
    retry_after : float
        Seconds that the receiver asked for.
    """

    status: int | None = None
    error: str | None = None
    retry_after: float = 0.0

    @property
    def delivered(self) -> bool:
        """Whether the receiver has taken the message."""
        return self.error is None


def body_of(record: JobRecord, root: str) -> str:
    """Return the body of the message about a job that has ended.

    Parameters
    ----------
    record : JobRecord
        As it was then.
    root : str
        What links begin with.
    """
    document = job_document(record, root=root, brief=True).model_dump(mode="json")
    del document["webhook"]
    ended = datetime.fromtimestamp(record.finished_at or record.created_at, UTC)
    body = {
        "type": f"job.{record.status}",
        "timestamp": ended.isoformat().replace("+00:00", "Z"),
        "data": document,
    }
    return json.dumps(body, ensure_ascii=False, separators=(",", ":"))


def sign(message_id: str, moment: datetime, body: str, secrets: str) -> dict[str, str]:
    """Return the headers of a message.

    Parameters
    ----------
    message_id : str
    moment : datetime
        Of this attempt, in UTC.
    body : str
    secrets : str
        Keys with spaces between them; each signs.
    """
    signatures = [Webhook(key).sign(message_id, moment, body) for key in secrets.split()]
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(int(moment.timestamp())),
        "webhook-signature": " ".join(signatures),
    }


class Sender:
    """Posts messages to targets, each over a connection of its own.

    Parameters
    ----------
    settings : Settings
    targets : Targets
    """

    def __init__(self, settings: Settings, targets: Targets) -> None:
        self._settings = settings
        self._targets = targets
        context = ssl.create_default_context(cafile=certifi.where())
        context.load_default_certs()  # those of the system and of SSL_CERT_FILE as well
        self._http = httpx.AsyncClient(
            verify=context,
            follow_redirects=False,
            trust_env=False,  # a proxy would resolve the name again
            timeout=settings.webhook_timeout_seconds,
            # Connections are told apart by address, not by the name a certificate was checked for.
            limits=httpx.Limits(max_keepalive_connections=0),
            headers={"User-Agent": f"smsr/{smsr.__version__}", "Accept": "*/*"},
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self._http.aclose()

    async def send(self, message: Message) -> Answer:
        """Make one attempt."""
        try:
            async with asyncio.timeout(self._settings.webhook_timeout_seconds):
                target = self._targets.parse(message.url)
                addresses = await self._targets.addresses(target)
                return await self._post(target, addresses[:MOST_ADDRESSES], message)
        except TargetRefused as refusal:
            return Answer(error=f"The address is refused: {refusal}.")
        except TimeoutError:
            return Answer(error="The receiver did not answer in time.")
        except httpx.TransportError as error:
            return Answer(error=_described(error))

    async def _post(self, target: Target, addresses: list[str], message: Message) -> Answer:
        """Post to the first address that can be connected to."""
        body = body_of(message.record, self._settings.public_url or "")
        headers = {
            "Host": target.url.netloc.decode("ascii"),
            "Content-Type": "application/json",
            **sign(message.id, datetime.now(UTC), body, self._settings.webhook_secret),
        }
        for number, address in enumerate(addresses, 1):
            try:
                async with self._http.stream(
                    "POST",
                    target.url.copy_with(host=address),
                    content=body.encode(),
                    headers=headers,
                    # The name that TLS asks for, and that the certificate must bear.
                    extensions={"sni_hostname": target.host},
                ) as response:
                    await _skim(response)
                    return _judged(response)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                if number == len(addresses):
                    raise
        raise AssertionError("a target has an address")


class Deliverer:
    """Delivers what is in the outbox; any number of processes may run one.

    Parameters
    ----------
    settings : Settings
    redis : Redis
        A client for threads, which does not decode answers.
    targets : Targets, optional
    """

    def __init__(self, settings: Settings, redis: Redis, targets: Targets | None = None) -> None:
        self._settings = settings
        self._outbox = Outbox(redis)
        self._targets = targets or Targets(settings)
        self._under_way: dict[asyncio.Task[None], str] = {}
        """Deliveries by the host they go to."""

    async def run(self) -> None:
        """Deliver until cancelled; what is under way then is sent again by somebody."""
        async with Sender(self._settings, self._targets) as sender:
            try:
                while True:
                    if not await self._start(sender):
                        await asyncio.sleep(LOOK_SECONDS)
            finally:
                for task in self._under_way:
                    task.cancel()
                await asyncio.gather(*self._under_way, return_exceptions=True)

    async def _start(self, sender: Sender) -> bool:
        """Begin with what is due; whether there was anything."""
        free = AT_ONCE - len(self._under_way)
        if free == 0:
            return False
        lease = self._settings.webhook_timeout_seconds + LEASE_MARGIN_SECONDS
        busy = Counter(self._under_way.values())
        claim = partial(self._outbox.claim, lease, free, each=OF_A_HOST, busy=busy)
        try:
            messages = await to_thread.run_sync(claim)
        except RedisError as failure:
            log.warning("webhooks are put off", reason=str(failure))
            return False
        for message in messages:
            task = asyncio.create_task(self._deliver(sender, message))
            self._under_way[task] = message.host
            task.add_done_callback(self._under_way.pop)
        return bool(messages)

    async def _deliver(self, sender: Sender, message: Message) -> None:
        try:
            answer = await sender.send(message)
        except Exception:
            log.exception("a webhook could not be sent", message=message.id)
            answer = Answer(error="The message could not be sent.")
        outcome, pause = self._consequence(message, answer)
        log.info(
            "webhook",
            job=message.record.id,
            message=message.id,
            attempt=message.attempt,
            outcome=outcome,
            status=answer.status,
            reason=answer.error,
        )
        # Where this cannot be noted, the claim runs out and the message is sent once more.
        with suppress(RedisError):
            await to_thread.run_sync(
                lambda: self._outbox.settle(
                    message, outcome, pause=pause, status=answer.status, error=answer.error
                )
            )

    def _consequence(self, message: Message, answer: Answer) -> tuple[Outcome, float]:
        """Return what becomes of a message, and the seconds until its next attempt."""
        if answer.delivered:
            return "delivered", 0.0
        pauses = self._settings.webhook_pauses
        if answer.status == HTTPStatus.GONE or message.attempt > len(pauses):
            return "given_up", 0.0
        pause = pauses[message.attempt - 1] * random.uniform(1 - JITTER, 1 + JITTER)  # noqa: S311
        return "failed", max(pause, answer.retry_after)


async def _skim(response: httpx.Response) -> None:
    """Read a little of a body, as receivers expect, but never more than that."""
    read = 0
    async for chunk in response.aiter_raw():
        read += len(chunk)
        if read >= ANSWER_BYTES:
            return


def _judged(response: httpx.Response) -> Answer:
    status = response.status_code
    if response.is_success:
        return Answer(status)
    if response.is_redirect:
        return Answer(status, "The receiver redirects, which webhooks do not follow.")
    return Answer(status, f"The receiver answered {status}.", _retry_after(response))


def _retry_after(response: httpx.Response) -> float:
    """Return the seconds of Retry-After (RFC 9110, section 10.2.3), within reason."""
    value = response.headers.get("retry-after", "")
    seconds = 0.0
    with suppress(ValueError, TypeError):
        if value.isdecimal():
            seconds = float(value[:12])
        elif value:
            seconds = (parsedate_to_datetime(value) - datetime.now(UTC)).total_seconds()
    return min(max(seconds, 0.0), LONGEST_RETRY_AFTER)


def _described(error: httpx.TransportError) -> str:
    """Say what went wrong on the way without the addresses of the inside."""
    match error:
        case httpx.ConnectTimeout() | httpx.ReadTimeout() | httpx.WriteTimeout():
            return "The receiver did not answer in time."
        case httpx.ConnectError():
            cause = "certificate" if "CERTIFICATE" in str(error).upper() else None
            return (
                "The certificate of the receiver could not be verified."
                if cause
                else "No connection to the receiver could be made."
            )
        case _:
            return "The connection to the receiver broke."
