from __future__ import annotations

import struct
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr.errors import (
    AmbiguousArray,
    ArrayNotFound,
    InputError,
    NotNumeric,
    TooLarge,
    UnreadableFile,
    UnsupportedFormat,
)
from smsr.files import open_array, write_npz

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

rng = np.random.default_rng(0)
W = rng.standard_normal((10, 600))
S = rng.standard_normal((15, 600)).astype(np.float32)
FACES = rng.integers(0, 600, (50, 3))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed], ids=["stored", "deflated"])
def test_arrays_come_back_and_stored_ones_as_maps(tmp_path: Path, save: Callable[..., Any]) -> None:
    path = tmp_path / "all.npz"
    save(path, W=W, S=np.asfortranarray(S), faces=FACES)
    for key, array in (("W", W), ("S", S), ("faces", FACES)):
        opened = open_array(path, key=key)
        np.testing.assert_array_equal(opened, array)
        assert opened.dtype == array.dtype
        assert not opened.flags.writeable
        assert isinstance(opened, np.memmap) == (save is np.savez)
    assert open_array(path, key="S").flags.f_contiguous


def test_the_role_chooses(tmp_path: Path) -> None:
    np.savez(tmp_path / "all.npz", W=W, S=S, faces=FACES, name="x", flag=np.array(True))
    np.testing.assert_array_equal(open_array(tmp_path / "all.npz"), W)
    np.testing.assert_array_equal(open_array(tmp_path / "all.npz", role="ground_truth"), S)
    np.testing.assert_array_equal(open_array(tmp_path / "all.npz", role="faces"), FACES)


def test_written_archives_are_stored_and_read_by_numpy(tmp_path: Path) -> None:
    path = tmp_path / "result"  # written under exactly this name
    write_npz(path, {"shapes": S, "faces": FACES})
    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["shapes"], S)
        np.testing.assert_array_equal(archive["faces"], FACES)
    with zipfile.ZipFile(path) as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
    assert isinstance(open_array(path, key="shapes"), np.memmap)


def test_objects_are_refused_and_do_not_hide_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "all.npz"
    np.savez(path, W=W, o=np.array([{}, None]), c=W * 1j)
    np.testing.assert_array_equal(open_array(path), W)
    with pytest.raises(UnreadableFile, match="pickle"):
        open_array(path, key="o")
    with pytest.raises(NotNumeric, match="c16"):
        open_array(path, key="c")
    with pytest.raises(ArrayNotFound, match="Did you mean 'W'"):
        open_array(path, key="w")


def test_archives_without_arrays_hold_none(tmp_path: Path) -> None:
    path = tmp_path / "all.npz"
    with zipfile.ZipFile(path, "w"):
        pass
    with pytest.raises(ArrayNotFound):
        open_array(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(ArrayNotFound):
        open_array(path)


def test_office_documents_are_recognised(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "table.xlsx", "w") as archive:
        archive.writestr("[Content_Types].xml", "<xml/>")
    with pytest.raises(UnsupportedFormat, match="csv"):
        open_array(tmp_path / "table.xlsx")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compression_is_refused(tmp_path: Path, method: int) -> None:
    """LZMA can ask for gigabytes of dictionary; NumPy writes neither."""
    np.save(tmp_path / "W.npy", W)
    with zipfile.ZipFile(tmp_path / "w.npz", "w", method) as archive:
        archive.write(tmp_path / "W.npy", "W.npy")
    with pytest.raises(UnsupportedFormat, match="savez"):
        open_array(tmp_path / "w.npz")


def test_two_members_of_one_name_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "W.npy", W)
    with zipfile.ZipFile(tmp_path / "w.npz", "w") as archive:
        archive.write(tmp_path / "W.npy", "W.npy")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.write(tmp_path / "W.npy", "W.npy")
    with pytest.raises(UnreadableFile, match="same name"):
        open_array(tmp_path / "w.npz")


