from __future__ import annotations

import gzip
import io
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest
import scipy.io

from smsr.errors import (
    AmbiguousLayout,
    EmptyFile,
    GroundTruthMismatch,
    InputError,
    InvalidFaces,
    NotNumeric,
    OddRowCount,
    TooFewFrames,
    TooFewPoints,
    TooLarge,
    UnreadableFile,
    UnsupportedFormat,
    WrongShape,
)
from smsr.files import HEAD_BYTES, FileFormat, Role, check_prefix, npy_header, open_array

if TYPE_CHECKING:
    from pathlib import Path

W = np.random.default_rng(0).standard_normal((20, 600))


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def files(folder: Path) -> dict[str, bytes]:
    """The same measurements in every format."""
    np.save(folder / "w.npy", W)
    np.savez(folder / "w.npz", W=W)
    scipy.io.savemat(folder / "w.mat", {"W": W})
    scipy.io.savemat(folder / "packed.mat", {"W": W}, do_compression=True)
    with h5py.File(folder / "w.h5", "w") as file:
        file["W"] = W
    with h5py.File(folder / "user.h5", "w", userblock_size=512, libver="latest") as file:
        file["W"] = W
    np.savetxt(folder / "w.csv", W, delimiter=",")
    (folder / "w.csv.gz").write_bytes(gzip.compress((folder / "w.csv").read_bytes()))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_good_files_of_every_format_pass(tmp_path: Path) -> None:
    for name, content in files(tmp_path).items():
        for head in (content[:HEAD_BYTES], content):
            for size in (None, len(content)):
                assert check_prefix(head, size, name, "measurements").format in FileFormat
        np.testing.assert_array_equal(open_array(tmp_path / name), W)


def test_truncated_files_are_refused_where_the_beginning_tells(tmp_path: Path) -> None:
    content = files(tmp_path)
    for name in ("w.npy", "w.mat", "packed.mat", "w.h5", "user.h5"):
        size = len(content[name]) - 100
        with pytest.raises(UnreadableFile, match=name):
            check_prefix(content[name][: min(size, HEAD_BYTES)], size, name, "measurements")


def test_shape_and_type_are_known_from_an_npy_header() -> None:
    beginning = check_prefix(npy(W)[:HEAD_BYTES], None, "w.npy", "measurements")
    assert (beginning.shape, beginning.dtype) == ((20, 600), np.dtype(np.float64))


@pytest.mark.parametrize(
    ("shape", "role", "error"),
    [
        ((21, 600), "measurements", OddRowCount),
        ((4, 600), "measurements", TooFewFrames),
        ((20, 3), "measurements", TooFewPoints),
        ((600,), "measurements", WrongShape),
        ((20, 0), "measurements", WrongShape),
        ((9, 9, 9), "measurements", WrongShape),
        ((20, 2, 2), "measurements", AmbiguousLayout),
        ((10**6, 10**6), "measurements", TooLarge),
        ((2**62, 2**62), "measurements", TooLarge),
        ((31, 600), "ground_truth", GroundTruthMismatch),
        ((6, 600), "ground_truth", TooFewFrames),
        ((30, 3), "ground_truth", TooFewPoints),
        ((30, 4, 5), "ground_truth", WrongShape),
        ((600, 4), "faces", InvalidFaces),
        ((3,), "faces", InvalidFaces),
    ],
)
def test_shapes_are_refused_by_the_header_alone(
    shape: tuple[int, ...], role: Role, error: type[InputError]
) -> None:
    with pytest.raises(error, match=r"w\.npy"):
        check_prefix(npy_header(shape, "<f8"), None, "w.npy", role)


@pytest.mark.parametrize(
    ("shape", "role"),
    [
        ((20, 600), "measurements"),
        ((10, 2, 600), "measurements"),
        ((10, 600, 2), "measurements"),
        ((2, 10, 600), "measurements"),  # if the layout, which comes later, is "stacked"
        ((30, 600), "ground_truth"),
        ((10, 600, 3), "ground_truth"),
        ((10, 3, 600), "ground_truth"),
        ((1000, 3), "faces"),
    ],
)
def test_shapes_that_some_layout_allows_pass(shape: tuple[int, ...], role: Role) -> None:
    assert check_prefix(npy_header(shape, "<f4"), None, "w.npy", role).shape == shape


def test_a_layout_that_is_known_counts() -> None:
    header = npy_header((2, 10, 600), "<f4")
    assert check_prefix(header, None, "w.npy", "measurements", layout="stacked").shape
    with pytest.raises(WrongShape):
        check_prefix(header, None, "w.npy", "measurements", layout="auto")


@pytest.mark.parametrize(
    ("head", "name", "error"),
    [
        (b"", "w.npy", EmptyFile),
        (npy(np.full((6, 4), None)), "w.npy", UnreadableFile),
        (npy(W * 1j), "w.npy", NotNumeric),
        (npy(W)[:50], "w.npy", UnreadableFile),
        (npy(W) + b"x", "w.npy", UnreadableFile),
        (b"1,2,3\n", "w.npy", UnsupportedFormat),
        (bytes(100), "w.npy", UnsupportedFormat),
        (bytes(range(256)), "w.bin", UnsupportedFormat),
        (b"\x80\x04\x95" + bytes(20), "w.pkl", UnsupportedFormat),
        (b"PK\x03\x04", "w.npz", UnreadableFile),
        (b"PK\x05\x06" + bytes(18), "w.npz", UnreadableFile),
        (b"MATLAB 5.0".ljust(124) + b"\x00\x01IM", "w.mat", UnreadableFile),
        (b"a,b\nc,d\n", "w.csv", NotNumeric),
        (b"a,b\n", "w.csv", UnreadableFile),
        (gzip.compress(b"a,b\nc,d\n", mtime=0), "w.csv.gz", NotNumeric),
        (gzip.compress(b"", mtime=0), "w.csv.gz", EmptyFile),
        (gzip.compress(bytes(1000), mtime=0), "w.csv.gz", UnsupportedFormat),
        (gzip.compress(npy(W), mtime=0), "w.npy.gz", UnsupportedFormat),
        (b"\x1f\x8b\x08\x00" + bytes(50), "w.csv.gz", UnreadableFile),
        (b"\x1f\x8b\x07\x00" + bytes(50), "w.csv.gz", UnreadableFile),
    ],
)
def test_whole_small_files_are_refused(head: bytes, name: str, error: type[InputError]) -> None:
    with pytest.raises(error):
        check_prefix(head, len(head), name, "measurements")


def test_a_row_that_is_cut_off_is_not_judged() -> None:
    assert check_prefix(b"# long\n1,2,3", None, "w.csv", "measurements").format == FileFormat.TEXT


def test_a_zip_bomb_costs_a_prefix_nothing() -> None:
    bomb = gzip.compress(bytes(2**26))
    with pytest.raises(UnsupportedFormat):
        check_prefix(bomb[:HEAD_BYTES], len(bomb), "w.csv.gz", "measurements")
