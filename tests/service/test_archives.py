from __future__ import annotations

import asyncio
import io
import random
import shutil
import subprocess
import tracemalloc
import zipfile
import zlib
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service import archives
from service.archives import SEND_BYTES, Members, archive, single
from service.content import Content, held_content

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence
    from pathlib import Path

MARCH = 1_772_366_400.0  # 2026-03-01 12:00 UTC


def member(name: str, data: bytes, *, known: bool = True) -> Members:
    return single(name, held_content(data), zlib.crc32(data) if known else None)


def group(stem: str, contents: Sequence[bytes]) -> Members:
    """Members of one size."""

    def open_all(_: range) -> Callable[[int], Content]:
        return lambda i: held_content(contents[i])

    checksums = [zlib.crc32(data) for data in contents]
    size = len(contents[0]) if contents else 0
    return Members(len(contents), size, lambda i: f"{stem}{i:06d}", open_all, checksums)


async def collect(content: Content, start: int = 0, stop: int | None = None) -> list[bytes]:
    stop = content.size if stop is None else stop
    return [block async for block in content.read(start, stop)]


def build(members: Sequence[Members], start: int = 0, stop: int | None = None) -> bytes:
    return b"".join(asyncio.run(collect(archive(members, MARCH), start, stop)))


@given(st.lists(st.tuples(st.binary(max_size=300), st.booleans()), max_size=6))
@settings(max_examples=60, deadline=None)
def test_members_come_back_and_the_length_was_known(contents: list[tuple[bytes, bool]]) -> None:
    """With checksums known before and with those that are counted."""
    members = [member(f"{i}.bin", data, known=known) for i, (data, known) in enumerate(contents)]
    content = archive(members, MARCH)
    assert content.seekable == all(known for _, known in contents)
    built = build(members)
    assert len(built) == content.size
    with zipfile.ZipFile(io.BytesIO(built)) as opened:
        assert opened.testzip() is None
        assert opened.namelist() == [f"{i}.bin" for i in range(len(contents))]
        for i, (data, _) in enumerate(contents):
            assert opened.read(f"{i}.bin") == data
            assert opened.getinfo(f"{i}.bin").date_time == (2026, 3, 1, 12, 0, 0)


