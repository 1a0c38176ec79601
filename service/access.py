"""Who may use the API: API keys, their rate limits, and the open mode.

`Access` stands before the routes and settles whose request it is: ``request.state.owner`` is the
name of an account, or None where the API is open and all clients share everything; then
``request.state.allowance`` says what that owner may have. The routes see both in their `Context`.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import math
import time
from collections import Counter
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Literal, TypeAlias

from fastapi import Security
from fastapi.security import APIKeyHeader, HTTPBearer
from limits import RateLimitItemPerMinute
from limits.aio.storage import RedisStorage
from limits.aio.strategies import MovingWindowRateLimiter
from redis.exceptions import RedisError
from starlette._utils import get_route_path
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request

from service import problems
from service.problems import Problem
from worker.keys import find_key, is_valid
from worker.records import ANY, PREFIX, Allowance

if TYPE_CHECKING:
    from collections.abc import Iterator

    from redis.asyncio import Redis
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from worker.keys import ApiKey
    from worker.settings import Settings

Policy: TypeAlias = Literal["open", "loopback", "keys"]
"""'open' to all; open to this machine and otherwise with keys ('loopback'); with 'keys' only."""

PUBLIC = frozenset({"/v1/info"})
"""Paths under /v1 that need no key; outside of /v1 only /metrics may need one."""

KEY_SCHEMES = (
    Security(HTTPBearer(scheme_name="bearer", description="An API key.", auto_error=False)),
    Security(APIKeyHeader(name="X-API-Key", scheme_name="header", auto_error=False)),
)
"""What the OpenAPI document says of keys; that they are given is seen to by `Access`."""

STREAMS_RETRY_SECONDS = 5
"""What ``Retry-After`` says while a key has too many streams open."""

_WINDOW_SECONDS = 60
_FORWARDED = ("forwarded", "via", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


def policy_for(settings: Settings, address: str | None) -> Policy:
    """Return who may use the API.

    Parameters
    ----------
    settings : Settings
    address : str or None
        IP address at which the API listens, None where that is not known: then 'auto' means keys.
    """
    if settings.access != "auto":
        return settings.access
    return "loopback" if address is not None and _is_loopback(address) else "keys"


class Gate:
    """Knows the keys and counts the requests made with each.

    Parameters
    ----------
    settings : Settings
    policy : {'open', 'loopback', 'keys'}
    redis : Redis
        Client that does not decode answers; closing it remains the caller's.
    """

    def __init__(self, settings: Settings, policy: Policy, redis: Redis) -> None:
        self.policy = policy
        self._settings = settings
        self._redis = redis
        self._streams: Counter[str] = Counter()
        storage = RedisStorage(
            "async+redis://unused:1",  # the pool has the address
            implementation="redispy",
            key_prefix=f"{PREFIX}:rate",
            connection_pool=redis.connection_pool,  # type: ignore[arg-type]
        )
        self._limiter = MovingWindowRateLimiter(storage)

    async def admit(self, request: Request) -> dict[str, str]:
        """Settle whose request it is; return headers of its answer.

        Raises
        ------
        Problem
            The request needs a key that is known, or comes too soon after others.
        """
        path = get_route_path(request.scope)
        if path == "/metrics":
            if request.method in ("GET", "HEAD"):  # others are not allowed to anybody
                self._check_metrics(request)
        elif f"{path}/".startswith("/v1/") and path not in PUBLIC:
            return await self._admit_to_api(request)
        return {}

    async def _admit_to_api(self, request: Request) -> dict[str, str]:
        given = _credentials(request.headers)
        if self._is_open_to(request.headers) and not (given or "").startswith("smsr_"):
            return {}  # what a proxy may have added is no concern here
        key = await find_key(self._redis, given) if given else None
        if key is None or key.expired(time.time()):
            raise self._unauthorized(given, expired=key is not None)
        request.state.owner, request.state.key = key.owner, key
        request.state.allowance = self._allowance(key)
        return await self._count(key)

    def _is_open_to(self, headers: Headers) -> bool:
        return self.policy == "open" or (self.policy == "loopback" and _comes_from_here(headers))

    def _unauthorized(self, given: str | None, *, expired: bool = False) -> Problem:
        if given:
            return Problem(
                "unauthorized",
                "The time of this API key is over; its operator makes another one."
                if expired
                else "There is no such API key; it may have been revoked.",
                headers={"WWW-Authenticate": 'Bearer realm="smsr", error="invalid_token"'},
            )
        detail = "Send an API key as `Authorization: Bearer smsr_...`."
        if self.policy == "loopback":
            detail = (
                "Without an API key the service answers only requests of this machine itself, "
                "under its own name (localhost). This one passed a proxy, was for another name, "
                "or comes from a page of another site."
            )
        return Problem("unauthorized", detail, headers={"WWW-Authenticate": 'Bearer realm="smsr"'})

    @contextmanager
    def stream(self, key: ApiKey | None) -> Iterator[None]:
        """Count a stream of events of a key for as long as it is open.

        Raises
        ------
        Problem
            The key has as many open as it may in this process.
        """
        if key is None:
            yield
            return
        most = self._settings.key_streams if key.streams is None else key.streams
        if most and self._streams[key.id] >= most:
            raise Problem(
                "too-many-streams",
                f"This API key may have {most} streams of events open at a time.",
                headers={"Retry-After": str(STREAMS_RETRY_SECONDS)},
                limit=most,
            )
        self._streams[key.id] += 1
        try:
            yield
        finally:
            self._streams[key.id] -= 1
            if not self._streams[key.id]:
                del self._streams[key.id]

    async def until_invalid(self, key: ApiKey | None, interval: float) -> None:
        """Return when a key that was admitted has been revoked or has expired.

        Parameters
        ----------
        key : ApiKey or None
            For None, who needs no key, this never returns.
        interval : float
            Seconds between two looks.
        """
        while True:
            pause = interval
            if key is not None and key.expires_at is not None:
                pause = min(pause, max(key.expires_at - time.time(), 0.0))
            await asyncio.sleep(pause)
            with suppress(RedisError):  # while it is away no key can be revoked
                if key is not None and not await is_valid(self._redis, key.id):
                    return

    def _allowance(self, key: ApiKey) -> Allowance:
        settings = self._settings
        jobs = settings.key_jobs if key.jobs is None else key.jobs
        size = settings.key_stored_bytes if key.stored_bytes is None else key.stored_bytes
        return Allowance(jobs or None, size or None)

    async def _count(self, key: ApiKey) -> dict[str, str]:
        """Count a request; the headers are those of draft-ietf-httpapi-ratelimit-headers-10."""
        most = key.requests_per_minute
        if most is None:
            most = self._settings.key_requests_per_minute
        if most == 0:
            return {}
        item = RateLimitItemPerMinute(most)
        admitted = await self._limiter.hit(item, key.id)
        reset, left = await self._limiter.get_window_stats(item, key.id)
        wait = min(max(math.ceil(reset - time.time()), 1), _WINDOW_SECONDS)
        headers = {
            "RateLimit-Policy": f'"requests";q={most};w={_WINDOW_SECONDS}',
            "RateLimit": f'"requests";r={max(left, 0)};t={wait}',
        }
        if not admitted:
            raise Problem(
                "too-many-requests",
                f"This API key may make {most} requests a minute.",
                headers=headers | {"Retry-After": str(wait)},
                limit=most,
            )
        return headers

    def _check_metrics(self, request: Request) -> None:
        token = self._settings.metrics_token
        if token is None and self._is_open_to(request.headers):
            return
        given = _credentials(request.headers) or ""
        if token is None or not hmac.compare_digest(given.encode(), token.encode()):
            raise Problem(
                "unauthorized",
                "Metrics are for the operator, with the token of SMSR_METRICS_TOKEN.",
                headers={"WWW-Authenticate": 'Bearer realm="smsr metrics"'},
            )


class Access:
    """Lets requests pass that the `Gate` of the application admits.

    Parameters
    ----------
    app : ASGIApp
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        gate: Gate = scope["app"].state.gate
        request.state.owner, request.state.key, request.state.allowance = None, None, ANY
        try:
            headers = await gate.admit(request)
        except Problem as problem:
            await problems.answer(request, problem)(scope, receive, send)
            return
        except RedisError as error:
            await problems.redis_away(request, error)(scope, receive, send)
            return

        async def send_with_limits(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(headers)
            await send(message)

        await self.app(scope, receive, send_with_limits if headers else send)


def _credentials(headers: Headers) -> str | None:
    """Return the key that a request gives (RFC 6750, section 2.1, or X-API-Key)."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    return headers.get("x-api-key")


def _comes_from_here(headers: Headers) -> bool:
    """Whether a request to a loopback address was meant for it by someone on this machine.

    It was not where a proxy on this machine has passed it on, where another name was made to lead
    here (DNS rebinding), or where a page of another site sends it.
    """
    host = headers.get("host", "").lower()
    name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
    here = name == "localhost" or name.endswith(".localhost") or _is_loopback(name)
    forwarded = any(header in headers for header in _FORWARDED)
    return here and not forwarded and headers.get("sec-fetch-site") != "cross-site"


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
