"""The .npy format: a header that is checked before anything is allocated, and a memory map.

Format: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
"""

from __future__ import annotations

import ast
import io
import math
import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from smsr.errors import InputError, NotNumeric, UnreadableFile
from smsr.files.selection import StoredArray

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import DTypeLike, NDArray

MAGIC = b"\x93NUMPY"

LARGEST_HEADER = 10_000
"""Most bytes of a header's dictionary, as in NumPy; a header that NumPy wrote for numbers has
about 110."""

HEADER_BYTES = 12 + LARGEST_HEADER
"""The first bytes of a file that always hold the whole header."""

_MOST_AXES = 32
_REAL = re.compile(r"[<>|=]?(f[248]|[iu][1248])")


@dataclass(frozen=True, slots=True)
class NpyHeader:
    """What the header of an .npy file says.

    Attributes
    ----------
    shape : tuple of int
    dtype : dtype or None
        None where the entries are no real numbers.
    fortran_order : bool
    offset : int
        Where the data begin.
    problem : InputError or None
        Why the entries are no real numbers.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None
    fortran_order: bool
    offset: int
    problem: InputError | None

    @property
    def nbytes(self) -> int:
        """Bytes of data that must follow the header (0 where `dtype` is None)."""
        return math.prod(self.shape) * (self.dtype.itemsize if self.dtype else 0)

    @property
    def order(self) -> Literal["C", "F"]:
        """``"C"`` or ``"F"``."""
        return "F" if self.fortran_order else "C"


def parse_header(head: bytes) -> NpyHeader:
    """Parse the beginning of an .npy file.

    Parameters
    ----------
    head : bytes
        At least `HEADER_BYTES` bytes, or the whole file if it is shorter.

    Raises
    ------
    UnreadableFile
        The header is truncated or not as the format says.
    """
    if len(head) < 10 or not head.startswith(MAGIC):
        raise UnreadableFile("The file is no complete .npy file: its header is missing.")
    if head[6:8] == b"\x01\x00":
        length, start = int.from_bytes(head[8:10], "little"), 10
    elif head[6:8] in (b"\x02\x00", b"\x03\x00"):
        length, start = int.from_bytes(head[8:12], "little"), 12
    else:
        raise UnreadableFile(f"The .npy file has the unknown version {head[6]}.{head[7]}.")
    if length > LARGEST_HEADER:
        raise UnreadableFile(
            f"The .npy header has {length} bytes; no array of numbers needs more than "
            f"{LARGEST_HEADER}."
        )
    text = head[start : start + length]
    if len(text) < length:
        raise UnreadableFile("The .npy file is truncated: it ends within its header.")
    descr, fortran_order, shape = _fields(text)
    dtype, problem = _real_dtype(descr)
    return NpyHeader(shape, dtype, fortran_order, start + length, problem)


@contextmanager
def open_npy(path: Path, limit: int) -> Iterator[list[StoredArray]]:  # noqa: ARG001
    """Find the one array of an .npy file; reading it maps the file."""
    with path.open("rb") as file:
        header = parse_header(file.read(HEADER_BYTES))
    check_length(header, path.stat().st_size)

    def read() -> NDArray[Any]:
        return map_array(path, header, 0)

    yield [StoredArray("", header.shape, header.dtype, read, header.problem)]


def check_length(header: NpyHeader, size: int) -> None:
    """Refuse an .npy file of another length than its header says."""
    if header.dtype is None:
        return
    expected = header.offset + header.nbytes
    if size < expected:
        raise UnreadableFile(
            f"The .npy file is truncated: its header promises {expected} bytes and it has {size}.",
            expected=expected,
            size=size,
        )
    if size > expected:
        raise UnreadableFile(
            f"The .npy file has {size - expected} bytes after its array of shape {header.shape}; "
            f"its header is wrong or something was appended.",
            expected=expected,
            size=size,
        )


def map_array(path: Path, header: NpyHeader, start: int) -> NDArray[Any]:
    """Map the array whose .npy file begins at byte `start` of `path`, read-only."""
    dtype: np.dtype[Any] = np.dtype(header.dtype)
    return np.memmap(path, dtype, "r", start + header.offset, header.shape, header.order)


def npy_header(shape: tuple[int, ...], dtype: DTypeLike) -> bytes:
    """Return the bytes that make an .npy file when a C-ordered array's bytes follow.

    Parameters
    ----------
    shape : tuple of int
    dtype : dtype-like
        Of the entries, with their byte order.
    """
    buffer = io.BytesIO()
    fields = {
        "descr": np.lib.format.dtype_to_descr(np.dtype(dtype)),
        "fortran_order": False,
        "shape": shape,
    }
    np.lib.format.write_array_header_1_0(buffer, fields)
    return buffer.getvalue()


def _fields(text: bytes) -> tuple[object, bool, tuple[int, ...]]:
    # Python 2 wrote long integers as 5L.
    source = re.sub(r"(?<=\d)L\b", "", text.decode("latin1")).strip()
    try:
        fields = ast.literal_eval(source)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        raise UnreadableFile("The .npy header is no dictionary of constants.") from None
    if not isinstance(fields, dict) or set(fields) != {"descr", "fortran_order", "shape"}:
        raise UnreadableFile("The .npy header must have just descr, fortran_order and shape.")
    shape, fortran_order = fields["shape"], fields["fortran_order"]
    if (
        not isinstance(shape, tuple)
        or len(shape) > _MOST_AXES
        or not all(type(size) is int and 0 <= size < 2**63 for size in shape)
        or not isinstance(fortran_order, bool)
    ):
        raise UnreadableFile("The .npy header has no valid shape and order.")
    return fields["descr"], fortran_order, shape


def _real_dtype(descr: object) -> tuple[np.dtype[Any] | None, InputError | None]:
    if isinstance(descr, str) and _REAL.fullmatch(descr):
        return np.dtype(descr.replace("|", "")), None
    if isinstance(descr, str) and descr.lstrip("<>|=").startswith("O"):
        return None, UnreadableFile(
            "The array holds pickled Python objects, which are never read because a pickle can run "
            "code. Save it as float32 or float64."
        )
    shown = str(descr)[:60]
    return None, NotNumeric(
        f"The array has entries of type {shown}; save it as float32 or float64.", dtype=shown
    )
