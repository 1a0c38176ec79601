"""Results as they are downloaded: views of the stored arrays, made while they stream.

`shapes.npy` holds float32, little endian, frame after frame, so the bytes of a frame are the vertex
block of a binary PLY, and an NPZ is a stored ZIP of the arrays as they are. Nothing is converted,
kept twice or held in memory, and every length is known before the first byte.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import re
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from anyio import to_thread
from starlette.concurrency import iterate_in_threadpool
from starlette.datastructures import Headers
from starlette.responses import Response, StreamingResponse

import smsr
from service.archives import Member, archive_size, stream_archive
from service.conditional import (
    NotModified,
    PreconditionFailed,
    Unsatisfiable,
    Validators,
    wanted_range,
)
from service.problems import Problem
from smsr.files.glb import Bounds, Glb, GlbOptions
from smsr.files.npy import HEADER_BYTES, parse_header
from smsr.files.ply import FACE_BYTES, VERTEX_BYTES, ply_face_block, ply_header
from worker.storage import ObjectMissing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from numpy.typing import NDArray
    from starlette.types import Receive, Scope, Send

    from worker.records import JobRecord
    from worker.storage import ObjectStorage

ARRAYS = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy")
"""Arrays of a result as the worker stores them; faces only where faces were sent."""

_KEPT_BOUNDS = 4

WINDOW_BYTES = 3 << 20
"""Bytes read at once; a multiple of a row of faces."""


@dataclass(frozen=True, slots=True)
class StoredArray:
    """An ``.npy`` object: its shape and where its data begin."""

    key: str
    size: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int


async def open_array(storage: ObjectStorage, key: str) -> StoredArray:
    """Read the header of an ``.npy`` object.

    Raises
    ------
    worker.storage.ObjectMissing
    """
    size = await to_thread.run_sync(storage.size, key)
    head = await storage.get_range_async(key, 0, min(size, HEADER_BYTES))
    header = parse_header(head)
    assert header.dtype is not None  # noqa: S101  (the worker writes numbers)
    return StoredArray(key, size, header.shape, header.dtype, header.offset)


async def read_range(
    storage: ObjectStorage, key: str, start: int, length: int
) -> AsyncIterator[bytes]:
    """Yield a part of an object in windows, the next one being read while one is sent.

    Each window is a request of its own, so that a client that reads slowly holds no connection to
    the storage open beyond its time limit.
    """

    def begin(offset: int) -> asyncio.Task[bytes] | None:
        if offset >= length:
            return None
        size = min(WINDOW_BYTES, length - offset)
        return asyncio.create_task(storage.get_range_async(key, start + offset, size))

    offset = 0
    ahead = begin(offset)
    try:
        while ahead is not None:
            window = await ahead
            offset += len(window)
            ahead = begin(offset)
            yield window
    finally:
        if ahead is not None:
            ahead.cancel()


@dataclass(frozen=True, slots=True)
class Content:
    """The bytes of a download.

    Attributes
    ----------
    size : int
        How many there are.
    read : callable
        Gives those from a position up to another.
    seekable : bool
        Whether `read` can begin elsewhere than at 0.
    """

    size: int
    read: Callable[[int, int], AsyncIterator[bytes]]
    seekable: bool = True


def stored_content(storage: ObjectStorage, key: str, size: int, offset: int = 0) -> Content:
    """Return `size` bytes of an object as they are."""
    return Content(size, lambda start, stop: read_range(storage, key, offset + start, stop - start))


def held_content(data: bytes) -> Content:
    """Return a few bytes that are at hand."""

    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        yield data[start:stop]

    return Content(len(data), read)


def joined(parts: Sequence[Content]) -> Content:
    """Return contents one behind the other."""

    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        for part in parts:
            if start < min(part.size, stop):
                async for chunk in part.read(max(start, 0), min(part.size, stop)):
                    yield chunk
            start, stop = start - part.size, stop - part.size

    return Content(sum(part.size for part in parts), read)


def result_validators(record: JobRecord) -> Validators:
    """Return the validators of the files of a result: the same in every process, for ever."""
    prefix = (record.result_prefix or "").encode()
    finished = record.finished_at or record.created_at
    began = record.started_at or finished
    return Validators(
        tag=hashlib.sha256(prefix).hexdigest()[:20],
        modified=min(finished, time.time()),  # section 8.8.2.1: not in the future
        dated=record.attempt == 1 or int(began) < int(finished),
    )


class _Cutter:
    """Cuts a stream of bytes into pieces of given lengths, one after the other."""

    def __init__(self, chunks: AsyncIterator[bytes]) -> None:
        self._chunks = chunks
        self._rest = memoryview(b"")

    async def cut(self, length: int) -> AsyncIterator[bytes]:
        """Yield the next `length` bytes, or fewer where the stream ends."""
        while length > 0:
            if not self._rest:
                chunk = await anext(self._chunks, b"")
                if not chunk:
                    return
                self._rest = memoryview(chunk)
            piece, self._rest = self._rest[:length], self._rest[length:]
            length -= len(piece)
            yield bytes(piece)


class _Kept:
    """Chunks that are read the first time they are asked for, and kept for the next times."""

    def __init__(self, read: Callable[[], AsyncIterator[bytes]]) -> None:
        self._read = read
        self._chunks: list[bytes] | None = None

    async def __call__(self) -> AsyncIterator[bytes]:
        if self._chunks is None:
            self._chunks = [chunk async for chunk in self._read()]
        for chunk in self._chunks:
            yield chunk


@dataclass(frozen=True, slots=True)
class ResultFiles:
    """The stored files of a finished job.

    Attributes
    ----------
    storage : ObjectStorage
    shapes, cameras, translations : StoredArray
    faces : StoredArray or None
        None where no faces were sent.
    validators : Validators
        Different for each run of the job; its time is the time stamp of archive members.
    bounds : dict
        Ranges of the shapes by how many frames are taken, kept because finding them reads all.
    """

    storage: ObjectStorage
    shapes: StoredArray
    cameras: StoredArray
    translations: StoredArray
    faces: StoredArray | None
    validators: Validators
    bounds: dict[int, Bounds] = field(default_factory=dict)

    @classmethod
    async def open(
        cls, storage: ObjectStorage, prefix: str, *, faces: bool, validators: Validators
    ) -> ResultFiles:
        """Look at the files under a result prefix.

        Raises
        ------
        worker.storage.ObjectMissing
            The result has been removed.
        """
        names = ARRAYS if faces else ARRAYS[:3]
        opened = await asyncio.gather(*(open_array(storage, prefix + name) for name in names))
        shapes, cameras, translations, *rest = opened
        faces_array = rest[0] if rest else None
        return cls(storage, shapes, cameras, translations, faces_array, validators)

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return self.shapes.shape[0]

    @property
    def points(self) -> int:
        """N, the number of points."""
        return self.shapes.shape[1]

    @property
    def face_count(self) -> int:
        """F, the number of triangles; 0 without faces."""
        return self.faces.shape[0] if self.faces else 0

    # Arrays

    def arrays(self) -> dict[str, StoredArray]:
        """Return the arrays by the names of their files."""
        found = {
            "shapes.npy": self.shapes,
            "cameras.npy": self.cameras,
            "translations.npy": self.translations,
        }
        if self.faces is not None:
            found["faces.npy"] = self.faces
        return found

    def array(self, array: StoredArray, name: str) -> Download:
        """Answer with one of the arrays, as NumPy reads it."""
        content = stored_content(self.storage, array.key, array.size)
        return Download(content, name=name, validators=self.validators)

    # One frame

    def frame(self, t: int, name: str) -> Download:
        """Answer with frame t as a binary little-endian PLY."""
        block = self._vertex_block
        vertices = stored_content(
            self.storage, self.shapes.key, block, self.shapes.offset + t * block
        )
        content = joined([held_content(self._ply_header()), vertices, self._faces_content()])
        return Download(content, name=name, validators=self.validators)

    def _faces_content(self) -> Content:
        """Return the triangles as a PLY holds them, made from any row on."""
        faces = self.faces
        if faces is None:
            return held_content(b"")
        row = faces.dtype.itemsize * 3

        async def read(start: int, stop: int) -> AsyncIterator[bytes]:
            first, last = start // FACE_BYTES, -(-stop // FACE_BYTES)
            position = first * FACE_BYTES
            rows = read_range(
                self.storage, faces.key, faces.offset + first * row, (last - first) * row
            )
            async for chunk in rows:
                block = ply_face_block(np.frombuffer(chunk, faces.dtype).reshape(-1, 3))
                yield block[max(start - position, 0) : stop - position]
                position += len(block)

        return Content(FACE_BYTES * self.face_count, read)

    def _ply_header(self) -> bytes:
        return ply_header(self.points, self.face_count)

    def ply_size(self) -> int:
        """Return the length in bytes of the PLY of any frame."""
        return len(self._ply_header()) + self._vertex_block + FACE_BYTES * self.face_count

    @property
    def _vertex_block(self) -> int:
        return VERTEX_BYTES * self.points

    async def _ply(
        self, vertices: _Cutter, faces: Callable[[], AsyncIterator[bytes]]
    ) -> AsyncIterator[bytes]:
        """Yield a PLY with the vertices that come next."""
        yield self._ply_header()
        async for chunk in vertices.cut(self._vertex_block):
            yield chunk
        async for chunk in faces():
            yield chunk

    async def _face_blocks(self) -> AsyncIterator[bytes]:
        if self.faces is None:
            return
        start, end = self.faces.offset, self.faces.size
        async for chunk in read_range(self.storage, self.faces.key, start, end - start):
            yield ply_face_block(np.frombuffer(chunk, self.faces.dtype).reshape(-1, 3))

    # Animation

    async def animation(self, options: GlbOptions, name: str) -> Download:
        """Answer with the whole sequence as an animated GLB.

        Raises
        ------
        smsr.errors.AnimationTooLarge
            A GLB cannot hold so much.
        """
        made = await to_thread.run_sync(self._glb, options)
        content = Content(
            made.size, lambda start, stop: iterate_in_threadpool(made.pieces(start, stop))
        )
        # Each version of the writer and each choice of options makes other bytes.
        kind = hashlib.sha256(f"{smsr.__version__} {options}".encode()).hexdigest()[:12]
        validators = replace(self.validators, tag=f"{self.validators.tag}-{kind}", dated=False)
        return Download(content, name=name, validators=validators, media_type="model/gltf-binary")

    def _glb(self, options: GlbOptions) -> Glb:
        """Look at the shapes, once for each way to take frames of them."""
        shapes, faces = self.shapes, self.faces
        row = shapes.dtype.itemsize * 3

        def read(start: int, stop: int) -> NDArray[Any]:
            data = self.storage.get_range(
                shapes.key, shapes.offset + start * row, (stop - start) * row
            )
            return np.frombuffer(data, shapes.dtype).reshape(-1, 3)

        size = self.cameras.dtype.itemsize * 6
        camera = self.storage.get_range(self.cameras.key, self.cameras.offset, size)
        triangles = None
        if faces is not None:
            data = self.storage.get_range(faces.key, faces.offset, faces.size - faces.offset)
            triangles = np.frombuffer(data, faces.dtype).reshape(-1, 3)
        made = Glb(
            read,
            frames=self.frames,
            points=self.points,
            camera=np.frombuffer(camera, self.cameras.dtype).reshape(2, 3),
            faces=triangles,
            options=options,
            bounds=self.bounds.get(options.every),
        )
        if len(self.bounds) < _KEPT_BOUNDS:
            self.bounds[options.every] = made.bounds
        return made

    # Archives

    def archive(self, members: list[Member], name: str) -> Download:
        """Answer with a stored ZIP of `npz_members` or `ply_members`."""
        content = Content(
            archive_size(members),
            lambda _start, _stop: stream_archive(members, self.validators.modified),
            seekable=False,
        )
        return Download(
            content, name=name, validators=self.validators, media_type="application/zip"
        )

    def npz_members(self) -> list[Member]:
        """Return the members of result.npz, which are the stored files themselves."""
        return [self._array_member(name, array) for name, array in self.arrays().items()]

    def _array_member(self, name: str, array: StoredArray) -> Member:
        return Member(name, array.size, lambda: read_range(self.storage, array.key, 0, array.size))

    def ply_members(self) -> list[Member]:
        """Return the members of frames.zip: every frame, numbered so that names sort."""
        size = self.ply_size()
        digits = max(4, len(str(self.frames - 1)))
        # An archive is read in order, so one pass over the shapes serves all frames.
        length = self._vertex_block * self.frames
        vertices = _Cutter(read_range(self.storage, self.shapes.key, self.shapes.offset, length))
        faces = _Kept(self._face_blocks) if self._keeps_faces else self._face_blocks
        return [
            Member(f"frame_{t:0{digits}d}.ply", size, lambda: self._ply(vertices, faces))
            for t in range(self.frames)
        ]

    @property
    def _keeps_faces(self) -> bool:
        """Whether faces are few enough to be held while an archive is sent."""
        return FACE_BYTES * self.face_count <= WINDOW_BYTES


class OpenResults:
    """Results that were looked at lately, so that a frame of one costs one read.

    Parameters
    ----------
    storage : ObjectStorage
    capacity : int
        How many results are remembered; each takes a few hundred bytes.
    """

    def __init__(self, storage: ObjectStorage, capacity: int = 1000) -> None:
        self._storage = storage
        self._capacity = capacity
        self._opened: dict[str, ResultFiles] = {}

    async def open(self, record: JobRecord) -> ResultFiles:
        """Return the files of a job that succeeded.

        Raises
        ------
        worker.storage.ObjectMissing
            The result has been removed.
        """
        prefix = record.result_prefix
        if prefix is None:
            raise ObjectMissing(f"job {record.id} has no result")
        files = self._opened.pop(prefix, None) or await ResultFiles.open(
            self._storage,
            prefix,
            faces="faces" in record.inputs,
            validators=result_validators(record),
        )
        self._opened[prefix] = files  # at the end: dictionaries keep their order
        while len(self._opened) > self._capacity:
            del self._opened[next(iter(self._opened))]
        return files


class Download(Response):
    """A file of known length, or a range of it, streamed on conditions (RFC 9110).

    Parameters
    ----------
    content : Content
    name : str
        File name offered to the client.
    validators : Validators
    media_type : str
    sha256 : str, optional
        Hexadecimal digest of the whole file, sent as Repr-Digest (RFC 9530).
    inline : bool
        Whether a browser may show it rather than save it.
    """

    def __init__(
        self,
        content: Content,
        *,
        name: str,
        validators: Validators,
        media_type: str = "application/octet-stream",
        sha256: str | None = None,
        inline: bool = False,
    ) -> None:
        headers = validators.headers | {
            "Content-Disposition": disposition(name, inline=inline),
            "Accept-Ranges": "bytes" if content.seekable else "none",
            # To be kept by the client alone, and asked for again: a retry makes a new result.
            "Cache-Control": "private, no-cache",
        }
        if sha256 is not None:
            digest = base64.b64encode(bytes.fromhex(sha256)).decode()
            headers["Repr-Digest"] = f"sha-256=:{digest}:"
        super().__init__(media_type=media_type, headers=headers)
        del self.headers["content-length"]
        self._content = content
        self._validators = validators

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with what the conditions and the range of the request ask for.

        Raises
        ------
        Problem
            A precondition fails, or the range is outside of the file.
        """
        headers = Headers(scope=scope)
        content = self._content
        size = content.size
        try:
            self._validators.check(headers)
            part = None
            # Section 14.2: a range means something with GET only.
            if scope["method"] == "GET" and content.seekable and "range" in headers:
                part = (
                    wanted_range(headers, size) if self._validators.allow_range(headers) else None
                )
        except NotModified:
            kept = ("etag", "last-modified", "cache-control")
            fields = {name: self.headers[name] for name in kept}
            await Response(status_code=304, headers=fields)(scope, receive, send)
            return
        except PreconditionFailed:
            raise Problem(
                "precondition-failed",
                "The file is another than the one that the request names.",
                headers=self._validators.headers,
            ) from None
        except Unsatisfiable:
            raise Problem(
                "range-not-satisfiable",
                f"The file has {size} bytes, and the range begins behind them.",
                headers={"Content-Range": f"bytes */{size}"} | self._validators.headers,
                size=size,
            ) from None
        status = 200
        if part is not None:
            status = 206
            self.headers["content-range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
        wanted = range(size) if part is None else part
        self.headers["content-length"] = str(len(wanted))
        if scope["method"] == "HEAD":
            start = {"status": status, "headers": self.raw_headers}
            await send({"type": "http.response.start", **start})
            await send({"type": "http.response.body", "body": b""})
            return
        streamed = StreamingResponse(content.read(wanted.start, wanted.stop), status)
        streamed.raw_headers = self.raw_headers
        await streamed(scope, receive, send)


_MEDIA_TYPE = re.compile(r"[A-Za-z0-9!#$&^_.+-]+/[A-Za-z0-9!#$&^_.+-]+")


def safe_media_type(sent: str | None) -> str:
    """Return the type that a client gave a file, or that of any bytes where it gave none."""
    if sent is None or not _MEDIA_TYPE.fullmatch(sent):
        return "application/octet-stream"
    return sent


def disposition(name: str, *, inline: bool = False) -> str:
    """Return a Content-Disposition with a file name of any characters (RFC 6266)."""
    kind = "inline" if inline else "attachment"
    plain = "".join(c if c.isascii() and c.isprintable() and c not in '"\\%' else "_" for c in name)
    extended = "" if plain == name else f"; filename*=utf-8''{quote(name, safe='')}"
    return f'{kind}; filename="{plain}"{extended}'


def diagnostics_of(report: bytes) -> Mapping[str, Any]:
    """Return the diagnostics in a report.json."""
    parsed: Mapping[str, Any] = json.loads(report)
    return parsed
