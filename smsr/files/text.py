"""Tables of numbers as text (.csv, .txt), plain or compressed by gzip.

Fields are separated by commas, semicolons, tabs or blanks; ``#`` begins a comment; one line of
names may stand first; an empty field is NaN. The text is read twice: once to find out how large
the array is, with no more than a line in memory, and once to fill it.
"""

from __future__ import annotations

import gzip
import io
import itertools
import re
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from smsr.errors import NotNumeric, TooLarge, UnreadableFile, UnsupportedFormat
from smsr.files.selection import StoredArray, check_size

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from numpy.typing import NDArray

_LONGEST_LINE = 64 * 2**20
_BLOCK = 2**22
_ITEMSIZE = 8

_MOST_EXPANSION = 100
_TRUSTED = 2**20
"""Numbers in text do not compress a hundredfold; more than that, past the first bytes, is a
decompression bomb."""

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SEPARATORS = (b";", b",", b"\t")
_EMPTY = {mark: re.compile(rb"(^|%b) *(?=%b|$)" % (mark, mark)) for mark in _SEPARATORS}
_NUMBER = re.compile(
    rb"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|nan|inf|infinity)", re.I
)
_NAME = re.compile(rb"[\"']?(?!(nan|inf|infinity)\b)[a-z_]", re.I)


@contextmanager
def open_text(path: Path, limit: int) -> Iterator[list[StoredArray]]:
    """Find the one table of a text file."""
    yield [_stored(path, limit, compressed=False)]


@contextmanager
def open_text_gz(path: Path, limit: int) -> Iterator[list[StoredArray]]:
    """Find the one table of a text file compressed by gzip."""
    yield [_stored(path, limit, compressed=True)]


def check_text(head: bytes, *, complete: bool) -> None:
    """Refuse a text file whose first row holds no numbers.

    Parameters
    ----------
    head : bytes
        Its beginning.
    complete : bool
        Whether that is all of it.
    """
    lines = head.removeprefix(_BYTE_ORDER_MARK).split(b"\n")
    named = False
    for number, line in enumerate(lines if complete else lines[:-1], 1):
        line = line.split(b"#", 1)[0].rstrip(b"\r")
        if not line.strip():
            continue
        fields = _fields(line, _separator(line))
        if not named and all(_NAME.match(field) for field in fields):
            named = True
            continue
        _check_fields(fields, number)
        return
    if complete:
        raise UnreadableFile("The text file holds no numbers.")


@dataclass(frozen=True, slots=True)
class _Table:
    """What the first reading finds out."""

    separator: bytes | None  # None: blanks and tabs
    header: bool
    rows: int
    columns: int


@dataclass(frozen=True, slots=True)
class _Lines:
    """The lines of a text file that hold data, with their numbers from 1."""

    path: Path
    limit: int
    compressed: bool

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        try:
            with self.path.open("rb") as file, self._text(file) as text:
                yield from self._data_lines(file, text)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise UnreadableFile(f"The gzip file is damaged or truncated: {error}.") from None

    def _text(self, file: IO[bytes]) -> AbstractContextManager[IO[bytes]]:
        if not self.compressed:
            return file
        # GzipFile finds lines by Python code, BufferedReader by C.
        return io.BufferedReader(cast("io.RawIOBase", gzip.GzipFile(fileobj=file, mode="rb")))

    def _data_lines(self, file: IO[bytes], text: IO[bytes]) -> Iterator[tuple[int, bytes]]:
        number, size, allowed = 0, 0, _TRUSTED
        while line := text.readline(_LONGEST_LINE + 1):
            number += 1
            size += len(line)
            if len(line) > _LONGEST_LINE:
                raise TooLarge(f"Line {number} has more than {_LONGEST_LINE} bytes.", line=number)
            if b"\0" in line:
                raise UnsupportedFormat(f"Line {number} holds zero bytes: the file is no text.")
            if self.compressed and size > allowed:
                allowed = _MOST_EXPANSION * file.tell()
                if size > allowed:
                    raise TooLarge(
                        f"The gzip file expands more than {_MOST_EXPANSION} times, which no table "
                        f"of measurements does."
                    )
            if number == 1:
                line = line.removeprefix(_BYTE_ORDER_MARK)
            line = line.split(b"#", 1)[0].rstrip(b"\r\n")
            if b"\r" in line:
                raise UnreadableFile("The text file ends its lines by a lone carriage return.")
            if line.strip():
                yield number, line


