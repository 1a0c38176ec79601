"""The .npz format: a zip of .npy files. Stored members are mapped, deflated ones inflated.

Sizes in a zip directory can lie, so an array's size is taken from its own .npy header, and no more
than that many bytes are ever inflated. A member's checksum is verified, before it is mapped, too:
the solver would take damaged bytes for tracks. Layout of a zip: PKWARE's APPNOTE.TXT.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from smsr.errors import InputError, UnreadableFile, UnsupportedFormat
from smsr.files.npy import HEADER_BYTES, NpyHeader, map_array, parse_header
from smsr.files.selection import StoredArray

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

_LARGEST_READ = 2**20
"""Most bytes that are read at once; it bounds the directory (about 10,000 members)."""

_MOST_EXPANSION = 1032
"""Deflate cannot expand more than this (each of its bits codes at most 258 / 2 bytes)."""

_BLOCK = 2**20
_LOCAL_HEADER = struct.Struct("<4s22xHH")  # signature, lengths of name and extra field
_ENCRYPTED = 0x1


@contextmanager
def open_npz(path: Path, limit: int) -> Iterator[list[StoredArray]]:  # noqa: ARG001
    """Find the arrays of an .npz file."""
    with path.open("rb") as file:
        try:
            archive = zipfile.ZipFile(cast("IO[bytes]", _BoundedReads(file)))
        except (zipfile.BadZipFile, *_FAILURES) as error:
            raise _damaged(error) from None
        names = [info.filename for info in archive.infolist()]
        if len(set(names)) < len(names):
            raise UnreadableFile("The .npz file has several members of the same name.")
        yield [
            _find(path, archive, info)
            for info in archive.infolist()
            if info.filename.endswith(".npy")
        ]


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as a stored (not compressed) .npz, so that readers can map it.

    Parameters
    ----------
    path : path
        Written under exactly this name.
    arrays : mapping
        Names to arrays.
    """
    with (
        Path(path).open("wb") as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive,
    ):
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


class _BoundedReads(io.RawIOBase):
    """A file whose reads are bounded, because `zipfile` reads a directory of any size at once."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def read(self, size: int = -1) -> bytes:
        if size > _LARGEST_READ:
            raise UnreadableFile(
                f"The .npz file has a directory of {size} bytes; at most {_LARGEST_READ} are read."
            )
        data = self._file.read(size if size >= 0 else _LARGEST_READ + 1)
        if len(data) > _LARGEST_READ:
            raise UnreadableFile("The end of the .npz file is damaged.")
        return data


_FAILURES = (
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    OverflowError,
    RuntimeError,  # includes NotImplementedError
    KeyError,
    IndexError,
)
"""What `zipfile` raises on damaged archives beside `BadZipFile`."""


def _damaged(error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return UnreadableFile(f"The .npz file is damaged: {error}.")


def _find(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> StoredArray:
    name = info.filename.removesuffix(".npy")

    def unusable(problem: InputError) -> StoredArray:
        def read() -> NDArray[Any]:
            raise problem

        return StoredArray(name, (), None, read, problem, damaged=True)

    if info.flag_bits & _ENCRYPTED:
        return unusable(UnsupportedFormat(f"The member {info.filename} of the .npz is encrypted."))
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return unusable(
            UnsupportedFormat(
                f"The member {info.filename} of the .npz is compressed by a method that NumPy does "
                f"not use; write it by numpy.savez or numpy.savez_compressed."
            )
        )
    try:
        with archive.open(info) as member:
            header = parse_header(_read_up_to(member, HEADER_BYTES))
        _check_member(info, header, path.stat().st_size)
    except (zipfile.BadZipFile, *_FAILURES) as error:
        return unusable(_damaged(error))

    def read() -> NDArray[Any]:
        if info.compress_type == zipfile.ZIP_STORED:
            offset = _data_offset(path, info)
            _check_sum(path, info, offset)
            return map_array(path, header, offset)
        return _inflate(archive, info, header)

    return StoredArray(name, header.shape, header.dtype, read, header.problem)


def _check_member(info: zipfile.ZipInfo, header: NpyHeader, file_size: int) -> None:
    if header.dtype is None:
        return
    if info.header_offset + info.compress_size > file_size:
        raise UnreadableFile(f"The member {info.filename} of the .npz goes past its end.")
    expected = header.offset + header.nbytes
    stored = info.compress_type == zipfile.ZIP_STORED
    possible = info.compress_size * (1 if stored else _MOST_EXPANSION)
    if info.file_size != expected or expected > possible or (stored and expected < possible):
        raise UnreadableFile(
            f"The member {info.filename} of the .npz is damaged: its array needs {expected} bytes, "
            f"the zip directory gives it {info.file_size}, compressed {info.compress_size}."
        )


def _data_offset(path: Path, info: zipfile.ZipInfo) -> int:
    """Where a stored member's bytes begin: the lengths in its local header decide."""
    with path.open("rb") as file:
        file.seek(info.header_offset)
        header = file.read(_LOCAL_HEADER.size)
        if len(header) < _LOCAL_HEADER.size:
            raise UnreadableFile("The .npz file is truncated.")
        signature, name, extra = _LOCAL_HEADER.unpack(header)
        offset = info.header_offset + _LOCAL_HEADER.size + int(name) + int(extra)
        if signature != b"PK\x03\x04" or offset + info.file_size > file.seek(0, io.SEEK_END):
            raise UnreadableFile("The .npz file is truncated or its directory is wrong.")
    return offset


def _check_sum(path: Path, info: zipfile.ZipInfo, offset: int) -> None:
    """Refuse a stored member whose bytes have not the checksum of the directory (CRC-32)."""
    crc, left = 0, info.file_size
    with path.open("rb") as file:
        file.seek(offset)
        while left > 0 and (block := file.read(min(left, _BLOCK))):
            crc = zlib.crc32(block, crc)
            left -= len(block)
    if left > 0 or crc != info.CRC:
        raise UnreadableFile(
            f"The .npz file is damaged: the bytes of {info.filename} do not have the checksum that "
            "was written with them. Make or send it anew."
        )


def _inflate(archive: zipfile.ZipFile, info: zipfile.ZipInfo, header: NpyHeader) -> NDArray[Any]:
    target = np.empty(header.nbytes, np.uint8)
    try:
        with archive.open(info) as member:
            _read_up_to(member, header.offset)
            filled = 0
            while block := member.read(_BLOCK):  # the read that meets the end checks the CRC
                if filled + len(block) > len(target):
                    raise UnreadableFile("The .npz file holds more data than its header says.")
                target[filled : filled + len(block)] = np.frombuffer(block, np.uint8)
                filled += len(block)
    except (zipfile.BadZipFile, *_FAILURES) as error:
        raise _damaged(error) from None
    if filled < len(target):
        raise UnreadableFile("The .npz file holds less data than its header says.")
    return target.view(np.dtype(header.dtype)).reshape(header.shape, order=header.order)


def _read_up_to(member: IO[bytes], size: int) -> bytes:
    parts = []
    while size > 0 and (part := member.read(min(size, _BLOCK))):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
