"""Uploads on their own, which become the inputs of a job later (`service.routes.uploads`).

A record in Redis says how many bytes are safe; `uploads.lua` documents its keys and is the only
code that writes them. The bytes lie in the object storage under ``incoming/{folder}/``: in a local
folder as one file that grows, in a bucket as parts that become one object at the end. Whichever
process takes the next request goes on from there.

Two requests that write at once cannot harm each other. Each gets a fencing token, the newer one
wins, and the offset moves only in steps that the holder of the current token makes. In a bucket the
parts of a former holder have names that nobody reads; in a local folder every write happens under a
lock of the file, after a look at the token, at an offset that was not given out as safe.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import hashlib
import uuid
from collections import OrderedDict
from dataclasses import dataclass
from importlib import resources
from threading import Lock
from typing import TYPE_CHECKING, Any, cast

from worker.connections import server_time
from worker.records import PREFIX, InputFile, upload_key
from worker.storage import ObjectMissing, StorageError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Mapping, Sequence

    from redis import Redis

    from worker.storage import ObjectStorage

_SCRIPT = resources.files("worker").joinpath("uploads.lua").read_text(encoding="utf-8")

INCOMING = "incoming/"
"""Prefix of the objects of uploads."""

_COMPOSED_BYTES = 1 << 20
_TAKING_SECONDS = 60.0
"""Time after which a job that took an upload and has no record is not waited for."""
_KEEP_TAKEN_SECONDS = 3600.0
_LATE_WRITER_SECONDS = 15.0
"""After a deletion a request that has not noticed may write once more; look again after that."""


class UploadGone(Exception):
    """There is no such upload; it may have expired."""


class UploadSuperseded(Exception):
    """A later request writes this upload, or it was deleted."""


class UploadUsed(Exception):
    """The upload is the input of a job already.

    Parameters
    ----------
    upload_id : str
    """

    def __init__(self, upload_id: str) -> None:
        super().__init__(upload_id)
        self.upload_id = upload_id


class UploadUnfinished(Exception):
    """Not all bytes of an upload have arrived."""


class OffsetMismatch(Exception):
    """A request does not go on where the upload stands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Upload:
    """What is known of an upload; times are Unix seconds.

    Attributes
    ----------
    id : str
        32 hexadecimal digits, unique for one owner.
    owner : str or None
    folder : str
        Where its objects lie, under `INCOMING`.
    name : str
        File name, for people and for formats that the bytes do not tell.
    content_type : str or None
    role : str or None
        What it is for, where the client said so.
    metadata : str
        ``Upload-Metadata`` as the client sent it.
    length, offset : int
        Bytes in all, and those that are safe.
    created_at, expires_at : float
    key, sha256 : str or None
        The whole object and its digest, once all bytes are there.
    job, taken_as : str or None
        The job that took it, and the role that it has there.
    former_place : str or None
        Job and role that it was given to before, by a submission that came to nothing.
    """

    id: str
    owner: str | None
    folder: str
    name: str
    length: int
    offset: int = 0
    content_type: str | None = None
    role: str | None = None
    metadata: str = ""
    created_at: float = 0.0
    expires_at: float = 0.0
    key: str | None = None
    sha256: str | None = None
    job: str | None = None
    taken_as: str | None = None
    former_place: str | None = None

    @property
    def complete(self) -> bool:
        """Whether all bytes have arrived."""
        return self.offset == self.length

    @property
    def places(self) -> tuple[str, ...]:
        """Keys under which the whole object may be: a submission may have come to nothing."""
        keys = [self.key or whole_key(self.folder)]
        if self.former_place is not None:
            keys.append(upload_key(*self.former_place.split("/")))
        if self.job is not None and self.taken_as is not None:
            keys.append(upload_key(self.job, self.taken_as))
        return tuple(keys)

    @property
    def prefix(self) -> str:
        """Prefix of its objects."""
        return folder_prefix(self.folder)


def folder_prefix(folder: str) -> str:
    """Return the prefix of the objects of an upload."""
    return f"{INCOMING}{folder}/"


def whole_key(folder: str) -> str:
    """Return the key of the object that an upload becomes."""
    return f"{folder_prefix(folder)}whole"


def new_folder() -> str:
    """Return the name of a folder that is nobody's yet."""
    return uuid.uuid4().hex


