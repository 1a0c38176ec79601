"""MATLAB files of version 5 (saved with -v6 or -v7): real arrays and fields of structs.

The elements of the file are walked without reading their data, so sizes are known before anything
is allocated, data that are not compressed can be mapped, and compressed ones are inflated no
further than the array needs. `scipy.io.loadmat` does none of this: it inflates whatever a file
holds and follows nested elements as deep as they go.

Format: MathWorks, "MAT-File Format" (matfile_format.pdf), level 5.
"""

from __future__ import annotations

import io
import math
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from smsr.errors import InputError, NotNumeric, TooLarge, UnreadableFile
from smsr.files.selection import StoredArray

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

HEADER_BYTES = 128

_MATRIX, _COMPRESSED = 14, 15
_STORAGE = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""Data types of elements. MATLAB stores doubles that are small integers as such."""

_STRUCT = 2
_NUMERIC_CLASSES = range(6, 16)
_CLASS_NAMES = {1: "a cell array", 3: "an object", 4: "text", 5: "a sparse matrix"}
_LOGICAL, _COMPLEX = 0x2, 0x8

_DEEPEST = 16
_MOST_ELEMENTS = 20_000
_MOST_AXES = 32
_LONGEST_NAME = 4096
_MOST_EXPANSION = 1032
_BLOCK = 2**18

_ByteOrder: TypeAlias = Literal["little", "big"]


@contextmanager
def open_mat5(path: Path, limit: int) -> Iterator[list[StoredArray]]:
    """Find the real arrays of a MATLAB file, also those in scalar structs (``"GT.shape3D"``)."""
    with path.open("rb") as file:
        yield _Scan(path, file, limit).run()


@dataclass(frozen=True, slots=True)
class _Tag:
    """Head of a data element: its type, its bytes, and how many of them the tag itself holds."""

    type: int
    size: int
    small: bytes | None = None


class _Cursor:
    """Reads forward through a part of a file.

    Parameters
    ----------
    file : binary file
    start, stop : int
        The part.
    """

    def __init__(self, file: IO[bytes], start: int, stop: int) -> None:
        self._file = file
        self._start = start
        self._stop = stop
        self.position = 0

    def read(self, size: int) -> bytes:
        """Return exactly `size` bytes."""
        at = self._start + self.position
        if size > self._stop - at:
            raise _truncated()
        self._file.seek(at)
        data = self._file.read(size)
        if len(data) < size:
            raise _truncated()
        self.position += size
        return data

    def skip(self, size: int) -> None:
        """Go forward."""
        if size > self._stop - self._start - self.position:
            raise _truncated()
        self.position += size


class _InflatingCursor(_Cursor):
    """Reads forward through a zlib stream; never holds more than a block of it."""

    def __init__(self, file: IO[bytes], start: int, stop: int, budget: _Budget) -> None:
        super().__init__(file, start, stop)
        self._next = start
        self._stream = zlib.decompressobj()
        self._pending = b""
        self._budget = budget

    def read(self, size: int) -> bytes:
        parts = []
        while size > 0:
            part = self._inflate(size)
            parts.append(part)
            size -= len(part)
        return b"".join(parts)

    def skip(self, size: int) -> None:
        while size > 0:
            size -= len(self._inflate(size))

    def finish(self) -> None:
        """Read on to the end of the stream, where its checksum is verified."""
        while self._inflate(_BLOCK, at_end=True):
            pass

    def _inflate(self, size: int, *, at_end: bool = False) -> bytes:
        while True:
            if not self._pending and not self._stream.eof:
                self._file.seek(self._next)
                self._pending = self._file.read(min(_BLOCK, self._stop - self._next))
                self._next += len(self._pending)
            if self._stream.eof or not self._pending:
                if at_end and self._stream.eof:
                    return b""
                raise _truncated()
            try:
                data = self._stream.decompress(self._pending, min(size, _BLOCK))
            except zlib.error as error:
                raise UnreadableFile(f"Compressed data of the file are damaged: {error}.") from None
            self._pending = self._stream.unconsumed_tail
            if data:
                self.position += len(data)
                self._budget.spend(len(data))
                return data


class _Budget:
    """Counts down what may be inflated in one scan."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._left = limit

    def spend(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise TooLarge(
                f"The file inflates to more than the limit of {self._limit} bytes.",
                limit=self._limit,
            )


@dataclass(frozen=True, slots=True)
class _Variable:
    """Where a top-level variable lies: the body of a matrix element, or a zlib stream."""

    start: int
    stop: int
    compressed: bool


class _Scan:
    """One walk over all variables of a file."""

    def __init__(self, path: Path, file: IO[bytes], limit: int) -> None:
        self._path = path
        self._file = file
        self._limit = limit
        self._found: list[StoredArray] = []
        self._elements = 0
        self._budget = _Budget(limit)
        self._order: _ByteOrder = "little"

    def run(self) -> list[StoredArray]:
        header = self._file.read(HEADER_BYTES)
        if len(header) < HEADER_BYTES:
            raise _truncated()
        self._order = "little" if header[126:128] == b"IM" else "big"
        end = self._file.seek(0, io.SEEK_END)
        cursor = _Cursor(self._file, 0, end)
        cursor.skip(HEADER_BYTES)
        while cursor.position < end:
            tag = self._tag(cursor)
            start = cursor.position
            cursor.skip(tag.size if tag.small is None else 0)
            if tag.type in (_MATRIX, _COMPRESSED) and tag.small is None:
                self._variable(_Variable(start, start + tag.size, tag.type == _COMPRESSED))
        return self._found

    def _cursor(self, variable: _Variable, budget: _Budget) -> _Cursor:
        kind = (self._file, variable.start, variable.stop)
        return _InflatingCursor(*kind, budget) if variable.compressed else _Cursor(*kind)

    def _variable(self, variable: _Variable) -> None:
        cursor = self._cursor(variable, self._budget)
        size = variable.stop - variable.start
        if variable.compressed:
            tag = self._tag(cursor)
            if tag.type != _MATRIX or tag.size > size * _MOST_EXPANSION:
                raise UnreadableFile("A compressed variable of the file is damaged.")
            size = tag.size
        self._matrix(cursor, variable, size, "", 0)

    def _tag(self, cursor: _Cursor) -> _Tag:
        """Read the tag of a data element, and its data if they fit into the tag."""
        self._elements += 1
        if self._elements > _MOST_ELEMENTS:
            raise UnreadableFile(f"The file has more than {_MOST_ELEMENTS} elements.")
        raw = cursor.read(8)
        first = int.from_bytes(raw[:4], self._order)
        if first >> 16:
            size = first >> 16
            if size > 4:
                raise UnreadableFile("The file has a small data element of more than 4 bytes.")
            return _Tag(first & 0xFFFF, size, raw[4 : 4 + size])
        return _Tag(first, int.from_bytes(raw[4:], self._order))

    def _data(self, cursor: _Cursor, longest: int) -> bytes:
        """Read a short element whole."""
        tag = self._tag(cursor)
        if tag.small is not None:
            return tag.small
        if tag.size > longest:
            raise UnreadableFile(f"The file has a name or shape of {tag.size} bytes.")
        data = cursor.read(tag.size)
        cursor.skip(-tag.size % 8)
        return data

    def _integers(self, cursor: _Cursor, most: int) -> list[int]:
        data = self._data(cursor, 4 * most)
        return [
            int.from_bytes(data[i : i + 4], self._order, signed=True)
            for i in range(0, len(data) - 3, 4)
        ]

    def _matrix(
        self, cursor: _Cursor, variable: _Variable, size: int, field: str, depth: int
    ) -> None:
        """Walk the body of a matrix element; `field` is its name where it is a struct's field."""
        if size == 0:  # how MATLAB writes an empty field
            return
        stop = cursor.position + size
        flags = self._integers(cursor, 2)
        shape = tuple(self._integers(cursor, _MOST_AXES))
        own_name = self._data(cursor, _LONGEST_NAME).decode("latin1")
        if not flags or len(shape) < 2 or min(shape) < 0:
            raise UnreadableFile("The file has a variable without class or shape.")
        name = field or own_name
        kind, bits = flags[0] & 0xFF, flags[0] >> 8
        if kind in _NUMERIC_CLASSES:
            self._array(cursor, variable, name, shape, bits)
        elif kind == _STRUCT and math.prod(shape) == 1:
            self._struct(cursor, variable, name, depth)
        elif name:
            what = _CLASS_NAMES.get(kind, "an array of structs or a value of another class")
            self._unusable(name, shape, f"The variable {name!r} is {what}, not a real array.")
        if cursor.position > stop:
            raise UnreadableFile("The file has a variable that is longer than it says.")
        if depth or not isinstance(cursor, _InflatingCursor):
            cursor.skip(stop - cursor.position)

    def _struct(self, cursor: _Cursor, variable: _Variable, name: str, depth: int) -> None:
        if depth >= _DEEPEST:
            raise UnreadableFile(f"The file nests structs more than {_DEEPEST} deep.")
        lengths = self._integers(cursor, 1)
        if len(lengths) != 1 or not 0 < lengths[0] <= _LONGEST_NAME:
            raise UnreadableFile("The file has a struct without names of its fields.")
        (length,) = lengths
        names = self._data(cursor, _LONGEST_NAME * length)
        for at in range(0, len(names) - length + 1, length):
            field = names[at : at + length].split(b"\0")[0].decode("latin1")
            tag = self._tag(cursor)
            if tag.type != _MATRIX or tag.small is not None:
                raise UnreadableFile(f"The field {field!r} of a struct is damaged.")
            self._matrix(cursor, variable, tag.size, f"{name}.{field}", depth + 1)

    def _array(
        self, cursor: _Cursor, variable: _Variable, name: str, shape: tuple[int, ...], bits: int
    ) -> None:
        if bits & (_LOGICAL | _COMPLEX):
            what = "complex" if bits & _COMPLEX else "logical"
            self._unusable(
                name, shape, f"The variable {name!r} is {what}; real numbers are needed."
            )
            return
        tag = self._tag(cursor)
        position = cursor.position - (4 if tag.small is not None else 0)
        storage = _STORAGE.get(tag.type)
        if storage is None:
            raise UnreadableFile(f"The variable {name!r} is stored in an unknown type.")
        dtype = np.dtype(storage).newbyteorder("<" if self._order == "little" else ">")
        if tag.size != math.prod(shape) * dtype.itemsize:
            raise UnreadableFile(
                f"The variable {name!r} of shape {shape} is stored in {tag.size} bytes, which "
                f"does not fit."
            )

        def read() -> NDArray[Any]:
            if variable.compressed:
                return self._inflate(variable, position, shape, dtype)
            offset = variable.start + position
            return np.memmap(self._path, dtype, "r", offset, shape, order="F")

        self._found.append(StoredArray(name, shape, dtype, read))

    def _inflate(
        self, variable: _Variable, position: int, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        target = np.empty(math.prod(shape) * dtype.itemsize, np.uint8)
        cursor = _InflatingCursor(
            self._file, variable.start, variable.stop, _Budget(self._limit + _BLOCK)
        )
        cursor.skip(position)
        for at in range(0, len(target), _BLOCK):
            size = min(_BLOCK, len(target) - at)
            target[at : at + size] = np.frombuffer(cursor.read(size), np.uint8)
        cursor.finish()
        return target.view(dtype).reshape(shape, order="F")

    def _unusable(self, name: str, shape: tuple[int, ...], detail: str) -> None:
        problem: InputError = NotNumeric(detail, array=name)

        def read() -> NDArray[Any]:
            raise problem

        self._found.append(StoredArray(name, shape, None, read, problem))


def _truncated() -> UnreadableFile:
    return UnreadableFile("The MATLAB file is truncated or damaged: an element goes past its end.")
