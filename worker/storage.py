"""Object storage: uploads and results, on a local disk or in S3.

One interface over obstore. Objects appear whole or not at all. A local folder gets three things
that a bucket cannot give: inputs are opened in place, results are moved in without a copy, and
folders that became empty go away.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import re
import shutil
import threading
import uuid
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast
from urllib.parse import urlsplit
from urllib.request import url2pathname

import obstore
from obstore.exceptions import BaseError
from obstore.store import from_url

if TYPE_CHECKING:
    from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator

    from obstore.store import S3Store

PART_BYTES = 8 << 20
PARTS_AT_ONCE = 3
"""Of an upload that arrives faster than it can be written: this bounds its memory."""
CHUNK_BYTES = 1 << 20
SYNC_BYTES = 32 << 20
"""After so many bytes a growing local file is synced, beside the arrival of more."""

_KEY = re.compile(r"(?!.*(?:^|/)\.{1,2}(?:/|$))[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*")


class StorageError(Exception):
    """The storage did not do what was asked of it; trying again may help."""


class ObjectMissing(StorageError):
    """There is no such object."""


class StorageFull(StorageError):
    """There is no room for more."""


class UploadTooLarge(Exception):
    """More bytes came than were allowed.

    Parameters
    ----------
    limit : int
        Number of bytes allowed.
    """

    def __init__(self, limit: int) -> None:
        super().__init__(f"more than {limit} bytes")
        self.limit = limit


@dataclass(frozen=True, slots=True)
class StoredObject:
    """What was counted while an object was written."""

    key: str
    bytes: int
    sha256: str


@dataclass(frozen=True, slots=True)
class ListedObject:
    """An object in a listing; `modified` in Unix seconds."""

    key: str
    bytes: int
    modified: float


class Sink(Protocol):
    """What takes the files of a submission."""

    async def put_stream(self, key: str, chunks: AsyncIterable[bytes]) -> StoredObject:
        """Take a file as its bytes arrive."""
        ...

    def delete_prefix(self, prefix: str) -> None:
        """Forget the files under a prefix."""
        ...


class ObjectStorage:
    """Objects under a URL.

    A process that used it must not be forked and used again in the child: obstore's threads stay
    behind in the parent.

    Parameters
    ----------
    url : str
        ``file:///folder`` (made if absent) or ``s3://bucket/prefix``; credentials, region and
        endpoint of S3 come from the usual ``AWS_*`` environment variables.

    Raises
    ------
    ValueError
        The URL has another scheme.
    StorageError
        The folder cannot be made.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in {"file", "s3"}:
            raise ValueError(f"storage must be file:// or s3://, not {url!r}")
        self.url = url
        self.folder: Path | None = None
        if parts.scheme == "file":
            self.folder = Path(url2pathname(parts.path))
            with _failures(url):
                self.folder.mkdir(parents=True, exist_ok=True)
        self._store = from_url(url)

    # Writing

    async def put_stream(
        self, key: str, chunks: AsyncIterable[bytes], *, limit: int | None = None
    ) -> StoredObject:
        """Write an object as its bytes arrive, counting and hashing them.

        Nothing is visible before the last byte, and nothing remains when `chunks` raises or the
        task is cancelled.

        Raises
        ------
        UploadTooLarge
            More than `limit` bytes came.
        StorageError
        """
        meter = _Meter(limit)
        try:
            with _failures(key):
                if self.folder is not None:
                    await _write_file(self._local(key), meter, chunks)
                    return StoredObject(key, meter.bytes, meter.sha256.hexdigest())
                await obstore.put_async(
                    self._store,
                    _checked(key),
                    meter.measure(chunks),
                    chunk_size=PART_BYTES,
                    max_concurrency=PARTS_AT_ONCE,
                )
        except StorageError:
            if meter.broken is not None:
                raise meter.broken from None
            raise
        return StoredObject(key, meter.bytes, meter.sha256.hexdigest())

    def put_bytes(self, key: str, data: bytes) -> None:
        """Write a small object.

        Raises
        ------
        StorageError
        """
        with _failures(key):
            obstore.put(self._store, _checked(key), data)
            self._make_durable(key)

    def put_file(self, key: str, path: Path, *, move: bool = False) -> None:
        """Write an object from a file, in parts.

        Parameters
        ----------
        key : str
        path : Path
        move : bool
            The file is not needed afterwards: a local storage takes it over without a copy. Doing
            it again after it succeeded is no error.

        Raises
        ------
        StorageError
        """
        with _failures(key):
            if self.folder is not None and move:
                self._take_over(self._local(key), path)
            else:
                obstore.put(self._store, _checked(key), path, chunk_size=PART_BYTES)
                self._make_durable(key)

    def move(self, source: str, target: str) -> None:
        """Give an object another key, without a copy through this process.

        Doing it again after it succeeded is no error.

        Raises
        ------
        ObjectMissing, StorageError
        """
        with _failures(source):
            if self.folder is None:
                try:
                    obstore.rename(self._store, _checked(source), _checked(target))
                except FileNotFoundError:
                    if not self.exists(target):
                        raise
                return
            old, new = self._local(source), self._local(target)
            if not old.exists() and new.exists():
                return
            new.parent.mkdir(parents=True, exist_ok=True)
            old.replace(new)
            _sync(new.parent)

    # Local files that grow

    @contextlib.contextmanager
    def locked(self, key: str) -> Iterator[int]:
        """Open a file of a local storage, made if absent, while no other process has it open so.

        Raises
        ------
        StorageError
        """
        import fcntl  # not on Windows, where only the client is used

        path = self._local(key)
        with _failures(key):
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                yield descriptor
            finally:
                os.close(descriptor)

    def size_of(self, descriptor: int) -> int:
        """Return the number of bytes of an open file."""
        return os.fstat(descriptor).st_size

    def write_at(self, descriptor: int, blocks: Iterable[bytes], offset: int) -> None:
        """Write bytes at an offset of an open file, so that they outlast a power cut.

        Raises
        ------
        StorageError
        """
        with _failures("an upload"):
            for block in blocks:
                left = memoryview(block)
                while left:
                    count = os.pwrite(descriptor, left, offset)
                    offset += count
                    left = left[count:]
            os.fdatasync(descriptor)

    def cut(self, key: str, length: int) -> None:
        """Remove what stands behind the first `length` bytes of a local file.

        Raises
        ------
        StorageError
            The file is shorter.
        """
        path = self._local(key)
        with _failures(key):
            if path.stat().st_size < length:
                raise StorageError(f"{key} has less than {length} bytes")
            os.truncate(path, length)
            _sync(path)
            _sync(path.parent)

    def sha256(self, key: str) -> str:
        """Return the digest of an object of a local storage.

        Raises
        ------
        StorageError
        """
        with _failures(key), self._local(key).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _take_over(self, target: Path, path: Path) -> None:
        if not path.exists() and target.exists():
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        _sync(path)
        try:
            path.replace(target)
        except OSError:
            # Another file system. The name is one that obstore takes for an unfinished upload.
            staged = target.with_name(f"{target.name}#{uuid.uuid4().int}")
            shutil.copyfile(path, staged)
            _sync(staged)
            staged.replace(target)
        _sync(target.parent)

    def _make_durable(self, key: str) -> None:
        """Make a local object outlast a power cut, as a bucket's do."""
        if self.folder is not None:
            path = self._local(key)
            _sync(path)
            _sync(path.parent)

    # Reading

    def size(self, key: str) -> int:
        """Return the number of bytes of an object.

        Raises
        ------
        ObjectMissing, StorageError
        """
        with _failures(key):
            return obstore.head(self._store, _checked(key))["size"]

    def exists(self, key: str) -> bool:
        """Whether there is an object of this key."""
        try:
            self.size(key)
        except ObjectMissing:
            return False
        return True

    def get(self, key: str) -> bytes:
        """Return a small object whole.

        Raises
        ------
        ObjectMissing, StorageError
        """
        with _failures(key):
            return bytes(obstore.get(self._store, _checked(key)).bytes())

    def get_range(self, key: str, start: int, length: int) -> bytes:
        """Return `length` bytes from `start`.

        Raises
        ------
        ObjectMissing, StorageError
        """
        if length == 0:
            return b""
        with _failures(key):
            return bytes(obstore.get_range(self._store, _checked(key), start=start, length=length))

    async def get_range_async(self, key: str, start: int, length: int) -> bytes:
        """Like `get_range`, without blocking."""
        if length == 0:
            return b""
        with _failures(key):
            found = await obstore.get_range_async(
                self._store, _checked(key), start=start, length=length
            )
            return bytes(found)

    def stream(
        self, key: str, start: int = 0, length: int | None = None, chunk_bytes: int = CHUNK_BYTES
    ) -> Iterator[bytes]:
        """Yield an object, or `length` bytes of it from `start`, in chunks.

        Raises
        ------
        ObjectMissing, StorageError
        """
        if length == 0:
            return
        with _failures(key):
            found = obstore.get(self._store, _checked(key), options=_range(start, length))
            for chunk in found.stream(min_chunk_size=chunk_bytes):
                yield bytes(chunk)

    async def stream_async(
        self, key: str, start: int = 0, length: int | None = None, chunk_bytes: int = CHUNK_BYTES
    ) -> AsyncIterator[bytes]:
        """Like `stream`, without blocking."""
        if length == 0:
            return
        with _failures(key):
            found = await obstore.get_async(
                self._store, _checked(key), options=_range(start, length)
            )
            async for chunk in found.stream(min_chunk_size=chunk_bytes):
                yield bytes(chunk)

    def sign(self, key: str, seconds: float) -> str | None:
        """Return an address from which anybody can get an object for a while.

        Parameters
        ----------
        key : str
        seconds : float
            How long the address is good.

        Returns
        -------
        str or None
            None where the storage is a folder, which has no address.

        Raises
        ------
        StorageError
        """
        if self.folder is not None:
            return None
        with _failures(key):
            store = cast("S3Store", self._store)
            return obstore.sign(store, "GET", _checked(key), timedelta(seconds=seconds))

    def open_local(self, key: str, scratch: Path) -> Path:
        """Return a local file with an object's bytes, to be read only.

        Parameters
        ----------
        key : str
        scratch : Path
            Folder to download into where the storage is not local.

        Raises
        ------
        ObjectMissing, StorageError
        """
        if self.folder is not None:
            path = self._local(key)
            if not path.is_file():
                raise ObjectMissing(f"there is no object {key}")
            return path
        target = scratch / key.replace("/", "-")
        with _failures(key), target.open("wb") as file:
            for chunk in self.stream(key, chunk_bytes=PART_BYTES):
                file.write(chunk)
        return target

    # Listing and removing

    def list_prefix(self, prefix: str) -> Iterator[ListedObject]:
        """Yield the objects under a prefix that ends with a slash.

        Of a local storage, uploads that a dying process left unfinished are listed as well.

        Raises
        ------
        StorageError
        """
        with _failures(prefix):
            if self.folder is None:
                for page in obstore.list(self._store, prefix.rstrip("/")):
                    for item in page:
                        modified = item["last_modified"].timestamp()
                        yield ListedObject(item["path"], item["size"], modified)
                return
            for folder, _, names in os.walk(self._local(prefix.rstrip("/"))):
                for name in names:
                    path = Path(folder, name)
                    with contextlib.suppress(FileNotFoundError):
                        found = path.stat()
                        key = path.relative_to(self.folder).as_posix()
                        yield ListedObject(key, found.st_size, found.st_mtime)

    def delete_prefix(self, prefix: str) -> None:
        """Remove everything under a prefix that ends with a slash; nothing there is no error.

        Raises
        ------
        StorageError
        """
        if not prefix.endswith("/"):
            raise ValueError("a prefix to delete ends with a slash")
        with _failures(prefix):
            if self.folder is None:
                keys = [item.key for item in self.list_prefix(prefix)]
                if keys:
                    obstore.delete(self._store, keys)
                return
            folder = self._local(prefix.rstrip("/"))
            # A process that still writes there makes a folder not empty; the next try removes it.
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(folder)
            for parent in folder.relative_to(self.folder).parents:
                if len(parent.parts) > 1:
                    with contextlib.suppress(OSError):
                        (self.folder / parent).rmdir()

    def check(self) -> None:
        """Write, read and remove a probe.

        Raises
        ------
        StorageError
        """
        prefix = f"probes/{uuid.uuid4().hex}/"
        try:
            self.put_bytes(prefix + "probe", b"probe")
            if self.get(prefix + "probe") != b"probe":
                raise StorageError("the storage does not return what was written")
        finally:
            self.delete_prefix(prefix)

    def _local(self, key: str) -> Path:
        if self.folder is None:
            raise StorageError("this storage has no folder")
        return self.folder.joinpath(*_checked(key).split("/"))


