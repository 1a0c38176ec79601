from __future__ import annotations

import asyncio
import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest

from worker.storage import (
    ObjectMissing,
    ObjectStorage,
    StorageError,
    StorageFull,
    UploadTooLarge,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from tests.conftest import S3Process


@pytest.fixture(params=["file", "s3"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ObjectStorage]:
    """Storage of each kind; SMSR_TEST_S3_URL names a bucket in place of the tests' own server's."""
    if request.param == "file":
        yield ObjectStorage(tmp_path.joinpath("objects").as_uri())
        return
    bucket = os.environ.get("SMSR_TEST_S3_URL")
    if bucket:
        found = ObjectStorage(f"{bucket}/{tmp_path.name}")
        yield found
        for prefix in ("uploads/", "results/", "probes/"):
            found.delete_prefix(prefix)
        return
    server: S3Process = request.getfixturevalue("s3_process")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in server.environment.items():
            patch.setenv(name, value)
        yield ObjectStorage(server.new_bucket())


def test_signed_addresses_are_open_to_anybody_for_a_while(storage: ObjectStorage) -> None:
    storage.put_bytes("results/a/1/shapes.npy", b"shapes")
    address = storage.sign("results/a/1/shapes.npy", 60)
    assert (address is None) == (storage.folder is not None)
    if address is not None:
        answer = httpx.get(address, headers={"Range": "bytes=2-3"})
        assert (answer.status_code, answer.content) == (206, b"ap")
        assert "X-Amz-Expires=60" in address


@pytest.fixture
def folder(tmp_path: Path) -> ObjectStorage:
    return ObjectStorage(tmp_path.joinpath("objects").as_uri())


async def chunks(data: bytes, size: int = 100_000) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]


def keys(storage: ObjectStorage, prefix: str = "uploads/") -> list[str]:
    return sorted(item.key for item in storage.list_prefix(prefix))


def test_a_stream_is_stored_counted_and_hashed(storage: ObjectStorage) -> None:
    data = os.urandom(20_000_001)
    stored = asyncio.run(storage.put_stream("uploads/a/m", chunks(data), limit=len(data)))
    assert (stored.bytes, stored.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    assert storage.size("uploads/a/m") == len(data)
    assert storage.get("uploads/a/m") == data


def test_an_empty_stream(storage: ObjectStorage) -> None:
    assert asyncio.run(storage.put_stream("uploads/a/m", chunks(b""))).bytes == 0
    assert storage.get("uploads/a/m") == b""


def test_nothing_is_left_of_a_stream_that_is_too_long(storage: ObjectStorage) -> None:
    with pytest.raises(UploadTooLarge) as caught:
        asyncio.run(storage.put_stream("uploads/a/m", chunks(bytes(30_000_000)), limit=20_000_000))
    assert caught.value.limit == 20_000_000
    assert not storage.exists("uploads/a/m")
    assert keys(storage) == []


def test_nothing_is_left_of_a_stream_that_breaks(storage: ObjectStorage) -> None:
    async def breaking() -> AsyncIterator[bytes]:
        yield bytes(20_000_000)
        raise ConnectionResetError("the client went away")

    with pytest.raises(ConnectionResetError):
        asyncio.run(storage.put_stream("uploads/a/m", breaking()))
    assert keys(storage) == []


def test_nothing_is_left_of_a_stream_that_is_cancelled(storage: ObjectStorage) -> None:
    async def endless() -> AsyncIterator[bytes]:
        while True:
            yield bytes(1_000_000)
            await asyncio.sleep(0.001)

    async def cancelled() -> None:
        task = asyncio.ensure_future(storage.put_stream("uploads/a/m", endless()))
        await asyncio.sleep(0.2)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await asyncio.sleep(0.2)

    asyncio.run(cancelled())
    assert keys(storage) == []


def test_a_stream_is_invisible_until_it_is_whole(storage: ObjectStorage) -> None:
    async def watched() -> AsyncIterator[bytes]:
        for _ in range(3):
            yield bytes(10_000_000)
            assert not storage.exists("uploads/a/m")

    asyncio.run(storage.put_stream("uploads/a/m", watched()))
    assert storage.size("uploads/a/m") == 30_000_000


def test_ranges(storage: ObjectStorage) -> None:
    data = bytes(range(256)) * 1000
    storage.put_bytes("results/a/1/shapes.npy", data)
    assert storage.get_range("results/a/1/shapes.npy", 1000, 300) == data[1000:1300]
    assert storage.get_range("results/a/1/shapes.npy", 1000, 0) == b""
    found = asyncio.run(storage.get_range_async("results/a/1/shapes.npy", 1000, 300))
    assert found == data[1000:1300]


@pytest.mark.parametrize(("start", "length"), [(0, None), (5, None), (7, 200_000), (7, 0)])
def test_streams(storage: ObjectStorage, start: int, length: int | None) -> None:
    data = os.urandom(300_000)
    storage.put_bytes("results/a/1/shapes.npy", data)
    expected = data[start:] if length is None else data[start : start + length]
    parts = list(storage.stream("results/a/1/shapes.npy", start, length, chunk_bytes=50_000))
    assert b"".join(parts) == expected

    async def collected() -> bytes:
        stream = storage.stream_async("results/a/1/shapes.npy", start, length)
        return b"".join([part async for part in stream])

    assert asyncio.run(collected()) == expected


def test_what_is_not_there_is_missing(storage: ObjectStorage, tmp_path: Path) -> None:
    assert not storage.exists("uploads/a/m")
    with pytest.raises(ObjectMissing):
        storage.size("uploads/a/m")
    with pytest.raises(ObjectMissing):
        storage.get("uploads/a/m")
    with pytest.raises(ObjectMissing):
        storage.get_range("uploads/a/m", 0, 1)
    with pytest.raises(ObjectMissing):
        storage.open_local("uploads/a/m", tmp_path)


def test_a_file_is_stored(storage: ObjectStorage, tmp_path: Path) -> None:
    data = os.urandom(20_000_000)
    path = tmp_path / "shapes.npy"
    path.write_bytes(data)
    storage.put_file("results/a/1/shapes.npy", path)
    assert path.exists()
    assert storage.get("results/a/1/shapes.npy") == data


def test_an_object_is_opened_as_a_local_file(storage: ObjectStorage, tmp_path: Path) -> None:
    data = os.urandom(1_000_000)
    storage.put_bytes("uploads/a/m", data)
    assert storage.open_local("uploads/a/m", tmp_path).read_bytes() == data


def test_prefixes_are_removed_whole_and_alone(storage: ObjectStorage) -> None:
    for key in ("results/a/1/x", "results/a/2/x", "results/ab/1/x", "uploads/a/m"):
        storage.put_bytes(key, b"x")
    storage.delete_prefix("results/a/1/")
    assert keys(storage, "results/") == ["results/a/2/x", "results/ab/1/x"]
    storage.delete_prefix("results/a/")
    storage.delete_prefix("results/a/")
    assert keys(storage, "results/") == ["results/ab/1/x"]
    assert keys(storage) == ["uploads/a/m"]
    with pytest.raises(ValueError, match="slash"):
        storage.delete_prefix("uploads")


def test_the_check(storage: ObjectStorage) -> None:
    storage.check()
    assert keys(storage, "probes/") == []


@pytest.mark.parametrize("key", ["", "/etc/passwd", "../x", "a/../b", "a//b", "a/", "a\\b", "a b"])
def test_keys_stay_inside(folder: ObjectStorage, key: str) -> None:
    with pytest.raises(ValueError, match="object key"):
        folder.put_bytes(key, b"x")


@pytest.mark.parametrize("url", ["/tmp/x", "http://host/x", "memory:///"])
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(ValueError, match="file:// or s3://"):
        ObjectStorage(url)


def test_a_local_storage_takes_a_file_over(folder: ObjectStorage, tmp_path: Path) -> None:
    path = tmp_path / "shapes.npy"
    path.write_bytes(b"shapes")
    inode = path.stat().st_ino
    for _ in range(2):  # a repetition after a failure elsewhere is no error
        folder.put_file("results/a/1/shapes.npy", path, move=True)
    stored = folder.open_local("results/a/1/shapes.npy", tmp_path)
    assert (stored.stat().st_ino, stored.read_bytes()) == (inode, b"shapes")
    assert not path.exists()


def test_a_local_storage_on_another_file_system(folder: ObjectStorage, tmp_path: Path) -> None:
    other = Path("/dev/shm")
    if not other.is_dir() or other.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("there is no second file system")
    path = other / f"{os.getpid()}-shapes.npy"
    path.write_bytes(b"shapes")
    try:
        folder.put_file("results/a/1/shapes.npy", path, move=True)
    finally:
        path.unlink(missing_ok=True)
    assert keys(folder, "results/") == ["results/a/1/shapes.npy"]
    assert folder.get("results/a/1/shapes.npy") == b"shapes"


def test_no_empty_folders_are_left(folder: ObjectStorage) -> None:
    folder.put_bytes("results/a/1/x", b"x")
    folder.delete_prefix("results/a/1/")
    assert folder.folder is not None
    assert list(folder.folder.rglob("*")) == [folder.folder / "results"]


def test_a_failing_storage_says_so(folder: ObjectStorage) -> None:
    assert folder.folder is not None
    (folder.folder / "uploads").write_bytes(b"a file in the way")
    with pytest.raises(StorageError):
        folder.put_bytes("uploads/a/m", b"x")
    with pytest.raises(StorageError):
        asyncio.run(folder.put_stream("uploads/a/m", chunks(b"x")))


def test_a_full_disk_is_told_from_other_failures(folder: ObjectStorage) -> None:
    with Path("/dev/full").open("wb", buffering=0) as full, pytest.raises(StorageFull):
        folder.write_at(full.fileno(), [b"x"], 0)


def test_an_object_moves_once_and_again(storage: ObjectStorage) -> None:
    storage.put_bytes("uploads/a/x", b"moved")
    for _ in range(2):
        storage.move("uploads/a/x", "uploads/b/y")
        assert keys(storage) == ["uploads/b/y"]
    with pytest.raises(ObjectMissing):
        storage.move("uploads/a/x", "uploads/c/y")
