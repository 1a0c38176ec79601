from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import pytest

from worker.connections import connect_async
from worker.keys import ApiKey, KeyStore, find_key

if TYPE_CHECKING:
    from redis import Redis

    from tests.conftest import RedisProcess


@pytest.fixture
def redis(redis_process: RedisProcess, redis_url: str) -> Redis:
    return redis_process.client()


def found(url: str, given: str) -> ApiKey | None:
    async def find() -> ApiKey | None:
        async with connect_async(url) as redis:
            return await find_key(redis, given)

    return asyncio.run(find())


def everything(redis: Redis) -> bytes:
    """All that Redis holds, as it would be dumped, and readable."""
    texts = []
    for key in redis.scan_iter():
        texts.append(key)
        match redis.type(key):
            case b"hash":
                texts += [part for pair in redis.hgetall(key).items() for part in pair]
            case b"zset":
                texts += redis.zrange(key, 0, -1)
            case other:
                raise AssertionError(other)
    return b"\n".join(texts)


def test_a_key_is_found_by_all_of_it_only(redis: Redis, redis_url: str) -> None:
    kept, key = KeyStore(redis).create("ann", note="laptop", jobs=3)
    assert abs(kept.created_at - time.time()) < 5
    assert found(redis_url, key) == kept
    assert (kept.owner, kept.jobs, kept.stored_bytes) == ("ann", 3, None)
    head, key_id, secret = key.split("_")
    other = KeyStore(redis).create("ann")[1]
    wrong = "0" if secret[-1] != "0" else "1"
    for given in (
        "",
        secret,
        f"{head}_{key_id}_",
        f"{head}_{key_id}_{secret[:-1]}{wrong}",
        f"{head}_{key_id}_{other.split('_')[2]}",
        f"{head}_{'0' * 12}_{secret}",
        key.upper(),
        key + "\n",
        " " + key,
    ):
        assert found(redis_url, given) is None, given


def test_secrets_are_long_and_never_the_same(redis: Redis) -> None:
    secrets = {KeyStore(redis).create("ann")[1].split("_")[2] for _ in range(50)}
    assert len(secrets) == 50
    assert {len(bytes.fromhex(secret)) for secret in secrets} == {32}


def test_redis_never_holds_the_secret(redis: Redis) -> None:
    _, key = KeyStore(redis).create("ann")
    text = everything(redis)
    assert b"ann" in text
    assert key.split("_")[2].encode() not in text
    assert bytes.fromhex(key.split("_")[2]) not in text


def test_listing_and_revoking(redis: Redis, redis_url: str) -> None:
    store = KeyStore(redis)
    (first, one), (second, two) = store.create("ann"), store.create("bob", stored_bytes=0)
    assert list(store.list()) == [first, second]
    assert store.revoke(first.id)
    assert not store.revoke(first.id)
    assert list(store.list()) == [second]
    assert found(redis_url, one) is None
    assert found(redis_url, two) == second


@pytest.mark.parametrize("owner", ["", "a b", "a:queued", "-a", "a" * 65, "ä", "a\n"])
def test_names_of_owners_are_plain(redis: Redis, owner: str) -> None:
    with pytest.raises(ValueError, match="no name of an owner"):
        KeyStore(redis).create(owner)
    assert not redis.keys()