class UploadStore:
    """Records of uploads.

    Parameters
    ----------
    redis : Redis
        A client that does not decode answers.
    ttl : float
        Seconds that an upload is kept after its last byte came.
    """

    def __init__(self, redis: Redis, *, ttl: float) -> None:
        self.redis = redis
        self.ttl = ttl
        self._script = redis.register_script(_SCRIPT)

    def _step(self, step: str, owner: str | None, upload: str, *arguments: str | float) -> Any:
        return self._script(keys=[PREFIX], args=[step, owner or "", upload, *arguments])

    def get(self, owner: str | None, upload_id: str) -> Upload | None:
        """Return an upload of an owner, or None."""
        found = cast("dict[bytes, bytes]", self.redis.hgetall(_record_key(owner, upload_id)))
        return _decode(owner, upload_id, found)

    def list(self, owner: str | None, limit: int = 1000) -> Sequence[Upload]:
        """Return the uploads of an owner that no job has taken, newest first."""
        index = f"{PREFIX}:uploads@{owner or ''}"
        members = cast("list[bytes]", self.redis.zrevrange(index, 0, limit - 1))
        ids = [member.decode() for member in members]
        with self.redis.pipeline(transaction=False) as pipe:
            for upload_id in ids:
                pipe.hgetall(_record_key(owner, upload_id))
            found = [
                (upload_id, _decode(owner, upload_id, fields))
                for upload_id, fields in zip(ids, pipe.execute(), strict=True)
            ]
        expired = [upload_id for upload_id, upload in found if upload is None]
        if expired:
            self.redis.zrem(index, *expired)
        return [upload for _, upload in found if upload is not None]

    def parts(self, upload: Upload) -> Sequence[str]:
        """Return the keys of the parts of an upload, in order."""
        found = self.redis.lrange(f"{_record_key(upload.owner, upload.id)}:parts", 0, -1)
        return [key.decode() for key in cast("list[bytes]", found)]

    def reserve(self, folder: str) -> None:
        """Promise to remove a folder unless it becomes an upload's, or this is repeated in time."""
        self._step("reserve", None, "*", self.ttl, folder)

    def create(self, upload: Upload) -> bool:
        """Begin an upload; False when there is one of this id."""
        fields = _fields(upload, "name", "content_type", "role", "metadata", "length")
        answer = self._step("create", upload.owner, upload.id, self.ttl, upload.folder, *fields)
        return bool(answer == b"ok")

    def replace(self, upload: Upload) -> tuple[bool, str | None]:
        """Store an upload that is complete.

        Returns whether there was none of this id, and the folder of one that was.

        Raises
        ------
        UploadUsed
            A job has taken the upload of this id.
        """
        fields = _fields(
            upload, "name", "content_type", "role", "metadata", "length", "offset", "key", "sha256"
        )
        outcome, former = self._step(
            "replace", upload.owner, upload.id, self.ttl, upload.folder, *fields
        )
        if outcome == b"used":
            raise UploadUsed(upload.id)
        return outcome == b"created", former.decode() or None

    def begin(self, upload: Upload, offset: int) -> int:
        """Start to write at an offset; return the token, which fences off earlier requests.

        Raises
        ------
        UploadGone, UploadUsed, OffsetMismatch
        """
        outcome, *token = self._step("begin", upload.owner, upload.id, self.ttl, offset)
        if outcome == b"gone":
            raise UploadGone(upload.id)
        if outcome == b"used":
            raise UploadUsed(upload.id)
        if outcome == b"offset":
            raise OffsetMismatch(upload.id)
        return int(token[0])

    def holds(self, upload: Upload, token: int) -> bool:
        """Whether no later request has begun to write."""
        return bool(self._step("holds", upload.owner, upload.id, token))

    def commit(
        self, upload: Upload, token: int, start: int, stop: int, parts: Sequence[str] = ()
    ) -> None:
        """Move the offset over bytes that are safe.

        Raises
        ------
        UploadSuperseded
        """
        self._insist("commit", upload, token, self.ttl, start, stop, *parts)

    def rewind(self, upload: Upload, token: int, offset: int) -> None:
        """Move the offset back to what the storage really holds.

        Raises
        ------
        UploadSuperseded
        """
        self._insist("rewind", upload, token, offset)

    def seal(self, upload: Upload, token: int, key: str, sha256: str) -> None:
        """Note the object that holds all bytes.

        Raises
        ------
        UploadSuperseded
        """
        self._insist("seal", upload, token, key, sha256)

    def _insist(self, step: str, upload: Upload, *arguments: str | float) -> None:
        if self._step(step, upload.owner, upload.id, *arguments) != b"ok":
            raise UploadSuperseded(upload.id)

    def delete(self, owner: str | None, upload_id: str) -> str | None:
        """Forget an upload; return its folder, which maintenance empties if nobody else does."""
        step = self._step("delete", owner, upload_id, _LATE_WRITER_SECONDS)
        folder = cast("bytes | None", step)
        return None if folder is None else folder.decode()

    def take(self, owner: str | None, uploads: Mapping[str, str], job_id: str) -> None:
        """Give uploads to a job, all or none.

        Parameters
        ----------
        owner : str or None
        uploads : mapping of str to str
            Ids of uploads by role.
        job_id : str

        Raises
        ------
        UploadGone, UploadUnfinished, UploadUsed
        """
        times = (_TAKING_SECONDS, _KEEP_TAKEN_SECONDS)
        wanted = [part for role, upload_id in uploads.items() for part in (upload_id, role)]
        outcome, *which = self._step("take", owner, "*", job_id, *times, *wanted)
        if outcome == b"ok":
            return
        upload_id = which[0].decode()
        if outcome == b"gone":
            raise UploadGone(upload_id)
        raise (UploadUsed if outcome == b"used" else UploadUnfinished)(upload_id)

    def give_back(self, owner: str | None, upload_ids: Sequence[str], job_id: str) -> None:
        """Undo `take`: the job will not be."""
        self._step("give_back", owner, "*", job_id, *upload_ids)

    def abandoned(self, limit: int = 100) -> Sequence[str]:
        """Return folders whose time is over."""
        due = self.redis.zrangebyscore(
            f"{PREFIX}:incoming", "-inf", server_time(self.redis), start=0, num=limit
        )
        return [folder.decode() for folder in cast("list[bytes]", due)]

    def knows_folder(self, folder: str) -> bool:
        """Whether a folder is to be kept, or to be removed at its time."""
        return self.redis.zscore(f"{PREFIX}:incoming", folder) is not None

    def put_off_folder(self, folder: str, seconds: float) -> None:
        """Have a folder that could not be emptied looked at again after some seconds."""
        self.redis.zadd(f"{PREFIX}:incoming", {folder: server_time(self.redis) + seconds}, xx=True)

    def forget_folder(self, folder: str) -> None:
        """Note that nothing is left in a folder."""
        self.redis.zrem(f"{PREFIX}:incoming", folder)