class _Meter:
    """Counts and hashes the bytes that pass, up to a limit."""

    def __init__(self, limit: int | None) -> None:
        self.limit = limit
        self.bytes = 0
        self.sha256 = hashlib.sha256()
        self.broken: OSError | None = None
        """An error of the source that must not be taken for one of the storage."""

    async def count(self, chunks: AsyncIterable[bytes]) -> AsyncIterator[bytes]:
        """Pass chunks on, counted."""
        try:
            async for chunk in chunks:
                self.bytes += len(chunk)
                if self.limit is not None and self.bytes > self.limit:
                    raise UploadTooLarge(self.limit)
                if chunk:
                    yield bytes(chunk)
        except OSError as error:
            self.broken = error
            raise

    async def measure(self, chunks: AsyncIterable[bytes]) -> AsyncIterator[bytes]:
        """Pass chunks on, counted and hashed."""
        async for block in self.count(chunks):
            # Hashed beside the loop, while the storage writes and the next bytes arrive.
            hashing = asyncio.create_task(asyncio.to_thread(self.sha256.update, block))
            yield block
            await hashing


async def _write_file(target: Path, meter: _Meter, chunks: AsyncIterable[bytes]) -> None:
    """Write a file that appears when it is whole; the next bytes arrive while some are written."""
    target.parent.mkdir(parents=True, exist_ok=True)
    # The name is one that obstore takes for an unfinished upload.
    staged = target.with_name(f"{target.name}#{uuid.uuid4().int}")
    with staged.open("xb", buffering=0) as file:
        guard = threading.Lock()  # held by a thread that writes, which a cancelled task leaves

        def take(block: bytes) -> None:
            meter.sha256.update(block)  # here, while it is in the processor's cache
            with guard:
                left = memoryview(block)
                while left and not file.closed:
                    left = left[file.write(left) :]

        loop = asyncio.get_running_loop()
        try:
            writing: asyncio.Future[None] | None = None
            syncing: asyncio.Future[None] | None = None
            unsynced = 0
            async for block in meter.count(chunks):
                if writing is not None:
                    await writing
                # Beside the arrival of more, so that little is left to wait for at the end.
                if unsynced >= SYNC_BYTES and (syncing is None or syncing.done()):
                    if syncing is not None:
                        syncing.result()
                    syncing, unsynced = _begin_sync(file.fileno()), 0
                writing = loop.run_in_executor(None, take, block)
                unsynced += len(block)
            if writing is not None:
                await writing
            if syncing is not None:
                await asyncio.shield(syncing)
            await asyncio.to_thread(os.fsync, file.fileno())
            staged.replace(target)
            await asyncio.to_thread(_sync, target.parent)
        except BaseException:
            with guard:
                file.close()
            staged.unlink(missing_ok=True)
            raise


