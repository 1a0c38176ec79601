"""Connections to Redis."""

from __future__ import annotations

import redis
import redis.asyncio
from redis.asyncio.retry import Retry as AsyncRetry
from redis.backoff import ExponentialWithJitterBackoff
from redis.retry import Retry

COMMAND_TIMEOUT = 10.0
CONNECT_TIMEOUT = 5.0
HEALTH_CHECK_INTERVAL = 30
BRIEF_RETRIES = 3
PATIENT_RETRIES = 30
"""With pauses of up to a second: half a minute, enough for Redis to start again."""

UNREACHABLE = (redis.ConnectionError, redis.TimeoutError)
"""What a command raises in the end where Redis cannot be reached."""


def _backoff() -> ExponentialWithJitterBackoff:
    return ExponentialWithJitterBackoff(base=0.05, cap=1.0)


def connect(url: str, *, patient: bool = False, timeout: float = COMMAND_TIMEOUT) -> redis.Redis:
    """Return a client; nothing is sent yet.

    Parameters
    ----------
    url : str
        redis://, rediss:// or unix:// address.
    patient : bool
        Repeat a command for about half a minute while Redis cannot be reached (workers), instead of
        a fraction of a second (the API, which would rather say so).
    timeout : float
        Seconds to wait for an answer.
    """
    retry = Retry(_backoff(), PATIENT_RETRIES if patient else BRIEF_RETRIES)
    return redis.Redis.from_url(
        url,
        retry=retry,
        socket_timeout=timeout,
        socket_connect_timeout=min(timeout, CONNECT_TIMEOUT),
        health_check_interval=HEALTH_CHECK_INTERVAL,
    )


def connect_async(url: str) -> redis.asyncio.Redis:
    """Return an asyncio client; nothing is sent yet."""
    return redis.asyncio.Redis.from_url(
        url,
        retry=AsyncRetry(_backoff(), BRIEF_RETRIES),
        socket_timeout=COMMAND_TIMEOUT,
        socket_connect_timeout=CONNECT_TIMEOUT,
        health_check_interval=HEALTH_CHECK_INTERVAL,
    )


def server_time(client: redis.Redis) -> float:
    """Return Unix seconds by the clock of Redis, which all processes share."""
    seconds, microseconds = client.time()
    return float(seconds + microseconds / 1e6)