@given(
    st.lists(st.integers(0, 5).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, 90)))),
    st.data(),
)
@settings(max_examples=60, deadline=None)
def test_any_range_is_that_of_the_whole(shape: list[tuple[int, int]], data: st.DataObject) -> None:
    """Whatever groups there are, and with ZIP64 records from a small limit on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archives, "ZIP64_LIMIT", data.draw(st.sampled_from([50, 500, 0xFFFFFFFF])))
        members = [
            group(f"{i}-", [random.Random(j).randbytes(size) for j in range(count)])
            for i, (count, size) in enumerate(shape)
        ]
        whole = build(members)
        start = data.draw(st.integers(0, len(whole)))
        stop = data.draw(st.integers(start, len(whole)))
        assert build(members, start, stop) == whole[start:stop]
    with zipfile.ZipFile(io.BytesIO(whole)) as opened:
        assert opened.testzip() is None
        assert len(opened.namelist()) == sum(count for count, _ in shape)


@pytest.mark.parametrize("known", [True, False])
def test_zip64_records_stand_where_numbers_need_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, known: bool
) -> None:
    """With the limit lowered, small members need every kind of ZIP64 record."""
    monkeypatch.setattr(archives, "ZIP64_LIMIT", 1000)
    contents = {
        "small": b"a" * 10,
        "large": b"b" * 1500,
        "behind": b"c" * 20,
        "large-and-behind": b"d" * 1001,
        "below-the-limit": b"e" * 999,
        "at-the-limit": b"f" * 1000,
    }
    members = [member(name, data, known=known) for name, data in contents.items()]
    path = tmp_path / "a.zip"
    path.write_bytes(build(members))
    assert path.stat().st_size == archive(members, MARCH).size
    with zipfile.ZipFile(path) as opened:
        assert {name: opened.read(name) for name in opened.namelist()} == contents
        assert opened.testzip() is None
    assert b"PK\6\6" in path.read_bytes()
    if known:
        unzip(path)


def unzip(path: Path) -> None:
    """Let another program than ours check an archive."""
    program = shutil.which("unzip")
    if program is None:
        pytest.skip("unzip is not here")
    done = subprocess.run([program, "-tqq", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_more_members_than_16_bits_count(tmp_path: Path) -> None:
    members = [group("f", [b"x"] * 0xFFFF)]
    path = tmp_path / "a.zip"
    path.write_bytes(build(members))
    assert path.stat().st_size == archive(members, MARCH).size
    with zipfile.ZipFile(path) as opened:
        assert len(opened.namelist()) == 0xFFFF
        assert opened.read("f065534") == b"x"
    unzip(path)


def zeros(size: int) -> Content:
    block = bytes(1 << 20)

    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        while start < stop:
            yield block[: stop - start]
            start += min(len(block), stop - start)

    return Content(size, read)


def test_beyond_four_gibibytes(tmp_path: Path) -> None:
    """A sparse file takes the parts that are not zero; Python and unzip read its directory."""
    size = 5 << 30
    large = single("large", zeros(size), 0)  # its checksum is not looked at
    members = [large, member("behind", b"end"), group("f", [b"1", b"2"])]
    content = archive(members, MARCH)
    path = tmp_path / "a.zip"
    with path.open("wb") as file:
        file.write(build(members, 0, 200))
        file.seek(size)
        file.write(build(members, size))
    assert path.stat().st_size == content.size > size
    with zipfile.ZipFile(path) as opened:
        assert opened.getinfo("large").file_size == size
        assert [opened.read(name) for name in ("behind", "f000000", "f000001")] == [
            b"end",
            b"1",
            b"2",
        ]


def test_equal_members_make_equal_archives() -> None:
    assert build([member("a", b"12")]) == build([member("a", b"12")])


def test_a_member_of_another_length_than_promised_breaks_the_archive_off() -> None:
    async def read(start: int, stop: int) -> AsyncIterator[bytes]:
        yield b"1234"

    with pytest.raises(ValueError, match="short has 4 bytes instead of 5"):
        build([single("short", Content(5, read))])


def test_names_of_a_group_are_of_one_length() -> None:
    members = Members(11, 1, str, lambda _: lambda _: held_content(b"x"), [0] * 11)
    with pytest.raises(ValueError, match="'10' is not as long"):
        build([members])


def test_small_members_travel_together_and_large_ones_are_not_held_back() -> None:
    many = archive([group("f", [bytes(100)] * 1000)], MARCH)
    assert len(asyncio.run(collect(many))) == 1
    large = archive([single("large", zeros(8 << 20), 0)], MARCH)
    assert max(len(block) for block in asyncio.run(collect(large))) <= max(SEND_BYTES, 1 << 20)


def test_memory_does_not_grow_with_the_number_of_members() -> None:
    """The directory of a million members has 60 MB, and is never held."""

    async def peak(count: int) -> int:
        nothing = held_content(b"")
        members = Members(
            count, 0, lambda i: f"frame_{i:07d}.ply", lambda _: lambda _: nothing, Zeros()
        )
        content = archive([members], MARCH)
        tracemalloc.start()
        try:
            # Around the border between members and directory, and the very end.
            for start in (content.size // 3, content.size - 8 * SEND_BYTES):
                async for _ in content.read(start, start + 8 * SEND_BYTES):
                    pass
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert asyncio.run(peak(1_000_000)) < asyncio.run(peak(100_000)) + 200_000


class Zeros(list[int]):
    """A sequence of zeros that takes no memory."""

    def __getitem__(self, index: object) -> int:  # type: ignore[override]
        return 0


def test_numpy_reads_an_archive_of_arrays() -> None:
    array = np.arange(12, dtype="<f4").reshape(2, 2, 3)
    buffer = io.BytesIO()
    np.save(buffer, array)
    with np.load(io.BytesIO(build([member("shapes.npy", buffer.getvalue())]))) as opened:
        np.testing.assert_array_equal(opened["shapes"], array)
