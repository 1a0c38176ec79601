"""Results as they are downloaded: views of the stored arrays, made while they stream.

`shapes.npy` holds float32, little endian, frame after frame, so the bytes of a frame are the vertex
block of a binary PLY, and an NPZ is a stored ZIP of the arrays as they are. Nothing is converted,
kept twice or held in memory, and every length is known before the first byte.
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from anyio import to_thread
from starlette.datastructures import Headers
from starlette.responses import Response, StreamingResponse

from service.archives import Member, archive_size, stream_archive
from smsr.files.npy import HEADER_BYTES, parse_header
from smsr.files.ply import FACE_BYTES, VERTEX_BYTES, ply_face_block, ply_header
from worker.storage import ObjectMissing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from starlette.types import Receive, Scope, Send

    from worker.records import JobRecord
    from worker.storage import ObjectStorage

ARRAYS = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy")
"""Arrays of a result as the worker stores them; faces only where faces were sent."""

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
    finished : float
        Unix seconds; the time stamp of archive members.
    tag : str
        Different for each run of the job.
    """

    storage: ObjectStorage
    shapes: StoredArray
    cameras: StoredArray
    translations: StoredArray
    faces: StoredArray | None
    finished: float
    tag: str

    @classmethod
    async def open(
        cls, storage: ObjectStorage, prefix: str, *, faces: bool, finished: float
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
        tag = prefix.rstrip("/").rpartition("/")[2]
        faces_array = rest[0] if rest else None
        return cls(storage, shapes, cameras, translations, faces_array, finished, tag)

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

    # One frame

    def frame(self, t: int, name: str) -> Download:
        """Answer with frame t as a binary little-endian PLY."""
        return Download(
            self.ply(t),
            size=self.ply_size(),
            name=name,
            tag=self.tag,
            media_type="application/octet-stream",
        )

    def _ply_header(self) -> bytes:
        return ply_header(self.points, self.face_count)

    def ply_size(self) -> int:
        """Return the length in bytes of the PLY of any frame."""
        return len(self._ply_header()) + self._vertex_block + FACE_BYTES * self.face_count

    def ply(self, frame: int) -> AsyncIterator[bytes]:
        """Yield frame t as a binary little-endian PLY."""
        start = self.shapes.offset + frame * self._vertex_block
        vertices = read_range(self.storage, self.shapes.key, start, self._vertex_block)
        return self._ply(_Cutter(vertices), self._face_blocks)

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

    # Archives

    def archive(self, members: list[Member], name: str) -> Download:
        """Answer with a stored ZIP of `npz_members` or `ply_members`."""
        return Download(
            stream_archive(members, self.finished),
            size=archive_size(members),
            name=name,
            tag=self.tag,
            media_type="application/zip",
        )

    def npz_members(self) -> list[Member]:
        """Return the members of result.npz, which are the stored files themselves."""
        arrays = {
            "shapes.npy": self.shapes,
            "cameras.npy": self.cameras,
            "translations.npy": self.translations,
        }
        if self.faces is not None:
            arrays["faces.npy"] = self.faces
        return [self._array_member(name, array) for name, array in arrays.items()]

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
            finished=record.finished_at or record.created_at,
        )
        self._opened[prefix] = files  # at the end: dictionaries keep their order
        while len(self._opened) > self._capacity:
            del self._opened[next(iter(self._opened))]
        return files


class Download(StreamingResponse):
    """A file of known length, streamed; also the answer to HEAD and to If-None-Match.

    Parameters
    ----------
    chunks : async iterator of bytes
    size : int
        Content-Length.
    name : str
        File name offered to the client; ASCII letters, digits, dots and dashes only, so that it
        needs no quoting rules (RFC 6266, appendix D).
    tag : str
        Names the content: another run of the job has another tag (RFC 9110, section 8.8.3).
    media_type : str
    """

    def __init__(
        self, chunks: AsyncIterator[bytes], *, size: int, name: str, tag: str, media_type: str
    ) -> None:
        headers = {
            "Content-Length": str(size),
            "Content-Disposition": f'attachment; filename="{name}"',
            "ETag": f'"{tag}"',
            # To be kept by the client alone, and asked for again: a retry makes a new result.
            "Cache-Control": "private, no-cache",
        }
        super().__init__(chunks, media_type=media_type, headers=headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send headers, and the content where it is wanted."""
        known = Headers(scope=scope).get("if-none-match", "")
        tags = {tag.strip().removeprefix("W/") for tag in known.split(",")}
        if {"*", self.headers["etag"]} & tags:
            kept = {name: self.headers[name] for name in ("etag", "cache-control")}
            await Response(status_code=304, headers=kept)(scope, receive, send)
        elif scope["method"] == "HEAD":
            start = {"status": self.status_code, "headers": self.raw_headers}
            await send({"type": "http.response.start", **start})
            await send({"type": "http.response.body", "body": b""})
        else:
            await super().__call__(scope, receive, send)


def diagnostics_of(report: bytes) -> Mapping[str, Any]:
    """Return the diagnostics in a report.json."""
    parsed: Mapping[str, Any] = json.loads(report)
    return parsed
