"""Bytes of a known length that can be read from any position on, and how they are put together."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

    from worker.storage import ObjectStorage

WINDOW_BYTES = 3 << 20
"""Bytes read from the storage at once; a multiple of a row of faces."""


@dataclass(frozen=True, slots=True)
class Content:
    """The bytes of a file.

    Attributes
    ----------
    size : int
        How many there are.
    read : callable
        Gives those from a position up to another.
    seekable : bool
        Whether `read` can begin elsewhere than at 0.
    """

    size: int
    read: Callable[[int, int], AsyncIterator[bytes]]
    seekable: bool = True


def held_content(data: bytes) -> Content:
    """Return a few bytes that are at hand."""

    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        yield data[start:stop]

    return Content(len(data), read)


def stored_content(storage: ObjectStorage, key: str, size: int, offset: int = 0) -> Content:
    """Return `size` bytes of an object, from `offset` on."""
    return Content(size, lambda start, stop: read_range(storage, key, offset + start, stop - start))


def joined(parts: Sequence[Content]) -> Content:
    """Return contents one behind the other."""

    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        for part in parts:
            first, last = max(start, 0), min(part.size, stop)
            if first < last:
                async for chunk in part.read(first, last):
                    yield chunk
            start, stop = start - part.size, stop - part.size

    return Content(sum(part.size for part in parts), read)


async def read_range(
    storage: ObjectStorage, key: str, start: int, length: int
) -> AsyncIterator[bytes]:
    """Yield a part of an object in windows, the next one being read while one is sent.

    Each window is a request of its own, so that a client that reads slowly holds no connection to
    the storage open beyond its time limit.
    """
    windows = Windows(storage, key, start, start + length)
    try:
        async for chunk in windows.read(start, start + length):
            yield chunk
    finally:
        windows.close()


class Windows:
    """A part of an object that is read mostly in order, in steps smaller than what is fetched.

    Two windows are held at most: the one that is being read and the next.

    Parameters
    ----------
    storage : ObjectStorage
    key : str
    start, stop : int
        Nothing outside of these positions is fetched.
    """

    def __init__(self, storage: ObjectStorage, key: str, start: int, stop: int) -> None:
        self._storage = storage
        self._key = key
        self._start = start
        self._stop = stop
        self._fetches: dict[int, asyncio.Task[bytes]] = {}

    async def read(self, start: int, stop: int) -> AsyncIterator[bytes]:
        """Yield the bytes from a position up to another."""
        while start < stop:
            index, offset = divmod(start - self._start, WINDOW_BYTES)
            window = await self._window(index)
            chunk = window[offset : offset + stop - start]
            if not chunk:
                raise ValueError(f"{self._key} ends before {stop}")
            start += len(chunk)
            yield chunk

    async def _window(self, index: int) -> bytes:
        for old in set(self._fetches) - {index, index + 1}:
            self._fetches.pop(old).cancel()
        for wanted in (index, index + 1):
            first = self._start + wanted * WINDOW_BYTES
            if wanted not in self._fetches and first < self._stop:
                size = min(WINDOW_BYTES, self._stop - first)
                fetch = asyncio.create_task(self._storage.get_range_async(self._key, first, size))
                fetch.add_done_callback(_forget)
                self._fetches[wanted] = fetch
        return await self._fetches[index]

    def close(self) -> None:
        """Stop fetching."""
        for fetch in self._fetches.values():
            fetch.cancel()
        self._fetches.clear()


def _forget(fetch: asyncio.Task[bytes]) -> None:
    """Look at the failure of a window that perhaps nobody asks for any more."""
    if not fetch.cancelled():
        fetch.exception()
