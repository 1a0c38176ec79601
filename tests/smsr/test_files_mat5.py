from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from smsr.errors import (
    ArrayNotFound,
    InputError,
    NotNumeric,
    TooLarge,
    UnreadableFile,
    UnsupportedFormat,
    WrongShape,
)
from smsr.files import open_array

if TYPE_CHECKING:
    from pathlib import Path

rng = np.random.default_rng(0)
W = rng.standard_normal((10, 60))
S = rng.standard_normal((15, 60))

HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def tag(kind: int, size: int) -> bytes:
    return kind.to_bytes(4, "little") + size.to_bytes(4, "little")


def element(kind: int, data: bytes) -> bytes:
    return tag(kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(name: bytes, array_class: int, shape: tuple[int, ...], body: bytes) -> bytes:
    flags = element(6, array_class.to_bytes(4, "little") + bytes(4))
    dimensions = element(5, np.array(shape, "<i4").tobytes())
    return element(14, flags + dimensions + element(1, name) + body)


def compressed(content: bytes) -> bytes:
    packed = zlib.compress(content)
    return tag(15, len(packed)) + packed


def doubles(name: bytes, array: Any) -> bytes:
    array = np.asarray(array, "<f8")
    return matrix(name, 6, array.shape, element(9, array.tobytes("F")))


@pytest.mark.parametrize("do_compression", [False, True])
@pytest.mark.parametrize(
    "dtype",
    ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"],
)
@pytest.mark.parametrize("shape", [(10, 6), (5, 4, 3), (1, 60), (60, 1), (1, 2)])
def test_arrays_come_back_and_plain_ones_as_maps(
    tmp_path: Path, dtype: str, shape: tuple[int, ...], do_compression: bool
) -> None:
    array = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    path = tmp_path / "w.mat"
    scipy.io.savemat(path, {"W": array, "other": 1.0}, do_compression=do_compression)
    opened = open_array(path, key="W")
    np.testing.assert_array_equal(opened, array)
    assert opened.shape == shape
    assert not opened.flags.writeable
    assert isinstance(opened, np.memmap) != do_compression


@pytest.mark.parametrize("do_compression", [False, True])
def test_fields_of_structs_are_found(tmp_path: Path, do_compression: bool) -> None:
    path = tmp_path / "w.mat"
    content = {
        "note": "a text",
        "GT": {"name": "x", "shape3D": S, "inner": {"deep": W, "empty": np.zeros((0, 0))}},
        "W": W,
        "cells": np.array([W, "x"], dtype=object),
    }
    scipy.io.savemat(path, content, do_compression=do_compression)
    np.testing.assert_array_equal(open_array(path, role="ground_truth"), S)
    np.testing.assert_array_equal(open_array(path, key="GT.inner.deep"), W)
    np.testing.assert_array_equal(open_array(path), W)
    with pytest.raises(NotNumeric, match="text"):
        open_array(path, key="note")
    with pytest.raises(NotNumeric, match="cell"):
        open_array(path, key="cells")
    with pytest.raises(WrongShape, match="empty"):
        open_array(path, key="GT.inner.empty")
    with pytest.raises(ArrayNotFound, match=r"GT\.shape3D"):
        open_array(path, key="GT.shape")


@pytest.mark.parametrize("do_compression", [False, True])
def test_what_is_no_real_array_is_refused(tmp_path: Path, do_compression: bool) -> None:
    path = tmp_path / "w.mat"
    content = {"z": W * 1j, "b": W > 0, "s": scipy.sparse.eye(5).tocsc(), "e": np.zeros((0, 5))}
    scipy.io.savemat(path, content, do_compression=do_compression)
    for key in ("z", "b", "s"):
        with pytest.raises(NotNumeric):
            open_array(path, key=key)
    with pytest.raises(WrongShape):
        open_array(path, key="e")


def test_big_endian_files_are_read(tmp_path: Path) -> None:
    def big(kind: int, data: bytes) -> bytes:
        head = kind.to_bytes(4, "big") + len(data).to_bytes(4, "big")
        return head + data + bytes(-len(data) % 8)

    flags = big(6, (6).to_bytes(4, "big") + bytes(4))
    shape = big(5, np.array(W.shape, ">i4").tobytes())
    body = flags + shape + big(1, b"W") + big(9, W.astype(">f8").tobytes("F"))
    path = tmp_path / "w.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI" + big(14, body))
    np.testing.assert_array_equal(scipy.io.loadmat(path)["W"], W)
    np.testing.assert_array_equal(open_array(path), W)


def test_doubles_that_matlab_stored_as_small_integers_are_read(tmp_path: Path) -> None:
    array = np.arange(60, dtype=np.uint8).reshape(10, 6)
    body = matrix(b"W", 6, (10, 6), element(2, array.tobytes("F")))
    for content in (body, compressed(body)):
        (tmp_path / "w.mat").write_bytes(HEADER + content)
        np.testing.assert_array_equal(open_array(tmp_path / "w.mat"), array)


