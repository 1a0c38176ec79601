"""Stored ZIP archives that are never built: any range of their bytes is made when it is asked for.

Members are files of known sizes, so every offset is known, and with the CRC-32 of each member
every byte is: a download can go on from anywhere, and the same members make the same archive in
every process. Members without a checksum get it behind their bytes (APPNOTE.TXT, section 4.3.9),
and such an archive can be read from its beginning only.

Members of one size with names of one length are a group, of which nothing is kept for each member
but its checksum: an archive of a million frames takes no more memory than one of ten.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from contextlib import aclosing
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import accumulate
from typing import TYPE_CHECKING, Final

from service.content import Content

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Sequence

SEND_BYTES = 256 * 1024
"""Small pieces are sent together, in blocks of about this size."""

LAYOUT: Final = "zip1"
"""Changes whenever the same members make other bytes than they did in an earlier version."""

# The largest numbers that 32 and 16 bits hold mean "see the ZIP64 record" (section 4.4.1.4).
_LIMIT_32, _LIMIT_16 = 0xFFFFFFFF, 0xFFFF
ZIP64_LIMIT = _LIMIT_32
"""Numbers from here on stand in ZIP64 records."""

_LOCAL = struct.Struct("<4s5H3L2H")
_LOCAL_ZIP64 = struct.Struct("<2H2Q")
_DESCRIPTOR = struct.Struct("<4s3L")
_DESCRIPTOR_ZIP64 = struct.Struct("<4sL2Q")
_CENTRAL = struct.Struct("<4s6H3L5H2L")
_END = struct.Struct("<4s4H2LH")
_END_ZIP64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_ZIP64 = struct.Struct("<4sLQL")
_PLAIN_VERSION, _ZIP64_VERSION = 20, 45
_UNIX = 3 << 8
_FILE_MODE = 0o100644 << 16
_FOLLOWS = 1 << 3
"""Flag: checksum and sizes stand behind the member."""


@dataclass(frozen=True, slots=True)
class Members:
    """Files of one size in an archive.

    Attributes
    ----------
    count : int
        How many there are.
    size : int
        Bytes of each.
    name : callable
        Gives the name of each, from 0 on: ASCII, all of one length.
    open : callable
        Given the members that will be read, returns what gives the content of each. They are read
        in order, so a source can fetch ahead.
    checksums : sequence of int, optional
        CRC-32 of each.
    """

    count: int
    size: int
    name: Callable[[int], str]
    open: Callable[[range], Callable[[int], Content]]
    checksums: Sequence[int] | None = None


def single(name: str, content: Content, checksum: int | None = None) -> Members:
    """Return one file as members of an archive."""
    checksums = None if checksum is None else (checksum,)
    return Members(1, content.size, lambda _: name, lambda _: lambda _: content, checksums)


def archive(groups: Sequence[Members], modified: float) -> Content:
    """Return a ZIP archive of uncompressed members.

    Parameters
    ----------
    groups : sequence of Members
        In the order they get in the archive. ZIP64 records are used only where a number needs
        them, since some unpackers know them badly.
    modified : float
        Time stamp of every member, Unix seconds (UTC). The same members and time give the same
        bytes.

    Returns
    -------
    Content
        Seekable where the checksums of all members are known. Reading raises `ValueError` where a
        member is shorter than its size says.
    """
    return _Archive([group for group in groups if group.count], modified).content()


class _Group:
    """Where the members of a group and their entries in the directory stand."""

    def __init__(self, members: Members, start: int) -> None:
        self.members = members
        self.start = start
        self.name_bytes = len(members.name(0))
        self.large = members.size >= ZIP64_LIMIT
        self.header = _LOCAL.size + self.name_bytes + _LOCAL_ZIP64.size * self.large
        trailer = _DESCRIPTOR_ZIP64 if self.large else _DESCRIPTOR
        self.trailer = 0 if members.checksums is not None else trailer.size
        self.stride = self.header + members.size + self.trailer
        self.stop = start + members.count * self.stride
        # Members from here on begin where 32 bits do not reach.
        self.far = min(max(-((start - ZIP64_LIMIT) // self.stride), 0), members.count)

    def entry_bytes(self, *, far: bool) -> int:
        """Return the size of an entry in the directory."""
        numbers = 2 * self.large + far
        return _CENTRAL.size + self.name_bytes + (4 + 8 * numbers if numbers else 0)

    @property
    def directory_bytes(self) -> int:
        far = self.members.count - self.far
        return self.far * self.entry_bytes(far=False) + far * self.entry_bytes(far=True)


class _Archive:
    def __init__(self, groups: Sequence[Members], modified: float) -> None:
        self._groups: list[_Group] = []
        self._directory = 0
        for members in groups:
            group = _Group(members, self._directory)
            self._groups.append(group)
            self._directory = group.stop
        sizes = [group.directory_bytes for group in self._groups]
        self._entries = list(accumulate(sizes, initial=self._directory))
        self._end = self._entries[-1]
        self._time = _dos_time(modified)
        self._last = self._end_records()

    def content(self) -> Content:
        seekable = all(group.members.checksums is not None for group in self._groups)
        return Content(self._end + len(self._last), self._read, seekable)

    async def _read(self, start: int, stop: int) -> AsyncIterator[bytes]:
        """Yield bytes of the archive in blocks that are worth sending."""
        waiting: list[bytes] = []
        size = 0
        async with aclosing(self._pieces(start, stop)) as pieces:
            async for piece in pieces:
                if size + len(piece) > SEND_BYTES and waiting:
                    yield b"".join(waiting)
                    waiting, size = [], 0
                waiting.append(piece)
                size += len(piece)
        if waiting:
            yield b"".join(waiting)

    async def _pieces(self, start: int, stop: int) -> AsyncGenerator[bytes]:
        found: list[Sequence[int]] = []
        for group in self._groups:
            counted = array("I")
            found.append(counted if group.members.checksums is None else group.members.checksums)
            if start < group.stop and stop > group.start:
                async for piece in self._locals(group, start, stop, counted):
                    yield piece
        for group, checksums, first in zip(self._groups, found, self._entries[:-1], strict=True):
            for piece in self._entries_of(group, checksums, first, start, stop):
                yield piece
        if stop > self._end:
            yield self._last[max(start - self._end, 0) : stop - self._end]

    async def _locals(
        self, group: _Group, start: int, stop: int, counted: array[int]
    ) -> AsyncIterator[bytes]:
        """Yield the members of a group, as far as they lie within a range of the archive."""
        members = group.members
        first = max(start - group.start, 0) // group.stride
        last = min(-(-(stop - group.start) // group.stride), members.count)
        content_of = members.open(range(first, last))
        for index in range(first, last):
            begin = group.start + index * group.stride
            known = None if members.checksums is None else members.checksums[index]
            header = self._local_header(group, index, known)
            piece = header[max(start - begin, 0) : max(stop - begin, 0)]
            if piece:
                yield piece
            body = begin + group.header
            lower, upper = max(start - body, 0), min(stop - body, members.size)
            checksum = 0
            if lower < upper:
                given = lower
                async with aclosing(_generator(content_of(index), lower, upper)) as chunks:
                    async for chunk in chunks:
                        given += len(chunk)
                        if known is None:
                            checksum = zlib.crc32(chunk, checksum)
                        yield chunk
                if given != upper:
                    name = members.name(index)
                    raise ValueError(f"{name} has {given} bytes instead of {upper}")
            if known is None:
                counted.append(checksum)
                kind = _DESCRIPTOR_ZIP64 if group.large else _DESCRIPTOR
                trailer = kind.pack(b"PK\7\10", checksum, members.size, members.size)
                behind = body + members.size
                piece = trailer[max(start - behind, 0) : max(stop - behind, 0)]
                if piece:
                    yield piece

    def _local_header(self, group: _Group, index: int, checksum: int | None) -> bytes:
        """APPNOTE.TXT, section 4.3.7."""
        size = group.members.size
        flags = 0 if checksum is not None else _FOLLOWS
        if checksum is None:
            size = 0
        stated = _LIMIT_32 if group.large else size
        extra = _LOCAL_ZIP64.pack(1, 16, size, size) if group.large else b""
        name = group.members.name(index).encode("ascii")
        if len(name) != group.name_bytes:
            raise ValueError(f"{name!r} is not as long as the first name of its group")
        version = _ZIP64_VERSION if group.large else _PLAIN_VERSION
        head = _LOCAL.pack(
            b"PK\3\4",
            version,
            flags,
            0,
            *self._time,
            checksum or 0,
            stated,
            stated,
            len(name),
            len(extra),
        )
        return head + name + extra

    def _entries_of(
        self, group: _Group, checksums: Sequence[int], first: int, start: int, stop: int
    ) -> Iterator[bytes]:
        """Yield entries of the directory, as far as they lie within a range of the archive."""
        for far in (False, True):
            size = group.entry_bytes(far=far)
            indices = range(group.far, group.members.count) if far else range(group.far)
            begin = max(start - first, 0) // size
            end = min(-(-(stop - first) // size), len(indices))
            for place in range(begin, end):
                position = first + place * size
                entry = self._entry(group, indices[place], checksums[indices[place]], far=far)
                yield entry[max(start - position, 0) : stop - position]
            first += size * len(indices)

    def _entry(self, group: _Group, index: int, checksum: int, *, far: bool) -> bytes:
        """APPNOTE.TXT, sections 4.3.12 and 4.5.3."""
        size, offset = group.members.size, group.start + index * group.stride
        numbers = [size, size] * group.large + [offset] * far
        extra = (
            struct.pack(f"<2H{len(numbers)}Q", 1, 8 * len(numbers), *numbers) if numbers else b""
        )
        name = group.members.name(index).encode("ascii")
        version = _ZIP64_VERSION if numbers else _PLAIN_VERSION
        head = _CENTRAL.pack(
            b"PK\1\2",
            _UNIX | version,
            version,
            _FOLLOWS if group.members.checksums is None else 0,
            0,
            *self._time,
            checksum,
            _LIMIT_32 if group.large else size,
            _LIMIT_32 if group.large else size,
            len(name),
            len(extra),
            0,
            0,
            0,
            _FILE_MODE,
            _LIMIT_32 if far else offset,
        )
        return head + name + extra

    def _end_records(self) -> bytes:
        """APPNOTE.TXT, sections 4.3.14 to 4.3.16."""
        count = sum(group.members.count for group in self._groups)
        length, offset = self._end - self._directory, self._directory
        records = b""
        if count >= _LIMIT_16 or length >= ZIP64_LIMIT or offset >= ZIP64_LIMIT:
            records = _END_ZIP64.pack(
                b"PK\6\6",
                _END_ZIP64.size - 12,
                _UNIX | _ZIP64_VERSION,
                _ZIP64_VERSION,
                0,
                0,
                count,
                count,
                length,
                offset,
            ) + _LOCATOR_ZIP64.pack(b"PK\6\7", 0, self._end, 1)
            count, length, offset = _LIMIT_16, _LIMIT_32, _LIMIT_32
        return records + _END.pack(b"PK\5\6", 0, 0, count, count, length, offset, 0)


async def _generator(content: Content, start: int, stop: int) -> AsyncGenerator[bytes]:
    """Yield a part of a content; whatever iterator it gives, this one can be closed."""
    async for chunk in content.read(start, stop):
        yield chunk


def _dos_time(seconds: float) -> tuple[int, int]:
    """Return time and date as MS-DOS has them: steps of two seconds, from 1980 to 2107."""
    moment = datetime.fromtimestamp(min(max(seconds, 315619200), 4354819198), UTC)
    date = (moment.year - 1980) << 9 | moment.month << 5 | moment.day
    return moment.hour << 11 | moment.minute << 5 | moment.second // 2, date
