"""Receiving uploads on their own: whole (PUT) or piece by piece (tus), and making jobs of them."""

from __future__ import annotations

import asyncio
import dataclasses
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, cast

from anyio import CancelScope, to_thread
from starlette.requests import ClientDisconnect

from service import quotas
from service.bodies import Body, read_json
from service.digests import BodyDigests
from service.problems import Problem
from service.submissions import SETTINGS, Submission, check_webhook, hash_of, read_settings
from service.uploads import FILES, UploadLimits, check_files
from smsr.errors import SmsrError
from smsr.files import HEAD_BYTES, check_prefix
from smsr.options import parse
from worker.options import JobOptions
from worker.storage import ObjectMissing, StorageError
from worker.uploads import (
    OffsetMismatch,
    Upload,
    UploadGone,
    UploadSuperseded,
    UploadUnfinished,
    UploadUsed,
    UploadWriter,
    beginning,
    folder_prefix,
    hand_over,
    seal,
    whole_key,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from starlette.requests import Request

    from service.context import Context
    from service.submissions import JobSettings
    from smsr.files import Role
    from worker.records import InputFile
    from worker.uploads import UploadStore

BLOCK_BYTES = 512 << 10
"""What is hashed and written at once: small enough to be in the processor's cache still."""
SAFE_BYTES = 8 << 20
"""What is made safe at once, while as much again arrives; a killed process loses both at most."""

ID_LENGTH = 32
_HOLD_MARGIN_SECONDS = 60.0


def limits_of(shared: Context) -> UploadLimits:
    """Return what an upload may be."""
    return UploadLimits(shared.settings.max_upload_bytes, shared.settings.max_array_bytes)


def unknown_upload(upload_id: str) -> Problem:
    """Return the refusal of a request for an upload that does not exist."""
    return Problem(
        "unknown-upload", f"There is no upload {upload_id}; it may have been deleted or expired."
    )


def _used(upload_id: str) -> Problem:
    return Problem("upload-used", f"A job has taken the upload {upload_id}; a file serves once.")


async def find(shared: Context, upload_id: str) -> Upload:
    """Return an upload of this request's owner.

    Raises
    ------
    Problem
        There is none, or it is another owner's: a client cannot tell which.
    """
    upload = await to_thread.run_sync(shared.uploads.get, shared.owner, upload_id)
    if upload is None:
        raise unknown_upload(upload_id)
    return upload


def check_head(head: bytes, size: int | None, upload: Upload, limits: UploadLimits) -> None:
    """Refuse a file that is usable for nothing, or not for what it is meant for.

    Raises
    ------
    SmsrError
    """
    roles = FILES if upload.role is None else (cast("Role", upload.role),)
    refusals: list[SmsrError] = []
    for role in roles:
        try:
            check_prefix(head, size, upload.name, role, limits.array_bytes)
        except SmsrError as error:
            refusals.append(error)
        else:
            return
    raise refusals[0]


async def discard(shared: Context, folder: str) -> None:
    """Remove the objects of an upload; where that fails, maintenance does it later."""
    with suppress(StorageError):
        await to_thread.run_sync(shared.storage.delete_prefix, folder_prefix(folder))


async def hold(shared: Context, upload: Upload) -> None:
    """Count the bytes of an upload as its owner's, as long as it is kept."""
    seconds = shared.uploads.ttl + _HOLD_MARGIN_SECONDS
    await quotas.hold(shared, upload.folder, upload.length, seconds)


async def receive_whole(request: Request, shared: Context, upload: Upload) -> bool:
    """Store the body of a PUT as an upload; return whether there was none of this id.

    Raises
    ------
    Problem, smsr.errors.SmsrError, starlette.requests.ClientDisconnect
        Nothing of the body is kept, and the upload is what it was.
    """
    limits, digests = limits_of(shared), BodyDigests.of(request.headers)
    announced = _content_length(request)
    if announced is not None and announced > limits.bytes:
        raise limits.too_large()
    store, body = shared.uploads, Body(request, limits.idle_seconds)
    await to_thread.run_sync(store.reserve, upload.folder)

    async def blocks() -> AsyncIterator[bytes]:
        renewed, size = time.monotonic(), 0
        while block := await body.block(BLOCK_BYTES):
            if size == 0:
                ended = len(block) < BLOCK_BYTES
                check_head(block[:HEAD_BYTES], len(block) if ended else None, upload, limits)
            size += len(block)
            if size > limits.bytes:
                raise limits.too_large()
            if digests:
                await to_thread.run_sync(digests.update, block)
            yield block
            if time.monotonic() - renewed > store.ttl / 4:
                renewed = time.monotonic()
                await to_thread.run_sync(store.reserve, upload.folder)
        if size == 0:
            check_head(b"", 0, upload, limits)

    try:
        stored = await shared.storage.put_stream(whole_key(upload.folder), blocks())
        digests.verify()
        whole = Upload(
            id=upload.id,
            owner=upload.owner,
            folder=upload.folder,
            name=upload.name,
            content_type=upload.content_type,
            role=upload.role,
            length=stored.bytes,
            offset=stored.bytes,
            key=stored.key,
            sha256=stored.sha256,
        )
        await hold(shared, whole)
        created, former = await to_thread.run_sync(store.replace, whole)
    except BaseException as error:
        # Shielded: a cancelled request cleans up as well.
        with CancelScope(shield=True):
            await discard(shared, upload.folder)
        if isinstance(error, UploadUsed):
            raise _used(upload.id) from None
        raise
    if former is not None:
        await quotas.drop(shared, former)
        await discard(shared, former)
    return created


def _content_length(request: Request) -> int | None:
    announced = request.headers.get("content-length", "")
    return int(announced) if announced.isdecimal() else None


async def receive_piece(request: Request, shared: Context, upload: Upload, offset: int) -> Upload:
    """Store the body of a request behind the bytes that an upload has; return what it is then.

    What had arrived when the connection broke is kept, unless a digest of the body was declared.

    Raises
    ------
    Problem
    smsr.errors.SmsrError
        The file cannot be used: the upload is removed.
    starlette.requests.ClientDisconnect
    """
    announced = _content_length(request)
    if announced is not None and announced > upload.length - offset:
        raise _too_long(upload)
    digests = BodyDigests.of(request.headers, tus=True)
    body = Body(request, limits_of(shared).idle_seconds)
    try:
        await hold(shared, upload)
        token = await to_thread.run_sync(shared.uploads.begin, upload, offset)
        piece = _Piece(shared, upload, offset, token, digests)
        return await piece.receive(body)
    except OffsetMismatch:
        raise await _mismatch(shared, upload, offset) from None
    except UploadGone:
        raise unknown_upload(upload.id) from None
    except UploadUsed:
        raise _used(upload.id) from None
    except UploadSuperseded:
        raise Problem(
            "upload-superseded", "A later request goes on with this upload, or it was deleted."
        ) from None
    except SmsrError:
        await remove(shared, upload.id)
        raise


async def _mismatch(shared: Context, upload: Upload, offset: int) -> Problem:
    found = await find(shared, upload.id)
    return Problem(
        "upload-offset-mismatch",
        f"The upload has {found.offset} bytes, and the request goes on at {offset}.",
        headers={"Upload-Offset": str(found.offset)},
        offset=found.offset,
    )


def _too_long(upload: Upload) -> Problem:
    return Problem(
        "upload-too-large",
        f"The upload was declared to have {upload.length} bytes, and the body goes beyond them.",
        limit=upload.length,
    )


async def remove(shared: Context, upload_id: str) -> bool:
    """Forget an upload and remove its objects; return whether there was one."""
    folder = await to_thread.run_sync(shared.uploads.delete, shared.owner, upload_id)
    if folder is None:
        return False
    shared.digests.forget(folder)
    await quotas.drop(shared, folder)
    await discard(shared, folder)
    return True


class _Piece:
    """One request on its way into an upload."""

    def __init__(
        self, shared: Context, upload: Upload, offset: int, token: int, digests: BodyDigests
    ) -> None:
        self._shared = shared
        self._upload = upload
        self._offset = offset
        self._token = token
        self._digests = digests
        self._writer = UploadWriter(
            shared.uploads, shared.storage, upload, token, offset, deferred=bool(digests)
        )
        self._sha256 = shared.digests.at(upload.folder, offset)
        self._head: bytes | None = None
        """The first bytes of the file until they have been looked at."""
        self._blocks: list[bytes] = []
        self._handed = offset
        self._writing: asyncio.Future[None] | None = None
        self._hashing: asyncio.Future[None] | None = None

    async def receive(self, body: Body) -> Upload:
        upload, shared = self._upload, self._shared
        await to_thread.run_sync(self._writer.check)
        if self._offset < min(HEAD_BYTES, upload.length):
            self._head = await to_thread.run_sync(
                beginning, shared.uploads, shared.storage, upload, self._offset
            )
        broken: Exception | None = None
        received = self._offset
        while broken is None:
            try:
                block = await body.block(BLOCK_BYTES)
            except (ClientDisconnect, Problem) as error:
                broken, block = error, body.rest()
            if not block:
                break
            received += len(block)
            if received > upload.length:
                raise _too_long(upload)
            self._look(block, received)
            await self._hash(block)
            self._blocks.append(block)
            if received - self._handed >= SAFE_BYTES:
                await self._write(received)
        await self._write(received)
        await self._settle()
        if broken is None and self._digests:
            self._digests.verify()
            await to_thread.run_sync(self._writer.commit)
        safe = self._writer.offset
        if self._sha256 is not None and (broken is None or not self._digests):
            shared.digests.keep(upload.folder, safe, self._sha256)
        if broken is not None:
            raise broken
        if safe == upload.length:
            await self._seal()
        return await find(shared, upload.id)

    def _look(self, block: bytes, received: int) -> None:
        """Check the beginning of the file once it is there."""
        if self._head is None:
            return
        self._head += block[: HEAD_BYTES - len(self._head)]
        if len(self._head) >= HEAD_BYTES or received == self._upload.length:
            check_head(self._head, self._upload.length, self._upload, limits_of(self._shared))
            self._head = None

    async def _hash(self, block: bytes) -> None:
        """Hash a block while the one after it arrives."""
        if self._hashing is not None:
            await self._hashing
        self._hashing = asyncio.ensure_future(to_thread.run_sync(self._update, block))

    def _update(self, block: bytes) -> None:
        if self._sha256 is not None:
            self._sha256.update(block)
        self._digests.update(block)

    async def _write(self, received: int) -> None:
        """Write the blocks that are held while others arrive."""
        if self._writing is not None:
            await self._writing
            self._writing = None
        if self._blocks:
            blocks, self._blocks, self._handed = self._blocks, [], received
            self._writing = asyncio.ensure_future(to_thread.run_sync(self._writer.write, blocks))

    async def _settle(self) -> None:
        """Wait for what is under way."""
        for task in (self._writing, self._hashing):
            if task is not None:
                await task

    async def _seal(self) -> None:
        shared = self._shared
        await seal(shared.uploads, shared.storage, self._upload, self._token, self._sha256)
        shared.digests.forget(self._upload.folder)


async def finish(shared: Context, upload: Upload) -> Upload:
    """Make an upload one object whose last request was killed before it could do so."""
    if upload.sha256 is not None or not upload.complete or upload.job is not None:
        return upload
    # What else may happen to it meanwhile, the caller will see.
    with suppress(UploadGone, UploadUsed, OffsetMismatch, UploadSuperseded):
        token = await to_thread.run_sync(shared.uploads.begin, upload, upload.length)
        await seal(shared.uploads, shared.storage, upload, token, None)
    return await find(shared, upload.id)


# Jobs made of uploads


@dataclass(frozen=True, slots=True)
class References:
    """A submission that names uploads, by role."""

    uploads: dict[Role, str]
    options: JobOptions
    settings: JobSettings

    @property
    def fingerprint(self) -> str:
        """What tells submissions apart; a job that has taken the uploads does not change it."""
        return hash_of(
            {
                "options": dataclasses.asdict(self.options),
                "settings": self.settings.model_dump(mode="json"),
                "uploads": self.uploads,
            }
        )


async def read_references(request: Request, shared: Context) -> References:
    """Read the JSON document of a submission.

    Raises
    ------
    Problem, smsr.errors.SmsrError
        The document is refused.
    """
    document = await read_json(request)
    ids = {role: _reference(role, document[role]) for role in FILES if role in document}
    unknown = [name for name in document if name not in (*FILES, "options", *SETTINGS)]
    if unknown:
        raise Problem(
            "unknown-part",
            f"There is no member {unknown[0][:60]!r}. "
            f"Members are {', '.join((*FILES, 'options', *SETTINGS))}.",
            part=unknown[0][:60],
            parts=[*FILES, "options", *SETTINGS],
        )
    if "measurements" not in ids:
        raise Problem("missing-measurements", "The document has no member `measurements`.")
    if len(set(ids.values())) < len(ids):
        raise Problem("upload-used", "One upload cannot be two inputs of a job.")
    given = document.get("options", {})
    if not isinstance(given, dict):
        raise Problem("malformed-options", "The options are not a JSON object.")
    options = parse(JobOptions, given)
    settings = read_settings(
        {name: document[name] for name in SETTINGS if name in document}, shared.settings
    )
    return References(ids, options, settings)


async def take_references(shared: Context, references: References, job_id: str) -> Submission:
    """Take the uploads that a submission names.

    Raises
    ------
    Problem, smsr.errors.SmsrError
        The submission is refused; the uploads are what they were.
    """
    await check_webhook(shared.settings, references.settings)
    options, named = references.options, references.uploads.items()
    uploads = {role: await finish(shared, await find(shared, id_)) for role, id_ in named}
    frames, points = await _check(shared, uploads, options)
    inputs = await _take(shared, uploads, job_id)
    folders = {upload.id: upload.folder for upload in uploads.values()}
    return Submission(options, inputs, frames, points, references.settings, folders)


def is_id(text: object) -> bool:
    """Whether something is an id, before it gets near a key of Redis or of the storage."""
    return isinstance(text, str) and len(text) == ID_LENGTH and set(text) <= set("0123456789abcdef")


def _reference(role: str, value: object) -> str:
    if isinstance(value, dict) and set(value) == {"upload"} and is_id(value["upload"]):
        return str(value["upload"])
    raise Problem(
        "invalid-request",
        f'{role} is {{"upload": ID}}, with the id of an upload: 32 hexadecimal digits.',
        errors=[{"in": "body", "name": role, "detail": "no reference to an upload"}],
    )


async def _check(
    shared: Context, uploads: Mapping[Role, Upload], options: JobOptions
) -> tuple[int, int] | tuple[None, None]:
    """Refuse uploads that are not finished, or that make no job together; return T and N."""
    limits, heads = limits_of(shared), {}
    for role, upload in uploads.items():
        if upload.job is None and upload.sha256 is None:
            raise _unfinished(upload)
        try:
            heads[role] = await to_thread.run_sync(
                beginning, shared.uploads, shared.storage, upload, HEAD_BYTES
            )
        except ObjectMissing:
            raise _used(upload.id) from None
    if sum(upload.length for upload in uploads.values()) > limits.bytes:
        raise limits.too_large()
    files = {role: (upload.name, upload.length) for role, upload in uploads.items()}
    return check_files(heads, files, options, limits.array_bytes)


def _unfinished(upload: Upload) -> Problem:
    return Problem(
        "upload-unfinished",
        f"{upload.offset} of the {upload.length} bytes of the upload {upload.id} have arrived.",
        offset=upload.offset,
        length=upload.length,
    )


async def _take(
    shared: Context, uploads: Mapping[Role, Upload], job_id: str
) -> dict[Role, InputFile]:
    """Take uploads, all or none, and make their objects those of the job."""
    store: UploadStore = shared.uploads
    ids = {str(role): upload.id for role, upload in uploads.items()}
    try:
        await to_thread.run_sync(store.take, shared.owner, ids, job_id)
    except UploadUsed as error:
        raise _used(error.upload_id) from None
    except UploadGone as error:
        raise unknown_upload(str(error)) from None
    except UploadUnfinished as error:
        raise _unfinished(await find(shared, str(error))) from None
    inputs: dict[Role, InputFile] = {}
    for role, upload in uploads.items():
        move = partial(hand_over, shared.storage, upload, job_id, role)
        try:
            inputs[role] = await to_thread.run_sync(move)
        except ObjectMissing:
            raise _used(upload.id) from None
        except StorageError:
            await to_thread.run_sync(store.give_back, shared.owner, list(ids.values()), job_id)
            raise
    for upload in uploads.values():
        await discard(shared, upload.folder)
        await to_thread.run_sync(store.forget_folder, upload.folder)
    return inputs
