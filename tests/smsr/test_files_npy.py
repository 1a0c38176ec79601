from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr.errors import (
    ArrayNotFound,
    EmptyFile,
    NotNumeric,
    TooLarge,
    UnreadableFile,
    UnsupportedFormat,
    WrongShape,
)
from smsr.files import npy_header, open_array
from smsr.files.npy import parse_header

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

W = np.arange(60.0).reshape(10, 6)


def raw_npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    length = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + data


@pytest.mark.parametrize(
    "dtype", ["<f8", ">f8", "<f4", "<f2", "i1", "u1", "<i2", ">u2", "<i4", "<i8", "<u8"]
)
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_as_read_only_maps(tmp_path: Path, dtype: str, order: Any) -> None:
    path = tmp_path / "w.npy"
    saved = np.asarray(W, dtype=dtype, order=order)
    np.save(path, saved)
    opened = open_array(path)
    assert isinstance(opened, np.memmap)
    assert opened.dtype == saved.dtype
    np.testing.assert_array_equal(opened, saved)
    assert not opened.flags.writeable
    assert opened.flags.f_contiguous == saved.flags.f_contiguous


@pytest.mark.parametrize("shape", [(24,), (4, 6), (3, 2, 4), (1, 24)])
def test_any_number_of_axes_is_read(tmp_path: Path, shape: tuple[int, ...]) -> None:
    array = np.arange(24.0).reshape(shape)
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(open_array(tmp_path / "a.npy"), array)


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_every_version_of_the_format_is_read(tmp_path: Path, version: tuple[int, int]) -> None:
    path = tmp_path / "w.npy"
    with path.open("wb") as file:
        np.lib.format.write_array(file, W, version)
    np.testing.assert_array_equal(open_array(path), W)


def test_the_name_does_not_matter(tmp_path: Path) -> None:
    np.save(tmp_path / "w.npy", W)
    (tmp_path / "w.npy").rename(tmp_path / "w.csv")
    np.testing.assert_array_equal(open_array(tmp_path / "w.csv"), W)


def test_headers_of_other_writers_are_read(tmp_path: Path) -> None:
    """Python 2 wrote 10L; others put the entries in another order and leave out blanks."""
    path = tmp_path / "w.npy"
    for header in (
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10L, 6L), }",
        "{'shape':(10,6),'fortran_order':False,'descr':'<f8'}\n",
    ):
        path.write_bytes(raw_npy(header, W.tobytes()))
        np.testing.assert_array_equal(open_array(path), W)


@pytest.mark.parametrize(
    "array",
    [
        np.array([[1, "a"], [None, {}]], dtype=object),
        np.full((6, 4), None),
    ],
)
def test_pickled_objects_are_refused(tmp_path: Path, array: NDArray[Any]) -> None:
    np.save(tmp_path / "w.npy", array, allow_pickle=True)
    with pytest.raises(UnreadableFile, match="pickle"):
        open_array(tmp_path / "w.npy")


class Malicious:
    def __reduce__(self) -> tuple[Any, ...]:
        return (open, ("pickle-was-run", "w"))


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_pickles_are_never_run(
    tmp_path: Path, protocol: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "w.npy").write_bytes(pickle.dumps(Malicious(), protocol))
    with pytest.raises((UnsupportedFormat, NotNumeric, UnreadableFile)):
        open_array(tmp_path / "w.npy")
    np.save(tmp_path / "o.npy", np.array([[Malicious()] * 4] * 6), allow_pickle=True)
    with pytest.raises(UnreadableFile):
        open_array(tmp_path / "o.npy")
    assert not (tmp_path / "pickle-was-run").exists()


@pytest.mark.parametrize(
    "array",
    [
        W.astype(complex),
        W > 3,
        W.astype("U8"),
        W.astype("S8"),
        W.astype("M8[s]"),
        np.zeros((10, 6), [("u", "f4"), ("v", "f4")]),
        W.astype(np.longdouble),
    ],
    ids=lambda array: str(array.dtype),
)
def test_what_is_no_real_number_is_refused(tmp_path: Path, array: NDArray[Any]) -> None:
    np.save(tmp_path / "w.npy", array)
    with pytest.raises(NotNumeric, match="float64"):
        open_array(tmp_path / "w.npy")


