"""Stored ZIP archives made while they stream, of a length known before the first byte.

The standard library's `zipfile` writes to a stream that cannot seek by putting checksum and sizes
behind each member (APPNOTE.TXT, section 4.3.9), so nothing is read twice and nothing is buffered.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Sequence

    from typing_extensions import Buffer

SEND_BYTES = 256 * 1024
"""Small members are sent together, in blocks of about this size."""

# Sizes in bytes of the records of APPNOTE.TXT, sections 4.3.7 to 4.3.16 and 4.5.3.
_LOCAL_HEADER, _LOCAL_ZIP64_EXTRA = 30, 20
_DESCRIPTOR, _DESCRIPTOR_ZIP64 = 16, 24
_CENTRAL_HEADER, _CENTRAL_ZIP64_EXTRA, _ZIP64_NUMBER = 46, 4, 8
_END, _END_ZIP64 = 22, 56 + 20


@dataclass(frozen=True, slots=True)
class Member:
    """A file of an archive.

    Attributes
    ----------
    name : str
        ASCII name within the archive.
    size : int
        Number of bytes that `read` will give.
    read : callable
        Opens the content, in chunks.
    """

    name: str
    size: int
    read: Callable[[], AsyncIterator[Buffer]]


class _Pipe(io.RawIOBase):
    """A stream that cannot seek; what is written to it waits until it is taken."""

    def __init__(self) -> None:
        super().__init__()
        self._written: list[bytes] = []
        self.waiting = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Buffer, /) -> int:
        # The chunks of a member come as bytes already: no copy is made of those.
        block = data if isinstance(data, bytes) else bytes(data)
        self._written.append(block)
        self.waiting += len(block)
        return len(block)

    def take(self) -> bytes:
        """Return and forget what was written."""
        taken, self._written, self.waiting = self._written, [], 0
        return taken[0] if len(taken) == 1 else b"".join(taken)


def archive_size(members: Iterable[Member]) -> int:
    """Return the exact length in bytes of what `stream_archive` gives for these members."""
    limit = zipfile.ZIP64_LIMIT
    offset = directory = count = 0
    for member in members:
        large = member.size > limit
        numbers = 2 * large + (offset > limit)
        directory += _CENTRAL_HEADER + len(member.name)
        directory += (_CENTRAL_ZIP64_EXTRA + _ZIP64_NUMBER * numbers) if numbers else 0
        offset += _LOCAL_HEADER + len(member.name) + member.size
        offset += (_LOCAL_ZIP64_EXTRA + _DESCRIPTOR_ZIP64) if large else _DESCRIPTOR
        count += 1
    zip64 = count > zipfile.ZIP_FILECOUNT_LIMIT or offset > limit or directory > limit
    return offset + directory + _END + _END_ZIP64 * zip64


async def stream_archive(members: Sequence[Member], modified: float) -> AsyncIterator[bytes]:
    """Yield a ZIP archive of uncompressed members.

    Parameters
    ----------
    members : sequence of Member
        In the order they get in the archive. ZIP64 records are used only where a size needs them,
        since some unpackers know them badly.
    modified : float
        Time stamp of every member, seconds since 1970 (UTC). The same members and time give the
        same bytes.

    Raises
    ------
    ValueError
        A member gave another number of bytes than its size says.
    """
    pipe = _Pipe()
    stamp = datetime.fromtimestamp(max(modified, 315619200), UTC)  # ZIP dates begin in 1980
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_STORED) as archive:
        for member in members:
            info = zipfile.ZipInfo(member.name, stamp.timetuple()[:6])
            info.external_attr = 0o644 << 16
            given = 0
            large = member.size > zipfile.ZIP64_LIMIT
            with archive.open(info, "w", force_zip64=large) as entry:
                async for chunk in member.read():
                    given += entry.write(chunk)
                    if pipe.waiting >= SEND_BYTES:
                        yield pipe.take()
            if given != member.size:
                raise ValueError(f"{member.name} has {given} bytes instead of {member.size}")
    yield pipe.take()