def _stored(path: Path, limit: int, *, compressed: bool) -> StoredArray:
    lines = _Lines(path, limit, compressed)
    table = _survey(lines, limit)

    def read() -> NDArray[Any]:
        return _parse(lines, table)

    return StoredArray("", (table.rows, table.columns), np.dtype(np.float64), read)


def _survey(lines: _Lines, limit: int) -> _Table:
    """Find separator, names and size."""
    separator: bytes | None = None
    header = False
    rows = columns = 0
    for number, line in lines:
        if not rows:
            separator = _separator(line)
            fields = _fields(line, separator)
            if not header and all(_NAME.match(field) for field in fields):
                header = True
                continue
            columns = len(fields)
        found = line.count(separator) + 1 if separator else len(line.split())
        if found != columns:
            raise UnreadableFile(
                f"Line {number} has {found} fields; the lines before have {columns}.",
                line=number,
                expected=columns,
                found=found,
            )
        rows += 1
        check_size(rows * columns * _ITEMSIZE, limit)
    if not rows:
        raise UnreadableFile("The text file holds no numbers.")
    return _Table(separator, header, rows, columns)


def _parse(lines: _Lines, table: _Table) -> NDArray[np.float64]:
    array = np.empty((table.rows, table.columns))
    row = 0
    for block in _blocks(lines, header=table.header):
        numbers = _numbers(block, table.separator)
        if numbers.shape[1] != table.columns or row + len(numbers) > table.rows:
            raise UnreadableFile(f"After line {block[0][0]} the fields do not make a table.")
        array[row : row + len(numbers)] = numbers
        row += len(numbers)
    if row < table.rows:
        raise UnreadableFile("The text file holds fewer rows than lines.")
    return array


def _blocks(lines: _Lines, *, header: bool) -> Iterator[list[tuple[int, bytes]]]:
    """Gather lines of about `_BLOCK` bytes together."""
    block: list[tuple[int, bytes]] = []
    size = 0
    for number, line in itertools.islice(lines, int(header), None):
        block.append((number, line))
        size += len(line)
        if size >= _BLOCK:
            yield block
            block, size = [], 0
    if block:
        yield block


def _numbers(block: list[tuple[int, bytes]], separator: bytes | None) -> NDArray[np.float64]:
    completed = [_completed(line, separator).decode("latin1") for _, line in block]
    delimiter = separator.decode() if separator else None
    try:
        return np.loadtxt(completed, np.float64, comments=None, delimiter=delimiter, ndmin=2)
    except ValueError as error:
        for number, line in block:
            _check_fields(_fields(line, separator), number)
        raise UnreadableFile(f"After line {block[0][0]}: {error}.") from None


def _separator(line: bytes) -> bytes | None:
    for separator in _SEPARATORS:
        if separator in line:
            return separator
    return None


def _fields(line: bytes, separator: bytes | None) -> list[bytes]:
    return [field.strip() for field in line.split(separator)]


def _check_fields(fields: list[bytes], number: int) -> None:
    for field in fields:
        if field and not _NUMBER.fullmatch(field):
            shown = field[:40].decode("latin1")
            raise NotNumeric(
                f"{shown!r} in line {number} is no number. Fields must be numbers with a decimal "
                f"point.",
                line=number,
            )


def _completed(line: bytes, separator: bytes | None) -> bytes:
    """Write nan into empty fields."""
    if separator is None:
        return line
    return _EMPTY[separator].sub(rb"\1nan", line)