@pytest.mark.parametrize("shape", [(0, 4), (4, 0)])
def test_empty_arrays_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "w.npy", np.zeros(shape))
    with pytest.raises(WrongShape, match="empty"):
        open_array(tmp_path / "w.npy")


def test_one_number_is_no_array(tmp_path: Path) -> None:
    np.save(tmp_path / "w.npy", np.float64(3))
    with pytest.raises(WrongShape):
        open_array(tmp_path / "w.npy")


@pytest.mark.parametrize("size", [1, 5, 6, 9, 10, 60, 127, 128, 129, 200, -1])
def test_truncated_files_are_refused(tmp_path: Path, size: int) -> None:
    path = tmp_path / "w.npy"
    np.save(path, W)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises((UnreadableFile, UnsupportedFormat)):
        open_array(path)


def test_a_file_that_is_too_long_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.npy"
    np.save(path, W)
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(UnreadableFile, match="1 bytes after"):
        open_array(path)


def test_no_bytes_are_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "w.npy").write_bytes(b"")
    with pytest.raises(EmptyFile):
        open_array(tmp_path / "w.npy")


def test_a_missing_file_is_no_input_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        open_array(tmp_path / "w.npy")


def test_the_limit_is_checked_by_the_header(tmp_path: Path) -> None:
    np.save(tmp_path / "w.npy", W)
    assert open_array(tmp_path / "w.npy", limit=480).nbytes == 480
    with pytest.raises(TooLarge, match="480") as caught:
        open_array(tmp_path / "w.npy", limit=479)
    assert caught.value.context == {"size": 480, "limit": 479}


def test_a_key_makes_no_sense_without_names(tmp_path: Path) -> None:
    np.save(tmp_path / "w.npy", W)
    with pytest.raises(ArrayNotFound, match="without a name"):
        open_array(tmp_path / "w.npy", key="W")


@pytest.mark.parametrize(
    "header",
    [
        "",
        "{}",
        "[]",
        "{'descr': '<f8', 'fortran_order': False}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), 'more': 1}",
        "{'descr': '<f8', 'fortran_order': 0, 'shape': (2, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': [2, 3]}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': 6}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-2, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2.0, 3)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 40 + ")}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 4400 + ",)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 400 + ",)}",
        "__import__('os').system('true')",
        "(" * 3000,
        "-" * 9000 + "1",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3)",
        "{[]: 1}",
        "\0\0\0",
        "é",
    ],
)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_malformed_headers_are_refused(tmp_path: Path, header: str, version: int) -> None:
    (tmp_path / "w.npy").write_bytes(raw_npy(header, bytes(48), version))
    with pytest.raises(UnreadableFile):
        open_array(tmp_path / "w.npy")


@pytest.mark.parametrize(
    "descr", ["'<f3'", "'<f16'", "'f8,f8'", "('<f8', (3,))", "5", "None", "''"]
)
def test_unknown_types_are_refused(tmp_path: Path, descr: str) -> None:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': (2, 3)}}"
    (tmp_path / "w.npy").write_bytes(raw_npy(header, bytes(48)))
    with pytest.raises(NotNumeric):
        open_array(tmp_path / "w.npy")


def test_long_headers_and_unknown_versions_are_refused(tmp_path: Path) -> None:
    long = raw_npy("{" + " " * 20_000, bytes(48), 2)
    unknown = b"\x93NUMPY\x04\x00" + bytes(200)
    for content in (long, unknown):
        (tmp_path / "w.npy").write_bytes(content)
        with pytest.raises(UnreadableFile):
            open_array(tmp_path / "w.npy")


def test_npy_header_makes_a_file_of_raw_bytes(tmp_path: Path) -> None:
    array = np.arange(24, dtype="<f4").reshape(2, 4, 3)
    header = npy_header((2, 4, 3), "<f4")
    (tmp_path / "a.npy").write_bytes(header + array.tobytes())
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), array)
    parsed = parse_header(header)
    assert (parsed.shape, parsed.offset, parsed.nbytes) == ((2, 4, 3), len(header), 96)
