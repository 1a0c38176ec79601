from __future__ import annotations

import gzip
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from smsr.errors import (
    ArrayNotFound,
    EmptyFile,
    InputError,
    NotNumeric,
    TooLarge,
    UnreadableFile,
    UnsupportedFormat,
)
from smsr.files import open_array, text

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

W = np.random.default_rng(0).standard_normal((10, 60)) * 1e3


def read(folder: Path, content: bytes, name: str = "w.csv") -> NDArray[np.float64]:
    (folder / name).write_bytes(content)
    return open_array(folder / name)


def written(array: NDArray[np.float64], separator: str = ",", end: str = "\n") -> bytes:
    return "".join(separator.join(map(repr, row)) + end for row in array.tolist()).encode()


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", ", "   "])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("packed", [False, True])
def test_numbers_come_back_to_the_last_bit(
    tmp_path: Path, separator: str, end: str, packed: bool
) -> None:
    content = written(W, separator, end)
    array = read(tmp_path, gzip.compress(content) if packed else content)
    assert array.dtype == np.float64
    assert not array.flags.writeable
    np.testing.assert_array_equal(array, W)


@given(
    array=arrays.arrays(
        np.float64, st.tuples(st.integers(1, 5), st.integers(1, 5)), elements=st.floats()
    ),
    separator=st.sampled_from([",", ";", "\t", " "]),
)
def test_every_number_survives(
    tmp_path_factory: pytest.TempPathFactory, array: NDArray[np.float64], separator: str
) -> None:
    folder = tmp_path_factory.mktemp("text", numbered=True)
    np.testing.assert_array_equal(read(folder, written(array, separator)), array)


def test_small_blocks_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "_BLOCK", 2000)
    np.testing.assert_array_equal(read(tmp_path, b"# x\n" + written(W)), W)


@pytest.mark.parametrize(
    ("content", "rows"),
    [
        (b"1,2\n3,4", [[1, 2], [3, 4]]),
        (b"\xef\xbb\xbf1,2\n3,4\n", [[1, 2], [3, 4]]),
        (b"u, v\n1,2\n3,4\n", [[1, 2], [3, 4]]),
        (b'"u";"v"\n1;2\n3;4\n', [[1, 2], [3, 4]]),
        (b"# names\n\n1 2 # first\n  3\t4\n\n", [[1, 2], [3, 4]]),
        (b"1,,2\n,3,\n", [[1, np.nan, 2], [np.nan, 3, np.nan]]),
        (b"1\t\t2\n\t3\t\n", [[1, np.nan, 2], [np.nan, 3, np.nan]]),
        (b"nan, NaN, -inf\n1e3, .5, +2.\n", [[np.nan, np.nan, -np.inf], [1000, 0.5, 2]]),
        (b"1\n2\n3\n", [[1], [2], [3]]),
        (b"1 2 3\n", [[1, 2, 3]]),
    ],
)
def test_dialects(tmp_path: Path, content: bytes, rows: list[list[float]]) -> None:
    np.testing.assert_array_equal(read(tmp_path, content), rows)


@pytest.mark.parametrize(
    ("content", "error", "says"),
    [
        (b"", EmptyFile, "empty"),
        (b"\n \n", UnreadableFile, "no numbers"),
        (b"u,v\n", UnreadableFile, "no numbers"),
        (b"1,2\n3\n", UnreadableFile, "Line 2 has 1 fields"),
        (b"1,2\n# c\n3,4,5\n", UnreadableFile, "Line 3 has 3 fields"),
        (b"1,2\n3,x\n", NotNumeric, "'x' in line 2"),
        (b"1,2\n\n3,4\nu,v\n", NotNumeric, "'u' in line 4"),
        (b"u,v\nw,x\n1,2\n", NotNumeric, "'w' in line 2"),
        (b"1,5;2,5\n3,5;4,5\n", NotNumeric, "decimal point"),
        (b"1+2j,3\n4,5\n", NotNumeric, "1\\+2j"),
        (b"1_0,3\n4,5\n", NotNumeric, "1_0"),
        (b"0x10,3\n4,5\n", NotNumeric, "0x10"),
        (b"1 2\r3 4\r", UnreadableFile, "carriage return"),
        (b"1,2\n3,4\x00\n" + b" " * 70_000, UnsupportedFormat, "text"),
        (b"1,2\n" * 20_000 + b"3,\x00\n", UnsupportedFormat, "zero bytes"),
        (b"\xff\xfe1\x00,\x002\x00", UnsupportedFormat, "UTF-16"),
        (b"<html><body>404</body></html>\n", InputError, "html"),
        (b'{"W": [[1, 2], [3, 4]]}', InputError, "W"),
        (b"1,2\n3,\xe9\n", UnsupportedFormat, "no text"),
    ],
)
def test_malformed_text_is_refused(
    tmp_path: Path, content: bytes, error: type[InputError], says: str
) -> None:
    with pytest.raises(error, match=says):
        read(tmp_path, content)


def test_a_key_makes_no_sense_without_names(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_bytes(written(W))
    with pytest.raises(ArrayNotFound):
        open_array(tmp_path / "w.csv", key="W")


@pytest.mark.parametrize("part", [0.001, 0.1, 0.5, 0.999])
def test_truncated_gzip_is_refused(tmp_path: Path, part: float) -> None:
    packed = gzip.compress(written(W))
    with pytest.raises(UnreadableFile, match="truncated"):
        read(tmp_path, packed[: max(3, int(part * len(packed)))])


def test_damaged_gzip_is_refused(tmp_path: Path) -> None:
    packed = bytearray(gzip.compress(written(W)))
    packed[len(packed) // 2] ^= 1
    with pytest.raises((UnreadableFile, NotNumeric)):
        read(tmp_path, bytes(packed))


def test_other_things_in_gzip_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "w.npy", W)
    with pytest.raises(UnsupportedFormat):
        read(tmp_path, gzip.compress((tmp_path / "w.npy").read_bytes()), "w.npy.gz")


def test_the_limit_holds_for_the_array(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_bytes(written(W))
    assert open_array(tmp_path / "w.csv", limit=W.nbytes).nbytes == W.nbytes
    with pytest.raises(TooLarge):
        open_array(tmp_path / "w.csv", limit=W.nbytes - 1)


def test_endless_lines_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "_LONGEST_LINE", 1000)
    with pytest.raises(TooLarge, match="Line 2"):
        read(tmp_path, b"1 2\n" + b"3 " * 600)
