"""API keys: who a request comes from, and what it may take.

A key is ``smsr_<id>_<secret>``. Redis has the hash of its secret only, under these keys (prefix
``smsr:``): ``key:{id}``, a hash, and ``keys``, a sorted set of ids by time of creation. The secret
is random and long, so one round of SHA-256 is enough: there is nothing to guess, which is what slow
password hashes protect. Revoking a key removes all of this.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from worker.connections import server_time
from worker.records import PREFIX

if TYPE_CHECKING:
    from collections.abc import Awaitable, Mapping, Sequence

    import redis.asyncio
    from redis import Redis

_KEY = re.compile(r"smsr_(?P<id>[0-9a-f]{12})_(?P<secret>[0-9a-f]{64})", re.ASCII)
_OWNER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", re.ASCII)
_INDEX = f"{PREFIX}:keys"
_NOBODY = hashlib.sha256(b"").hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class ApiKey:
    """What is kept of a key; a limit that is None is that of the settings.

    Attributes
    ----------
    id : str
        12 hexadecimal digits; no secret.
    owner : str
        Account that jobs made with this key belong to; several keys may have one owner.
    created_at : float
        Unix seconds.
    note : str
        For people.
    requests_per_minute : int or None
        Of this key; 0 for any number.
    jobs : int or None
        Queued and running jobs that its owner may have for this key to add one; 0 for any.
    stored_bytes : int or None
        Bytes that its owner may store for this key to add some; 0 for any.
    streams : int or None
        Streams of events that it may have open at a time in each API process; 0 for any number.
    expires_at : float or None
        Unix seconds from which on it is refused; None for never.
    """

    id: str
    owner: str
    created_at: float
    note: str = ""
    requests_per_minute: int | None = None
    jobs: int | None = None
    stored_bytes: int | None = None
    streams: int | None = None
    expires_at: float | None = None

    def expired(self, now: float) -> bool:
        """Whether its time is over."""
        return self.expires_at is not None and now >= self.expires_at


_LIMITS = ("requests_per_minute", "jobs", "stored_bytes", "streams")


class KeyStore:
    """Keys in Redis, for those who give them out.

    Parameters
    ----------
    redis : Redis
        A client that does not decode answers.
    """

    def __init__(self, redis: Redis) -> None:
        self._redis = redis

    def create(
        self,
        owner: str,
        *,
        note: str = "",
        requests_per_minute: int | None = None,
        jobs: int | None = None,
        stored_bytes: int | None = None,
        streams: int | None = None,
        expires_at: float | None = None,
    ) -> tuple[ApiKey, str]:
        """Make a key; return what is kept of it, and the key itself, which can never be had again.

        Raises
        ------
        ValueError
            The name of the owner is not one.
        """
        if not _OWNER.fullmatch(owner):
            raise ValueError(
                f"{owner!r} is no name of an owner: up to 64 letters, digits, dots, dashes and "
                "underscores, with a letter or a digit first"
            )
        key_id, secret = secrets.token_hex(6), secrets.token_hex(32)
        key = ApiKey(
            id=key_id,
            owner=owner,
            created_at=server_time(self._redis),
            note=note,
            requests_per_minute=requests_per_minute,
            jobs=jobs,
            stored_bytes=stored_bytes,
            streams=streams,
            expires_at=expires_at,
        )
        fields: dict[Any, str | float] = {
            "owner": owner,
            "created_at": f"{key.created_at:.6f}",
            "note": note,
            "secret_sha256": _hash(secret),
        }
        for name in _LIMITS:
            if (limit := getattr(key, name)) is not None:
                fields[name] = limit
        if expires_at is not None:
            fields["expires_at"] = f"{expires_at:.6f}"
        with self._redis.pipeline() as pipe:
            pipe.hset(_place(key_id), mapping=fields)
            pipe.zadd(_INDEX, {key_id: key.created_at})
            pipe.execute()
        return key, f"smsr_{key_id}_{secret}"

    def list(self) -> Sequence[ApiKey]:
        """Return all keys, oldest first."""
        ids = [key_id.decode() for key_id in cast("list[bytes]", self._redis.zrange(_INDEX, 0, -1))]
        with self._redis.pipeline(transaction=False) as pipe:
            for key_id in ids:
                pipe.hgetall(_place(key_id))
            found = pipe.execute()
        return [
            _decode(key_id, fields) for key_id, fields in zip(ids, found, strict=True) if fields
        ]

    def revoke(self, key_id: str) -> bool:
        """Remove a key, which no request can use from now on; return whether there was one."""
        with self._redis.pipeline() as pipe:
            pipe.delete(_place(key_id))
            pipe.zrem(_INDEX, key_id)
            removed, _ = pipe.execute()
        return bool(removed)


async def find_key(redis: redis.asyncio.Redis, given: str) -> ApiKey | None:
    """Return the key that a request gave, expired or not; None when there is no such key.

    Nothing is remembered from one call to the next, so a revoked key is refused at once.

    Parameters
    ----------
    redis : redis.asyncio.Redis
        A client that does not decode answers.
    given : str
    """
    parts = _KEY.fullmatch(given)
    if parts is None:
        return None
    answer = cast("Awaitable[dict[bytes, bytes]]", redis.hgetall(_place(parts["id"])))
    fields = await answer
    expected = fields.get(b"secret_sha256", _NOBODY.encode()).decode()
    if not hmac.compare_digest(_hash(parts["secret"]), expected) or not fields:
        return None
    return _decode(parts["id"], fields)


async def is_valid(redis: redis.asyncio.Redis, key_id: str) -> bool:
    """Whether a key that was good for a request still is: neither revoked nor expired."""
    fields = await cast("Awaitable[dict[bytes, bytes]]", redis.hgetall(_place(key_id)))
    return bool(fields) and not _decode(key_id, fields).expired(time.time())


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _place(key_id: str) -> str:
    return f"{PREFIX}:key:{key_id}"


def _decode(key_id: str, fields: Mapping[bytes, bytes]) -> ApiKey:
    texts = {name.decode(): value.decode() for name, value in fields.items()}
    limits = {name: int(texts[name]) if name in texts else None for name in _LIMITS}
    return ApiKey(
        id=key_id,
        owner=texts["owner"],
        created_at=float(texts["created_at"]),
        note=texts.get("note", ""),
        requests_per_minute=limits["requests_per_minute"],
        jobs=limits["jobs"],
        stored_bytes=limits["stored_bytes"],
        streams=limits["streams"],
        expires_at=float(texts["expires_at"]) if "expires_at" in texts else None,
    )
