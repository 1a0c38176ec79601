"""Checksums of the files of a result, taken once when it is published.

With them a download says what its bytes should be, and an archive of the files can be sent from
any byte on, since a ZIP states the CRC-32 of a member before the member itself.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from smsr.files.npy import HEADER_BYTES, parse_header
from smsr.files.ply import VERTEX_BYTES, ply_face_block, ply_header

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

CHECKSUMS = "checksums.json"
"""Object of a result: CRC-32 and SHA-256 of each array."""
FRAME_CHECKSUMS = "frame-checksums.npy"
"""Object of a result: CRC-32 of the PLY of each frame, uint32 (T,)."""

_BLOCK = 1 << 20
_POLYNOMIAL = 0xEDB88320


@dataclass(frozen=True, slots=True)
class FileChecksum:
    """Checksums of a file; `sha256` in hexadecimal digits."""

    crc32: int
    sha256: str


def write_checksums(folder: Path, arrays: tuple[str, ...]) -> None:
    """Write `CHECKSUMS` and `FRAME_CHECKSUMS` beside the files of a result, in one pass over them.

    Parameters
    ----------
    folder : path
        With shapes.npy, float32 (T, N, 3), and perhaps faces.npy.
    arrays : tuple of str
        Names of the files to read; those that do not exist are left out.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in arrays:
        path = folder / name
        if not path.exists():
            continue
        if name == "shapes.npy":
            checksum, frames = _checksum_frames(path)
            faces = folder / "faces.npy"
            block = np.load(faces) if faces.exists() else None
            np.save(folder / FRAME_CHECKSUMS, _ply_checksums(frames, _points(path), block))
        else:
            checksum = _checksum(path)
        found[name] = {"crc32": checksum.crc32, "sha256": checksum.sha256}
    (folder / CHECKSUMS).write_text(json.dumps(found) + "\n", encoding="ascii")


def parse_checksums(document: bytes) -> Mapping[str, FileChecksum]:
    """Return the checksums in a `CHECKSUMS` object by file name."""
    parsed: dict[str, dict[str, Any]] = json.loads(document)
    return {name: FileChecksum(**found) for name, found in parsed.items()}


def _points(path: Path) -> int:
    with path.open("rb") as file:
        return parse_header(file.read(HEADER_BYTES)).shape[1]


def _checksum(path: Path) -> FileChecksum:
    crc, sha = 0, hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            crc = zlib.crc32(block, crc)
            sha.update(block)
    return FileChecksum(crc, sha.hexdigest())


def _checksum_frames(path: Path) -> tuple[FileChecksum, NDArray[np.uint32]]:
    """Return the checksums of shapes.npy and the CRC-32 of the vertices of each frame."""
    with path.open("rb") as file:
        header = parse_header(file.read(HEADER_BYTES))
        file.seek(0)
        head = file.read(header.offset)
        crc, sha = zlib.crc32(head), hashlib.sha256(head)
        frames, points, _ = header.shape
        checksums = np.empty(frames, "<u4")
        for t in range(frames):
            left, checksum = points * VERTEX_BYTES, 0
            while left and (block := file.read(min(left, _BLOCK))):
                crc = zlib.crc32(block, crc)
                checksum = zlib.crc32(block, checksum)
                sha.update(block)
                left -= len(block)
            checksums[t] = checksum
    return FileChecksum(crc, sha.hexdigest()), checksums


def _ply_checksums(
    vertices: NDArray[np.uint32], points: int, faces: NDArray[np.integer[Any]] | None
) -> NDArray[np.uint32]:
    """Return the CRC-32 of the PLY of each frame from that of its vertices.

    CRC(ab) = shift(CRC(a), len(b)) ^ CRC(b), where the shift is linear over GF(2): header and
    faces, which all frames share, are read once.
    """
    header = np.array([zlib.crc32(ply_header(points, 0 if faces is None else len(faces)))], "<u4")
    found = shift_crc32(header, points * VERTEX_BYTES) ^ vertices
    if faces is None or not len(faces):
        return found.astype("<u4")
    block = ply_face_block(faces)
    return (shift_crc32(found, len(block)) ^ np.uint32(zlib.crc32(block))).astype("<u4")


def shift_crc32(checksums: NDArray[np.uint32], length: int) -> NDArray[np.uint32]:
    """Return CRC-32 values moved over `length` zero bytes, so that combined ones are their XOR.

    Parameters
    ----------
    checksums : ndarray of uint32
    length : int
        Number of bytes that follow.

    References
    ----------
    The operator of one zero bit is squared again and again, as zlib's crc32_combine does.
    """
    # Columns of a 32 x 32 matrix over GF(2): what becomes of each bit when a zero bit follows.
    operator = np.array([_POLYNOMIAL, *(1 << i for i in range(31))], "<u4")
    for _ in range(3):  # of one bit to that of one byte
        operator = _apply(operator, operator)
    shifted = checksums.astype("<u4")
    while length:
        if length & 1:
            shifted = _apply(operator, shifted)
        operator = _apply(operator, operator)
        length >>= 1
    return shifted


def _apply(operator: NDArray[np.uint32], values: NDArray[np.uint32]) -> NDArray[np.uint32]:
    result = np.zeros_like(values)
    for bit, column in enumerate(operator):
        result ^= np.where(values >> np.uint32(bit) & np.uint32(1), column, np.uint32(0))
    return result
