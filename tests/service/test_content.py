from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service import content
from service.content import Content, Windows, held_content, joined, read_range
from worker.storage import ObjectStorage

if TYPE_CHECKING:
    from pathlib import Path


async def collect(found: Content, start: int, stop: int) -> bytes:
    return b"".join([chunk async for chunk in found.read(start, stop)])


@given(st.lists(st.binary(max_size=9)), st.data())
def test_parts_joined_are_one_content(parts: list[bytes], data: st.DataObject) -> None:
    whole = b"".join(parts)
    found = joined([held_content(part) for part in parts])
    assert found.size == len(whole)
    start = data.draw(st.integers(0, len(whole)))
    stop = data.draw(st.integers(start, len(whole)))
    assert asyncio.run(collect(found, start, stop)) == whole[start:stop]


class Counting(ObjectStorage):
    """A storage that notes what is read."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.reads: list[tuple[int, int]] = []

    async def get_range_async(self, key: str, start: int, length: int) -> bytes:
        self.reads.append((start, length))
        return await super().get_range_async(key, start, length)


@pytest.fixture
def storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Counting:
    monkeypatch.setattr(content, "WINDOW_BYTES", 100)
    found = Counting(tmp_path.joinpath("objects").as_uri())
    found.put_bytes("results/a", bytes(range(256)) * 4)
    return found


def test_a_range_is_read_once_in_windows(storage: Counting) -> None:
    async def read() -> bytes:
        return b"".join([chunk async for chunk in read_range(storage, "results/a", 10, 250)])

    assert asyncio.run(read()) == (bytes(range(256)) * 4)[10:260]
    assert storage.reads == [(10, 100), (110, 100), (210, 50)]


def test_small_steps_in_order_are_one_pass(storage: Counting) -> None:
    async def read() -> bytes:
        windows = Windows(storage, "results/a", 10, 1000)
        found = [
            chunk
            for start in range(10, 1000, 33)
            async for chunk in windows.read(start, min(start + 33, 1000))
        ]
        return b"".join(found)

    assert asyncio.run(read()) == (bytes(range(256)) * 4)[10:1000]
    assert storage.reads == [(start, 100) for start in range(10, 910, 100)] + [(910, 90)]
