"""What the beginning of a file tells, so that an upload can be refused before the rest comes."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from smsr.errors import (
    EmptyFile,
    GroundTruthMismatch,
    InputError,
    TooFewFrames,
    TooFewPoints,
    UnreadableFile,
    UnsupportedFormat,
    WrongShape,
)
from smsr.files.faces import check_faces_shape
from smsr.files.formats import FileFormat, sniff
from smsr.files.npy import HEADER_BYTES, check_length, parse_header
from smsr.files.opening import DEFAULT_LIMIT
from smsr.files.selection import Role, check_size
from smsr.files.text import check_text
from smsr.measurements import MINIMUM_FRAMES, MINIMUM_POINTS, check_shape

if TYPE_CHECKING:
    from smsr.measurements import Layout

_MAT5_FIRST_DATA = 136
"""Bytes of a MATLAB file's header and of the tag of its first variable."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """What is known of a file from its first bytes.

    Attributes
    ----------
    format : FileFormat
    shape : tuple of int or None
        Shape of its array, where the beginning tells (.npy).
    dtype : dtype or None
        Type of its entries, where the beginning tells.
    """

    format: FileFormat
    shape: tuple[int, ...] | None = None
    dtype: np.dtype[Any] | None = None


def check_prefix(
    head: bytes,
    total_size: int | None,
    name: str,
    role: Role,
    limit: int = DEFAULT_LIMIT,
    *,
    layout: Layout | None = None,
) -> Beginning:
    """Refuse what can be told to be wrong from the beginning of a file.

    Parameters
    ----------
    head : bytes
        The first `smsr.files.HEAD_BYTES` bytes or more, or the whole file if it is shorter.
    total_size : int or None
        Size of the file, None while it is not known.
    name : str
        Its name, for messages and where the bytes do not tell the format.
    role : {"measurements", "ground_truth", "faces"}
        What the array is for.
    limit : int
        Most bytes of the array once decompressed.
    layout : {"auto", "interleaved", "stacked"}, optional
        Row order of measurements; while it is not known, only what no layout allows is refused.

    Returns
    -------
    Beginning
        A file that passes may still be refused by `open_array`.

    Raises
    ------
    InputError
        Any subclass of it that `open_array`, `smsr.measurements.as_source` or `load_faces` would
        raise for the same file.
    """
    kind = sniff(head, name)
    try:
        match kind:
            case FileFormat.NPY:
                return _npy(head, total_size, role, limit, layout)
            case FileFormat.NPZ:
                _zip(head, total_size)
            case FileFormat.MAT5:
                _mat5(head, total_size)
            case FileFormat.HDF5:
                _hdf5(head, total_size)
            case FileFormat.TEXT:
                check_text(head, complete=total_size == len(head))
            case FileFormat.TEXT_GZ:
                _gzip(head, total_size, name)
    except InputError as error:
        raise type(error)(f"{name}: {error.detail}", **error.context) from None
    return Beginning(kind)


def _npy(
    head: bytes, total_size: int | None, role: Role, limit: int, layout: Layout | None
) -> Beginning:
    header = parse_header(head[:HEADER_BYTES])
    if header.problem is not None:
        raise header.problem
    dtype: np.dtype[Any] = np.dtype(header.dtype)
    if 0 in header.shape:
        raise WrongShape(
            f"The array is empty: its shape is {header.shape}.", shape=list(header.shape)
        )
    check_size(header.nbytes, limit)
    match role:
        case "measurements":
            _check_measurements(header.shape, dtype, layout)
        case "ground_truth":
            _check_ground_truth(header.shape)
        case "faces":
            check_faces_shape(header.shape, dtype)
    if total_size is not None:
        check_length(header, total_size)
    return Beginning(FileFormat.NPY, header.shape, dtype)


def _check_measurements(
    shape: tuple[int, ...], dtype: np.dtype[Any], layout: Layout | None
) -> None:
    try:
        check_shape(shape, dtype, layout or "auto")
    except WrongShape:
        if layout is not None or len(shape) != 3 or shape[0] != 2:
            raise
        check_shape(shape, dtype, "stacked")


def _check_ground_truth(shape: tuple[int, ...]) -> None:
    """Refuse what cannot be the shapes of any measurements."""
    match shape:
        case (rows, points):
            if rows % 3:
                raise GroundTruthMismatch(
                    f"The ground truth has {rows} rows; it needs three (x, y and z) for each frame."
                )
            frames = rows // 3
        case (frames, points, 3) | (frames, 3, points):
            pass
        case _:
            raise WrongShape(
                f"The ground truth has the shape {shape}; it must be (3T, N), (T, N, 3) or "
                f"(T, 3, N).",
                shape=list(shape),
            )
    if frames < MINIMUM_FRAMES:
        raise TooFewFrames(f"The ground truth has {frames} frames; {MINIMUM_FRAMES} are needed.")
    if points < MINIMUM_POINTS:
        raise TooFewPoints(f"The ground truth has {points} points; {MINIMUM_POINTS} are needed.")


def _zip(head: bytes, total_size: int | None) -> None:
    smallest = 22  # an empty archive
    if total_size is not None and total_size < smallest:
        raise UnreadableFile("The .npz file is truncated.")
    if head.startswith(b"PK\x05\x06"):
        raise UnreadableFile("The .npz file is empty: it holds no array.")


def _mat5(head: bytes, total_size: int | None) -> None:
    if total_size is None or len(head) < _MAT5_FIRST_DATA:
        if total_size is not None and total_size < _MAT5_FIRST_DATA:
            raise UnreadableFile("The MATLAB file is truncated: it ends within its header.")
        return
    order: Literal["little", "big"] = "little" if head[126:128] == b"IM" else "big"
    first = int.from_bytes(head[128:132], order)
    size = int.from_bytes(head[132:136], order)
    if first >> 16 == 0 and _MAT5_FIRST_DATA + size > total_size:
        raise UnreadableFile(
            f"The MATLAB file is truncated: its first variable takes {size} bytes and the file has "
            f"{total_size}."
        )


def _hdf5(head: bytes, total_size: int | None) -> None:
    """Compare the end of the file that the superblock names with the size (HDF5 spec., II.A)."""
    start = next(at for at in (0, 512, 1024, 2048, 4096) if head.startswith(b"\x89HDF", at))
    block = head[start : start + 48]
    if len(block) < 48 or total_size is None:
        return
    version = block[8]
    offset_size, end_at = (block[13], 40) if version < 2 else (block[9], 28)
    if version > 3 or offset_size != 8:
        return
    end = int.from_bytes(block[end_at : end_at + 8], "little")
    if end > total_size:
        raise UnreadableFile(
            f"The HDF5 file is truncated: it should have {end} bytes and has {total_size}."
        )


def _gzip(head: bytes, total_size: int | None, name: str) -> None:
    inflater = zlib.decompressobj(wbits=31)
    try:
        text = inflater.decompress(head, 2**16)
    except zlib.error as error:
        raise UnreadableFile(f"The gzip file is damaged: {error}.") from None
    complete = inflater.eof and total_size == len(head)
    if complete and not text:
        raise EmptyFile("The gzip file holds nothing.")
    if text and sniff(text, name) is not FileFormat.TEXT:
        raise UnsupportedFormat("The gzip file holds no text; unpack it first.")
    check_text(text, complete=complete)
