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
from array import array
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from anyio import CapacityLimiter, to_thread
from starlette.concurrency import iterate_in_threadpool
from starlette.datastructures import Headers
from starlette.responses import Response, StreamingResponse

import smsr
from service.archives import LAYOUT, Members, single
from service.archives import archive as zip_archive
from service.conditional import (
    NotModified,
    PreconditionFailed,
    Unsatisfiable,
    Validators,
    wanted_range,
)
from service.content import (
    WINDOW_BYTES,
    Content,
    Windows,
    held_content,
    joined,
    read_range,
    stored_content,
)
from service.problems import Problem
from smsr import figures
from smsr.figures import FigureSource
from smsr.files.glb import Bounds, Glb, GlbOptions
from smsr.files.npy import HEADER_BYTES, parse_header
from smsr.files.ply import FACE_BYTES, VERTEX_BYTES, ply_face_block, ply_header
from worker.checksums import CHECKSUMS, FRAME_CHECKSUMS, parse_checksums
from worker.storage import ObjectMissing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence

    from numpy.typing import NDArray
    from starlette.types import Receive, Scope, Send

    from smsr.figures import FigureFormat, FigureName
    from smsr.files.glb import ImageV
    from worker.checksums import FileChecksum
    from worker.records import JobRecord
    from worker.storage import ObjectStorage

ARRAYS = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy")
"""Arrays of a result as the worker stores them; faces only where faces were sent."""

_KEPT_BOUNDS = 4


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


def result_validators(record: JobRecord) -> Validators:
    """Return the validators of the files of a result: the same in every process, for ever."""
    prefix = (record.result_prefix or "").encode()
    finished = record.finished_at or record.created_at
    began = record.started_at or finished
    return Validators(
        tag=hashlib.sha256(prefix).hexdigest()[:20],
        modified=finished,
        dated=record.attempt == 1 or int(began) < int(finished),
    )


class _Faces:
    """The triangles of a result as a PLY holds them, made from any row on.

    Few ones are kept once they were read: an archive of frames repeats them for each frame.
    """

    def __init__(self, storage: ObjectStorage, faces: StoredArray) -> None:
        self._storage = storage
        self._faces = faces
        self._kept: bytes | None = None
        self.content = Content(FACE_BYTES * faces.shape[0], self._read)

    async def _read(self, start: int, stop: int) -> AsyncIterator[bytes]:
        if self.content.size > WINDOW_BYTES:
            async for block in self._convert(start, stop):
                yield block
            return
        if self._kept is None:
            blocks = [block async for block in self._convert(0, self.content.size)]
            self._kept = b"".join(blocks)
        yield self._kept[start:stop]

    async def _convert(self, start: int, stop: int) -> AsyncIterator[bytes]:
        faces = self._faces
        row = faces.dtype.itemsize * 3
        first, last = start // FACE_BYTES, -(-stop // FACE_BYTES)
        position = first * FACE_BYTES
        begin, length = faces.offset + first * row, (last - first) * row
        async for chunk in read_range(self._storage, faces.key, begin, length):
            block = ply_face_block(np.frombuffer(chunk, faces.dtype).reshape(-1, 3))
            yield block[max(start - position, 0) : stop - position]
            position += len(block)