def _begin_sync(descriptor: int) -> asyncio.Future[None]:
    """Begin to put on disk what a file has; it may be closed meanwhile, and nobody need wait."""
    own = os.dup(descriptor)

    def sync() -> None:
        try:
            os.fdatasync(own)
        finally:
            os.close(own)

    syncing = asyncio.get_running_loop().run_in_executor(None, sync)
    # Where the upload has failed for another reason nobody asks for the outcome.
    syncing.add_done_callback(lambda done: None if done.cancelled() else done.exception())
    return syncing


def _range(start: int, length: int | None) -> obstore.GetOptions:
    if length is None:
        return {"range": {"offset": start}} if start else {}
    return {"range": (start, start + length)}


def _checked(key: str) -> str:
    if not _KEY.fullmatch(key):
        raise ValueError(f"{key!r} is no object key")
    return key


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _failures(key: str) -> Iterator[None]:
    """Turn the errors of obstore and of the file system into ours."""
    try:
        yield
    except FileNotFoundError as error:
        raise ObjectMissing(f"there is no object {key}") from error
    except (BaseError, OSError) as error:
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        if full or os.strerror(errno.ENOSPC) in str(error):  # obstore has the text only
            raise StorageFull(f"{key}: {error}") from error
        raise StorageError(f"{key}: {error}") from error