class Digests:
    """SHA-256 of the safe bytes of uploads under way, as far as this process wrote them.

    The digest of an upload whose requests all came to one process is known at its end; that of
    others is computed from the object.

    Parameters
    ----------
    size : int
        Number of uploads that are remembered.
    """

    def __init__(self, size: int = 1024) -> None:
        self._known: OrderedDict[str, tuple[int, hashlib._Hash]] = OrderedDict()
        self._size = size
        self._lock = Lock()

    def at(self, folder: str, offset: int) -> hashlib._Hash | None:
        """Return the hash of the first `offset` bytes, to go on with, or None."""
        if offset == 0:
            return hashlib.sha256()
        with self._lock:
            known = self._known.get(folder)
        return known[1].copy() if known is not None and known[0] == offset else None

    def keep(self, folder: str, offset: int, digest: hashlib._Hash) -> None:
        """Remember the hash of the first `offset` bytes."""
        with self._lock:
            self._known[folder] = (offset, digest.copy())
            self._known.move_to_end(folder)
            if len(self._known) > self._size:
                self._known.popitem(last=False)

    def forget(self, folder: str) -> None:
        """Remember an upload no longer."""
        with self._lock:
            self._known.pop(folder, None)


class UploadWriter:
    """One request that writes to an upload. Its methods block and are called one at a time.

    Parameters
    ----------
    store : UploadStore
    storage : ObjectStorage
    upload : Upload
    token, offset : int
        From `UploadStore.begin` at the offset.
    deferred : bool
        The offset moves at `commit` only: a digest of the bytes is still to be checked.
    """

    def __init__(
        self,
        store: UploadStore,
        storage: ObjectStorage,
        upload: Upload,
        token: int,
        offset: int,
        *,
        deferred: bool = False,
    ) -> None:
        self._store = store
        self._storage = storage
        self._upload = upload
        self._token = token
        self._deferred = deferred
        self._parts: list[str] = []
        self.offset = offset
        """Bytes that are safe."""
        self._written = offset

    @contextlib.contextmanager
    def _fenced(self) -> Iterator[int]:
        """Lock the file of the upload and look at the token; give the file's descriptor."""
        with self._storage.locked(whole_key(self._upload.folder)) as descriptor:
            if not self._store.holds(self._upload, self._token):
                raise UploadSuperseded(self._upload.id)
            yield descriptor

    def check(self) -> None:
        """Make sure that the storage holds what the record says.

        A local file system may lose the end of a file in a power cut.

        Raises
        ------
        OffsetMismatch
            It did not; the record is right now.
        """
        if self._storage.folder is None or self.offset == 0:
            return
        with self._fenced() as descriptor:
            size = self._storage.size_of(descriptor)
            if size < self.offset:
                self._store.rewind(self._upload, self._token, size)
                raise OffsetMismatch(self._upload.id)

    def write(self, blocks: Sequence[bytes]) -> None:
        """Store the next bytes.

        Raises
        ------
        UploadSuperseded, StorageError
        """
        end = self._written + sum(map(len, blocks))
        if self._storage.folder is not None:
            with self._fenced() as descriptor:
                self._storage.write_at(descriptor, blocks, self._written)
                self._written = end
                if not self._deferred:
                    self.commit()
            return
        part = f"{self._upload.prefix}parts/{self._written:016d}-{self._token}"
        self._storage.put_bytes(part, b"".join(blocks))
        self._parts.append(part)
        self._written = end
        if not self._deferred:
            self.commit()

    def commit(self) -> None:
        """Make the bytes that were written the upload's.

        Raises
        ------
        UploadSuperseded
        """
        self._store.commit(self._upload, self._token, self.offset, self._written, self._parts)
        self.offset = self._written
        self._parts = []