@dataclass(frozen=True, slots=True)
class ResultFiles:
    """The stored files of a finished job.

    Attributes
    ----------
    storage : ObjectStorage
    prefix : str
        Of the objects of the result.
    shapes, cameras, translations : StoredArray
    faces : StoredArray or None
        None where no faces were sent.
    checksums : mapping of str to FileChecksum
        By file; empty for results of earlier versions, whose archives cannot be resumed.
    validators : Validators
        Different for each run of the job; its time is the time stamp of archive members.
    bounds : dict
        Ranges of the shapes by how many frames are taken, kept because finding them reads all.
    """

    storage: ObjectStorage
    prefix: str
    shapes: StoredArray
    cameras: StoredArray
    translations: StoredArray
    faces: StoredArray | None
    checksums: Mapping[str, FileChecksum]
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
        try:
            checksums = parse_checksums(await to_thread.run_sync(storage.get, prefix + CHECKSUMS))
        except ObjectMissing:
            checksums = {}
        return cls(
            storage, prefix, shapes, cameras, translations, faces_array, checksums, validators
        )

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

    def array(self, file: str, name: str) -> Download:
        """Answer with one of the arrays, as NumPy reads it."""
        checksum = self.checksums.get(file)
        return Download(
            self._stored(self.arrays()[file]),
            name=name,
            validators=self.validators,
            sha256=None if checksum is None else checksum.sha256,
        )

    def _stored(self, array: StoredArray) -> Content:
        return stored_content(self.storage, array.key, array.size)

    # One frame

    def frame(self, t: int, name: str) -> Download:
        """Answer with frame t as a binary little-endian PLY."""
        content = self._open_frames(range(t, t + 1))(t)
        return Download(content, name=name, validators=self.validators)

    def _open_frames(self, frames: range) -> Callable[[int], Content]:
        """Return what gives the PLY of each of these frames; in order they are one pass."""
        header = held_content(ply_header(self.points, self.face_count))
        block = VERTEX_BYTES * self.points

        def begin(t: int) -> int:
            return self.shapes.offset + t * block

        windows = Windows(self.storage, self.shapes.key, begin(frames.start), begin(frames.stop))
        faces = [] if self.faces is None else [_Faces(self.storage, self.faces).content]

        def content(t: int) -> Content:
            vertices = Content(block, lambda i, j: windows.read(begin(t) + i, begin(t) + j))
            return joined([header, vertices, *faces])

        return content

    # Views

    def animation(self, options: GlbOptions, name: str) -> Download:
        """Answer with the whole sequence as an animated GLB.

        It is refused with `smsr.errors.AnimationTooLarge` where a GLB cannot hold so much.
        """

        async def make() -> Content:
            made = await to_thread.run_sync(self._glb, options)
            return Content(
                made.size, lambda start, stop: iterate_in_threadpool(made.pieces(start, stop))
            )

        validators = self._validators_of(options)
        return Download(make, name=name, validators=validators, media_type="model/gltf-binary")

    def figure(
        self,
        figure: FigureName,
        form: FigureFormat,
        image_v: ImageV,
        *,
        name: str,
        drawers: CapacityLimiter,
    ) -> Download:
        """Answer with a picture, drawn in a thread of `drawers`.

        It is refused with `smsr.errors.FiguresUnavailable` or `smsr.errors.NothingToDraw`.
        """

        def draw() -> bytes:
            return figures.draw(figure, self._figure_source(image_v), form)

        async def make() -> Content:
            return held_content(await to_thread.run_sync(draw, limiter=drawers))

        return Download(
            make,
            name=name,
            validators=self._validators_of((figure, form, image_v)),
            media_type="image/png" if form == "png" else "image/svg+xml",
            inline=True,
        )

    def _validators_of(self, kind: object) -> Validators:
        """Each version of the writers and each choice makes other bytes."""
        digest = hashlib.sha256(f"{smsr.__version__} {kind}".encode()).hexdigest()[:12]
        return replace(self.validators, tag=f"{self.validators.tag}-{digest}", dated=False)

    def _glb(self, options: GlbOptions) -> Glb:
        """Look at the shapes, once for each way to take frames of them."""
        made = Glb(
            self._shape_rows,
            frames=self.frames,
            points=self.points,
            camera=self._numbers(self.cameras)[0],
            translation=self._numbers(self.translations)[0],
            faces=None if self.faces is None else self._numbers(self.faces),
            options=options,
            bounds=self.bounds.get(options.every),
        )
        if len(self.bounds) < _KEPT_BOUNDS:
            self.bounds[options.every] = made.bounds
        return made

    def _figure_source(self, image_v: ImageV) -> FigureSource:
        few = self.face_count <= figures.MOST_TRIANGLES
        return FigureSource(
            json.loads(
                self.storage.get(self.shapes.key.removesuffix("shapes.npy") + "report.json")
            ),
            self._numbers(self.cameras),
            self._numbers(self.translations),
            self.points,
            self._shape_rows,
            self._numbers(self.faces) if self.faces is not None and few else None,
            image_v,
        )

    def _shape_rows(self, start: int, stop: int) -> NDArray[Any]:
        """Read rows of the shapes as a (T N, 3) matrix."""
        row = self.shapes.dtype.itemsize * 3
        offset = self.shapes.offset + start * row
        data = self.storage.get_range(self.shapes.key, offset, (stop - start) * row)
        return np.frombuffer(data, self.shapes.dtype).reshape(-1, 3)

    def _numbers(self, array: StoredArray) -> NDArray[Any]:
        """Read a whole array of those that do not grow with T x N."""
        data = self.storage.get_range(array.key, array.offset, array.size - array.offset)
        return np.frombuffer(data, array.dtype).reshape(array.shape)

    # Archives

    def archive(self, groups: Sequence[Members], name: str) -> Download:
        """Answer with a stored ZIP of `npz_members` or `ply_members`."""
        validators = replace(self.validators, tag=f"{self.validators.tag}-{LAYOUT}")
        return Download(
            zip_archive(groups, self.validators.modified),
            name=name,
            validators=validators,
            media_type="application/zip",
        )

    def npz_members(self, prefix: str = "") -> list[Members]:
        """Return the members of result.npz, which are the stored files themselves."""
        crc32 = {name: found.crc32 for name, found in self.checksums.items()}
        return [
            single(prefix + name, self._stored(array), crc32.get(name))
            for name, array in self.arrays().items()
        ]

    async def ply_members(self) -> list[Members]:
        """Return the members of frames.zip: every frame, numbered so that names sort."""
        digits = max(4, len(str(self.frames - 1)))
        return [
            Members(
                count=self.frames,
                size=self._open_frames(range(0))(0).size,
                name=lambda t: f"frame_{t:0{digits}d}.ply",
                open=self._open_frames,
                checksums=await self._frame_checksums(),
            )
        ]

    async def _frame_checksums(self) -> Sequence[int] | None:
        """Return the CRC-32 of the PLY of each frame, four bytes in memory for each."""
        if not self.checksums:
            return None
        key = self.prefix + FRAME_CHECKSUMS
        stored = await open_array(self.storage, key)
        data = await self.storage.get_range_async(key, stored.offset, stored.size - stored.offset)
        return array("I", np.frombuffer(data, stored.dtype).astype("=u4").tobytes())


class OpenResults:
    """Results that were looked at lately, so that a frame of one costs one read.

    Parameters
    ----------
    storage : ObjectStorage
    capacity : int
        How many results are remembered; each takes a few hundred bytes.

    Attributes
    ----------
    drawers : CapacityLimiter
        Lets one figure at a time be drawn, so that those that wait occupy no thread.
    """

    def __init__(self, storage: ObjectStorage, capacity: int = 1000) -> None:
        self._storage = storage
        self._capacity = capacity
        self._opened: dict[str, ResultFiles] = {}
        self.drawers = CapacityLimiter(1)

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
    content : Content, or a callable that makes it
        It is made only where the client does not have it already.
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
        content: Content | Callable[[], Awaitable[Content]],
        *,
        name: str,
        validators: Validators,
        media_type: str = "application/octet-stream",
        sha256: str | None = None,
        inline: bool = False,
    ) -> None:
        seekable = not isinstance(content, Content) or content.seekable
        headers = validators.headers | {
            "Content-Disposition": disposition(name, inline=inline),
            "Accept-Ranges": "bytes" if seekable else "none",
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
        try:
            self._validators.check(headers)
            made = self._content
            content = made if isinstance(made, Content) else await made()
            size = content.size
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
