"""Receiving a job: a multipart body streamed to the object storage (RFC 7578).

No part is held in memory or in a temporary file. The first bytes of a file are looked at before
any of them is stored, and whatever ends an upload early (a refusal, a client that goes away, a
failing storage) leaves nothing behind. What a killed process leaves has no job record and is
removed by `worker.maintenance`.
"""

from __future__ import annotations

import re
from contextlib import aclosing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from anyio import CancelScope, to_thread
from multipart import (
    MultipartError,
    MultipartSegment,
    ParserLimitReached,
    PushMultipartParser,
    parse_options_header,
)

from service.bodies import Body, json_object
from service.digests import BodyDigests
from service.problems import Problem
from service.submissions import (
    SETTING_BYTES,
    SETTINGS,
    JobSettings,
    Submission,
    discard_uploads,
    read_settings,
)
from smsr.files import HEAD_BYTES, Beginning, check_prefix
from smsr.measurements import check_shape
from smsr.metrics import as_shapes
from smsr.options import parse
from worker.options import JobOptions
from worker.records import InputFile, upload_key

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Mapping

    from starlette.requests import Request

    from smsr.files import Role
    from worker.settings import Settings
    from worker.storage import Sink

FILES: tuple[Role, ...] = ("measurements", "ground_truth", "faces")
PARTS = (*FILES, "options", *SETTINGS)

OPTIONS_BYTES = 64 * 1024
FRAMING_BYTES = 128 * 1024
"""What boundaries, part headers and settings may add to the files and the options."""

BLOCK_BYTES = 512 << 10
"""How much is parsed, hashed and written at once: it is in the processor's cache all the while."""

_NAME_LENGTH = 150


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """What an upload may be.

    Attributes
    ----------
    bytes : int
        Of all files together.
    array_bytes : int
        Of each array, once decompressed.
    idle_seconds : float
        Silence after which an upload is given up.
    """

    bytes: int
    array_bytes: int
    idle_seconds: float = 60.0

    @property
    def body_bytes(self) -> int:
        """Largest body: the files, the options and what separates them."""
        return self.bytes + OPTIONS_BYTES + FRAMING_BYTES

    def too_large(self) -> Problem:
        """Return the refusal of more than this."""
        return Problem(
            "upload-too-large",
            f"The files of a job may have {self.bytes} bytes ({self.bytes / 2**30:.3g} GiB) "
            "together.",
            limit=self.bytes,
        )


async def receive_submission(
    request: Request,
    job_id: str,
    storage: Sink,
    limits: UploadLimits,
    operator: Settings | None = None,
    *,
    checked: bool = True,
) -> Submission:
    """Read the body of a submission and store its files.

    Parameters
    ----------
    request : Request
        Its body is read here, once.
    job_id : str
        Names the objects.
    storage : Sink
    limits : UploadLimits
    operator : Settings, optional
        Bounds the settings that a job may have.
    checked : bool
        Whether files that cannot be used are refused; of others T and N stay unknown.

    Raises
    ------
    Problem, smsr.errors.SmsrError
        The submission is refused; nothing of it is left in the storage.
    starlette.requests.ClientDisconnect
        The client went away; nothing is left either.
    """
    boundary = _boundary(request)
    announced = request.headers.get("content-length", "")
    if announced.isdecimal() and int(announced) > limits.body_bytes:
        raise limits.too_large()
    upload = _Upload(request, boundary, job_id, storage, limits, operator, checked=checked)
    try:
        return await upload.receive()
    except BaseException:
        # Shielded: a cancelled request cleans up as well.
        with CancelScope(shield=True):
            await discard_uploads(storage, job_id)
        raise