async def seal(
    store: UploadStore,
    storage: ObjectStorage,
    upload: Upload,
    token: int,
    digest: hashlib._Hash | None,
) -> None:
    """Make an upload whose bytes are all there one object; safe to repeat.

    Parameters
    ----------
    store : UploadStore
    storage : ObjectStorage
    upload : Upload
    token : int
    digest : hash or None
        SHA-256 of all bytes, where it is known.

    Raises
    ------
    UploadSuperseded, StorageError
    """
    key = whole_key(upload.folder)
    if storage.folder is not None:
        await asyncio.to_thread(storage.cut, key, upload.length)
        sha256 = digest.hexdigest() if digest else await asyncio.to_thread(storage.sha256, key)
        await asyncio.to_thread(store.seal, upload, token, key, sha256)
        return
    parts = await asyncio.to_thread(store.parts, upload)
    if digest is not None and len(parts) == 1:
        await asyncio.to_thread(store.seal, upload, token, parts[0], digest.hexdigest())
        return

    async def chained() -> AsyncIterator[bytes]:
        for part in parts:
            async for chunk in storage.stream_async(part, chunk_bytes=_COMPOSED_BYTES):
                yield chunk

    stored = await storage.put_stream(key, chained())
    if stored.bytes != upload.length:
        raise StorageError(f"{upload.prefix}parts/ hold {stored.bytes} bytes, not {upload.length}")
    await asyncio.to_thread(store.seal, upload, token, key, stored.sha256)
    with contextlib.suppress(StorageError):  # the folder is removed later at any rate
        await asyncio.to_thread(storage.delete_prefix, f"{upload.prefix}parts/")


def beginning(store: UploadStore, storage: ObjectStorage, upload: Upload, size: int) -> bytes:
    """Return the first bytes of an upload, `size` of them or all that there are.

    Raises
    ------
    StorageError
    """
    if size == 0:
        return b""
    size = min(size, upload.length)
    if storage.folder is not None or upload.key is not None:
        for place in upload.places:
            with contextlib.suppress(ObjectMissing):
                return storage.get_range(place, 0, size)
        raise ObjectMissing(f"the upload {upload.id} is gone")
    head = b""
    for part in store.parts(upload):
        if len(head) >= size:
            break
        head += storage.get(part)
    return head[:size]


def hand_over(storage: ObjectStorage, upload: Upload, job_id: str, role: str) -> InputFile:
    """Make a complete upload that a job took its input, without a copy where that can be.

    Raises
    ------
    ObjectMissing
        A job had it before and was deleted since.
    StorageError
    """
    target = upload_key(job_id, role)
    for place in upload.places:
        with contextlib.suppress(ObjectMissing):
            storage.move(place, target)
            break
    else:
        raise ObjectMissing(f"the upload {upload.id} is gone")
    return InputFile(
        key=target,
        name=upload.name,
        bytes=upload.length,
        sha256=upload.sha256 or "",
        content_type=upload.content_type,
    )


def _record_key(owner: str | None, upload_id: str) -> str:
    return f"{PREFIX}:upload:{owner or ''}:{upload_id}"


def _fields(upload: Upload, *names: str) -> list[str | int]:
    """Return names and values of the attributes that are set."""
    given = {name: getattr(upload, name) for name in names}
    return [part for item in given.items() if item[1] is not None for part in item]


def _decode(owner: str | None, upload_id: str, found: Mapping[bytes, bytes]) -> Upload | None:
    if not found:
        return None
    texts = {key.decode(): value.decode() for key, value in found.items()}
    names = {field.name for field in dataclasses.fields(Upload)}
    given: dict[str, Any] = {name: text for name, text in texts.items() if name in names}
    for name in ("length", "offset"):
        given[name] = int(texts[name])
    for name in ("created_at", "expires_at"):
        given[name] = float(texts[name])
    return Upload(**{**given, "id": upload_id, "owner": owner})
