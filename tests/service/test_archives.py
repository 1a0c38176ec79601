from __future__ import annotations

import asyncio
import io
import zipfile
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.archives import SEND_BYTES, Member, archive_size, stream_archive

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

MARCH = 1_772_366_400.0  # 2026-03-01 12:00 UTC


def reader(*chunks: bytes) -> Callable[[], AsyncIterator[bytes]]:
    async def read() -> AsyncIterator[bytes]:
        for chunk in chunks:
            yield chunk

    return read


def member(name: str, *chunks: bytes) -> Member:
    return Member(name, sum(map(len, chunks)), reader(*chunks))


async def collect(members: Sequence[Member], modified: float = MARCH) -> list[bytes]:
    return [block async for block in stream_archive(members, modified)]


def build(members: Sequence[Member]) -> bytes:
    return b"".join(asyncio.run(collect(members)))


@given(st.lists(st.lists(st.binary(max_size=300), max_size=4), max_size=6))
@settings(max_examples=60, deadline=None)
def test_members_come_back_and_the_length_was_known(contents: list[list[bytes]]) -> None:
    members = [member(f"part-{i}.bin", *chunks) for i, chunks in enumerate(contents)]
    archive = build(members)
    assert len(archive) == archive_size(members)
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        assert opened.testzip() is None
        assert opened.namelist() == [m.name for m in members]
        for m, chunks in zip(members, contents, strict=True):
            assert opened.read(m.name) == b"".join(chunks)
            assert opened.getinfo(m.name).date_time == (2026, 3, 1, 12, 0, 0)


def test_the_length_is_right_beyond_the_limits_of_32_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the limit of ZIP64 lowered, small members need every kind of ZIP64 record."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)
    members = [
        member("small", b"a" * 10),
        member("large", b"b" * 1500),
        member("behind", b"c" * 20),
        member("large-and-behind", b"d" * 1001),
        member("at-the-limit", b"e" * 1000),
    ]
    archive = build(members)
    assert len(archive) == archive_size(members)
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        assert [opened.read(m.name)[:1] for m in members] == [b"a", b"b", b"c", b"d", b"e"]
        assert opened.testzip() is None


def test_the_length_is_right_with_more_members_than_16_bits_count() -> None:
    members = [member(str(i), b"x") for i in range(zipfile.ZIP_FILECOUNT_LIMIT + 1)]
    archive = build(members)
    assert len(archive) == archive_size(members)
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        assert len(opened.namelist()) == len(members)


@pytest.mark.slow
def test_the_length_is_right_beyond_four_gibibytes() -> None:
    block = bytes(1 << 24)
    members = [member("shapes.npy", *[block] * 257), member("behind", b"end")]

    async def measure() -> tuple[int, bytes]:
        length, tail = 0, b""
        async for chunk in stream_archive(members, MARCH):
            length += len(chunk)
            tail = (tail + chunk[-500:])[-500:]
        return length, tail

    length, tail = asyncio.run(measure())
    assert length == archive_size(members) > 1 << 32
    assert b"PK\x06\x06" in tail  # the ZIP64 end of central directory


def test_equal_members_make_equal_archives() -> None:
    assert build([member("a", b"1", b"2")]) == build([member("a", b"12")])


def test_a_member_of_another_length_than_promised_breaks_the_archive_off() -> None:
    members = [Member("short", 5, reader(b"1234"))]
    with pytest.raises(ValueError, match="short has 4 bytes instead of 5"):
        build(members)


def test_small_members_travel_together_and_large_ones_are_not_held_back() -> None:
    many = [member(str(i), bytes(100)) for i in range(1000)]
    assert len(asyncio.run(collect(many))) == 1
    large = [member("large", *[bytes(SEND_BYTES)] * 8)]
    sizes = [len(block) for block in asyncio.run(collect(large))]
    assert len(sizes) >= 8
    assert max(sizes) < SEND_BYTES + 1000


def test_numpy_reads_an_archive_of_arrays() -> None:
    array = np.arange(12, dtype="<f4").reshape(2, 2, 3)
    buffer = io.BytesIO()
    np.save(buffer, array)
    with np.load(io.BytesIO(build([member("shapes.npy", buffer.getvalue())]))) as opened:
        np.testing.assert_array_equal(opened["shapes"], array)