class _Upload:
    """One body on its way."""

    def __init__(
        self,
        request: Request,
        boundary: str,
        job_id: str,
        storage: Sink,
        limits: UploadLimits,
        operator: Settings | None,
        *,
        checked: bool,
    ) -> None:
        self._request = request
        self._job_id = job_id
        self._storage = storage
        self._limits = limits
        self._left = limits.bytes
        self._operator = operator
        self._checking = checked
        self._digests = BodyDigests.of(request.headers)
        self._options: JobOptions | None = None
        self._given: dict[str, str] = {}
        self._settings = JobSettings()
        self._inputs: dict[Role, InputFile] = {}
        self._heads: dict[Role, bytes] = {}
        try:
            # Not strict: strict parsing refuses a line break behind the last boundary whenever it
            # happens to arrive in a packet of its own.
            self._parser = PushMultipartParser(boundary, max_segment_count=len(PARTS) + 1)
        except MultipartError as error:
            raise _malformed(error) from None

    async def receive(self) -> Submission:
        """Take the parts in the order in which they come."""
        async with aclosing(self._events()) as events:
            async for event in events:
                # The body of a part is consumed below, so a part begins here.
                part = cast("MultipartSegment", event)
                role = self._role(part)
                if role == "options":
                    self._options = parse(JobOptions, await _read_options(_body(events)))
                elif role in SETTINGS:
                    self._given[role] = await _read_setting(role, _body(events))
                    self._settings = read_settings(self._given, self._operator, texts=True)
                else:
                    await self._store(cast("Role", role), part, _body(events))
        if "measurements" not in self._inputs:
            raise Problem(
                "missing-measurements",
                "The body has no part `measurements` with a file. "
                + (f"It has {', '.join(self._inputs)}." if self._inputs else "It has no file."),
            )
        options = self._options or JobOptions()
        frames, points = self._check_together(options) if self._checking else (None, None)
        return Submission(options, self._inputs, frames, points, self._settings)

    async def _events(self) -> AsyncGenerator[MultipartSegment | bytes | None, None]:
        """Yield what the parser finds: a segment, its bytes, None at its end, and so on."""
        body = Body(self._request, self._limits.idle_seconds)
        received = 0
        try:
            # The first blocks are small, so that an unusable file is refused at once.
            while block := await body.block(
                HEAD_BYTES if received < 4 * HEAD_BYTES else BLOCK_BYTES
            ):
                received += len(block)
                if received > self._limits.body_bytes:
                    raise self._limits.too_large()
                if self._digests:
                    await to_thread.run_sync(self._digests.update, block)
                for event in self._parser.parse(block):
                    yield event
            self._parser.close()
            self._digests.verify()
        except MultipartError as error:
            raise _malformed(error) from None

    def _role(self, segment: MultipartSegment) -> str:
        """Return the name of a part, checked."""
        name = segment.name or ""
        if name not in PARTS:
            shown = name if len(name) <= 60 else name[:57] + "..."
            raise Problem(
                "unknown-part",
                f"There is no part {shown!r}. Parts are {', '.join(PARTS)}.",
                part=shown,
                parts=list(PARTS),
            )
        given = name in self._inputs or name in self._given
        if given or (name == "options" and self._options is not None):
            raise Problem("duplicate-part", f"The part {name!r} was sent twice.", part=name)
        return name

    async def _store(
        self, role: Role, segment: MultipartSegment, body: AsyncIterator[bytes]
    ) -> None:
        """Check the beginning of a file and stream the file to the storage."""
        name = safe_name(segment.filename, role)
        chunks = self._counted(body)
        if self._checking:
            chunks = self._checked(role, name, chunks)
        stored = await self._storage.put_stream(upload_key(self._job_id, role), chunks)
        self._inputs[role] = InputFile(
            key=stored.key,
            name=name,
            bytes=stored.bytes,
            sha256=stored.sha256,
            content_type=_content_type(segment),
        )

    async def _counted(self, body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Pass a file on as long as all files together are within the limit."""
        async for chunk in body:
            self._left -= len(chunk)
            if self._left < 0:
                raise self._limits.too_large()
            yield chunk

    async def _checked(
        self, role: Role, name: str, body: AsyncIterator[bytes]
    ) -> AsyncIterator[bytes]:
        """Hold a file back until its beginning has been looked at."""
        head, size = b"", 0
        async for chunk in body:
            if role not in self._heads:
                head += chunk
                if len(head) < HEAD_BYTES:
                    continue
                self._heads[role] = head[:HEAD_BYTES]
                self._check(role, name, None)
                chunk = head
            size += len(chunk)
            yield chunk
        if role in self._heads:
            self._check(role, name, size)
            return
        self._heads[role] = head
        self._check(role, name, len(head))
        yield head

    def _check(self, role: Role, name: str, size: int | None) -> Beginning:
        """Refuse a file by its first bytes, and by its size once that is known."""
        return check_prefix(
            self._heads[role],
            size,
            name,
            role,
            self._limits.array_bytes,
            layout=self._options.layout if self._options else None,
        )

    def _check_together(self, options: JobOptions) -> tuple[int, int] | tuple[None, None]:
        """Refuse files that do not fit each other or the options; return T and N where known."""
        files = {role: (file.name, file.bytes) for role, file in self._inputs.items()}
        return check_files(self._heads, files, options, self._limits.array_bytes)


def check_files(
    heads: Mapping[Role, bytes],
    files: Mapping[Role, tuple[str, int]],
    options: JobOptions,
    array_bytes: int,
) -> tuple[int, int] | tuple[None, None]:
    """Refuse files that do not fit each other or the options; return T and N where known.

    Parameters
    ----------
    heads : mapping of str to bytes
        The first bytes by role, as `check_prefix` takes them.
    files : mapping of str to (str, int)
        Names and sizes.
    options : JobOptions
    array_bytes : int
        Largest array, decompressed.

    Raises
    ------
    smsr.errors.SmsrError
    """
    found = {
        role: check_prefix(heads[role], size, name, role, array_bytes, layout=options.layout)
        for role, (name, size) in files.items()
    }
    measurements = found["measurements"]
    if measurements.shape is None or measurements.dtype is None:
        return None, None
    shape = check_shape(measurements.shape, measurements.dtype, options.layout)
    truth = found.get("ground_truth")
    if truth is not None and truth.shape is not None and truth.dtype is not None:
        # A broadcast zero has the shape without the memory.
        as_shapes(np.broadcast_to(np.zeros((), truth.dtype), truth.shape), *shape)
    return shape


async def _body(
    events: AsyncIterator[MultipartSegment | bytes | None],
) -> AsyncIterator[bytes]:
    """Yield the bytes of the part that has just begun."""
    async for event in events:
        if event is None:
            return
        yield cast("bytes", event)


async def _read_options(body: AsyncIterator[bytes]) -> dict[str, Any]:
    """Read the part with the options."""
    text = await _read_text(body, OPTIONS_BYTES)
    if text is None:
        raise Problem("malformed-options", f"The options are longer than {OPTIONS_BYTES} bytes.")
    return json_object(text, "malformed-options", "The options are")


async def _read_setting(name: str, body: AsyncIterator[bytes]) -> str:
    """Read a part with one setting."""
    text = await _read_text(body, SETTING_BYTES)
    try:
        if text is not None:
            return text.decode("utf-8")
        detail = f"{name}: longer than {SETTING_BYTES} bytes."
    except UnicodeDecodeError:
        detail = f"{name}: not UTF-8."
    raise Problem("invalid-setting", detail, setting=name, settings=list(SETTINGS))


async def _read_text(body: AsyncIterator[bytes], most: int) -> bytearray | None:
    """Read a small part whole; None where it is larger."""
    text = bytearray()
    async for chunk in body:
        text += chunk
        if len(text) > most:
            return None
    return text


def _boundary(request: Request) -> str:
    """Return the boundary of a multipart/form-data body."""
    given = request.headers.get("content-type", "")
    kind, parameters = parse_options_header(given)
    if kind != "multipart/form-data":
        raise Problem(
            "unsupported-media-type",
            "A job is sent as multipart/form-data, or as JSON that names uploads, not as "
            f"{kind or 'a body of unknown type'}.",
            headers={"Accept": "multipart/form-data, application/json"},
        )
    boundary: str = parameters.get("boundary", "")
    if not boundary:
        raise Problem("malformed-multipart", "The Content-Type names no boundary.")
    return boundary


def _malformed(error: MultipartError) -> Problem:
    if isinstance(error, ParserLimitReached):
        return Problem("malformed-multipart", f"The body has too many parts or headers: {error}.")
    return Problem("malformed-multipart", f"The body is no valid multipart/form-data: {error}.")


def safe_name(given: str | None, role: str) -> str:
    """Return a file name for people: no folders, no control characters, not endless."""
    name = re.split(r"[/\\]", given or "")[-1]
    name = "".join(c for c in name if c.isprintable()).strip()
    if len(name) > _NAME_LENGTH:  # keep the suffix, it tells the format
        name = name[: _NAME_LENGTH - 20] + name[-20:]
    return name or role


def _content_type(segment: MultipartSegment) -> str | None:
    kind = segment.content_type or ""
    return kind if re.fullmatch(r"[\w.+-]{1,60}/[\w.+-]{1,60}", kind) else None