def test_own_elements_are_as_scipy_reads_them(tmp_path: Path) -> None:
    """The builders of this file make valid files."""
    path = tmp_path / "w.mat"
    path.write_bytes(HEADER + doubles(b"W", W) + compressed(doubles(b"S", S)))
    read = scipy.io.loadmat(path)
    np.testing.assert_array_equal(read["W"], W)
    np.testing.assert_array_equal(read["S"], S)
    np.testing.assert_array_equal(open_array(path, key="S"), S)


@pytest.mark.parametrize("do_compression", [False, True])
@pytest.mark.parametrize("part", [0.0, 0.02, 0.1, 0.5, 0.9, 0.999])
def test_truncated_files_are_refused(tmp_path: Path, do_compression: bool, part: float) -> None:
    path = tmp_path / "w.mat"
    scipy.io.savemat(path, {"W": W}, do_compression=do_compression)
    content = path.read_bytes()
    path.write_bytes(content[: max(128, int(part * len(content)))])
    with pytest.raises((UnreadableFile, ArrayNotFound)):
        open_array(path)


def test_a_changed_byte_of_compressed_data_is_found(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    scipy.io.savemat(path, {"W": W}, do_compression=True)
    for at in (300, 1000, 4000, -1, -3):
        content = bytearray(path.read_bytes())
        content[at] ^= 4
        (tmp_path / "changed.mat").write_bytes(content)
        with pytest.raises(UnreadableFile):
            open_array(tmp_path / "changed.mat")


def test_sizes_that_do_not_fit_the_shape_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    for shape in [(10, 7), (2**31 - 1, 2**31 - 1), (-10, -60), (600,)]:
        path.write_bytes(HEADER + matrix(b"W", 6, shape, element(9, W.tobytes("F"))))
        with pytest.raises(UnreadableFile):
            open_array(path)


def nested(depth: int) -> bytes:
    """A struct in a struct in a struct."""
    inner = doubles(b"", W)
    names = element(5, (8).to_bytes(4, "little")) + element(1, b"a".ljust(8, b"\0"))
    for _ in range(depth):
        inner = matrix(b"", 2, (1, 1), names + inner)
    return matrix(b"GT", 2, (1, 1), names + inner)


def test_structs_are_followed_some_way_but_not_without_end(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    path.write_bytes(HEADER + nested(3))
    np.testing.assert_array_equal(open_array(path, key="GT.a.a.a.a"), W)
    for content in (nested(5000), compressed(nested(5000))):
        path.write_bytes(HEADER + content)
        with pytest.raises(UnreadableFile, match="deep"):
            open_array(path)


def test_too_many_variables_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    path.write_bytes(HEADER + doubles(b"x", [[1.0]]) * 30_000)
    with pytest.raises(UnreadableFile, match="elements"):
        open_array(path)


def test_the_limit_holds_for_arrays_and_for_all_that_is_inflated(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    path.write_bytes(HEADER + compressed(doubles(b"W", np.zeros((10, 1000)))))
    assert open_array(path, limit=80_000).nbytes == 80_000
    with pytest.raises(TooLarge):
        open_array(path, limit=79_999)
    names = element(5, (8).to_bytes(4, "little")) + element(1, b"a".ljust(8, b"\0") + b"b".ljust(8))
    filler = doubles(b"", np.zeros((100, 1000)))
    path.write_bytes(HEADER + compressed(matrix(b"G", 2, (1, 1), names + filler + filler)))
    with pytest.raises(TooLarge, match="inflates"):
        open_array(path, key="G.b", limit=800_000)


def test_version_4_is_named_in_the_refusal(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    scipy.io.savemat(path, {"W": W}, format="4")
    with pytest.raises(UnsupportedFormat, match="version 4"):
        open_array(path)


@pytest.mark.parametrize(
    "content",
    [
        tag(14, 2**32 - 8),
        tag(15, 100) + bytes(100),
        compressed(tag(14, 2**32 - 8)),
        compressed(b""),
        compressed(element(9, bytes(80))),
        element(14, b""),
        element(14, element(6, bytes(8))),
        matrix(b"W", 6, (10, 60), b""),
        matrix(b"W", 6, (10, 60), element(99, bytes(4800))),
        matrix(b"W", 2, (1, 1), b""),
        matrix(b"W", 2, (1, 1), element(5, bytes(4)) + element(1, b"")),
        matrix(b"W", 2, (1, 1), element(5, b"\xff\xff\xff\xff") + element(1, b"")),
        b"\x01\x00\x99\x00" + bytes(4),
    ],
)
def test_damaged_elements_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "w.mat").write_bytes(HEADER + content)
    with pytest.raises(InputError):
        open_array(tmp_path / "w.mat")


@pytest.mark.data
@pytest.mark.parametrize("name", ["drink", "pickup", "stretch", "yoga", "dance", "dinosaur"])
def test_published_sets_are_read_as_scipy_reads_them(name: str, evaluation_data: Path) -> None:
    path = evaluation_data / "sparse" / f"{name}.mat"
    read = scipy.io.loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(open_array(path), read["W"])
    truth = read["GT"]["shape3D"] if name == "dinosaur" else read["S"]
    np.testing.assert_array_equal(open_array(path, role="ground_truth"), truth)