def test_encrypted_members_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez(path, W=W)
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(UnsupportedFormat, match="encrypted"):
        open_array(path)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_archives_are_refused(
    tmp_path: Path, save: Callable[..., Any], part: float
) -> None:
    path = tmp_path / "w.npz"
    save(path, W=W)
    content = path.read_bytes()
    path.write_bytes(content[: max(4, int(part * len(content)))])
    with pytest.raises(UnreadableFile):
        open_array(path)


def test_a_changed_byte_of_deflated_data_is_found(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez_compressed(path, W=W)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(UnreadableFile):
        open_array(path)


@pytest.mark.parametrize("field", ["compressed", "uncompressed"])
@pytest.mark.parametrize("value", [0, 100, 2**31, 2**32 - 2])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_sizes_in_the_directory_that_lie_are_found(
    tmp_path: Path, field: str, value: int, save: Callable[..., Any]
) -> None:
    path = tmp_path / "w.npz"
    save(path, W=W)
    content = bytearray(path.read_bytes())
    at = content.rindex(b"PK\x01\x02") + (20 if field == "compressed" else 24)
    content[at : at + 4] = struct.pack("<I", value)
    path.write_bytes(content)
    with pytest.raises(UnreadableFile):
        open_array(path)


def test_the_limit_holds_for_what_is_inflated(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez_compressed(path, W=np.zeros((10, 1000)))
    assert open_array(path, limit=80_000).nbytes == 80_000
    with pytest.raises(TooLarge):
        open_array(path, limit=79_999)


def test_a_large_directory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(300):
            archive.writestr(f"{i:05}" + "x" * 5000, b"")
    with pytest.raises(UnreadableFile, match="directory"):
        open_array(path)


def test_several_candidates_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez(path, a=W, b=W, c=W)
    with pytest.raises(AmbiguousArray, match=r"a \(10, 600\), b \(10, 600\), c \(10, 600\)") as e:
        open_array(path)
    assert e.value.context["arrays"][0] == {"name": "a", "shape": [10, 600]}  # type: ignore[index]


def test_a_member_beyond_the_end_of_the_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez(path, W=W)
    content = bytearray(path.read_bytes())
    at = content.rindex(b"PK\x01\x02") + 42
    content[at : at + 4] = struct.pack("<I", 2**31)
    path.write_bytes(content)
    with pytest.raises(InputError):
        open_array(path)


@pytest.mark.parametrize(
    ("names", "role"),
    [(("a", "b"), "measurements"), (("W", "X"), "measurements"), (("faces", "b"), "faces")],
)
def test_no_array_is_taken_in_the_place_of_a_damaged_one(
    tmp_path: Path, names: tuple[str, str], role: Any
) -> None:
    first, second = names
    path = tmp_path / "damaged.npz"
    arrays: dict[str, Any] = {first: FACES, second: W}
    np.savez_compressed(path, **arrays)
    data = bytearray(path.read_bytes())
    start = 30 + len(f"{first}.npy") + int.from_bytes(data[28:30], "little")
    data[start : start + 40] = b"\xff" * 40
    path.write_bytes(data)
    with pytest.raises(UnreadableFile, match="damaged"):
        open_array(path, role=role)
    np.testing.assert_array_equal(open_array(path, key=second), W)


def test_a_damaged_array_of_another_role_does_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "damaged.npz"
    np.savez_compressed(path, faces=FACES, tracks_of_flag=W)
    data = bytearray(path.read_bytes())
    start = 30 + len("faces.npy") + int.from_bytes(data[28:30], "little")
    data[start : start + 40] = b"\xff" * 40
    path.write_bytes(data)
    np.testing.assert_array_equal(open_array(path), W)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_one_wrong_byte_is_noticed(tmp_path: Path, save: Callable[..., Any]) -> None:
    path = tmp_path / "damaged.npz"
    save(path, W=W)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") // 2] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(UnreadableFile, match="damaged"):
        open_array(path)
