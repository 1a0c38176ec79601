from __future__ import annotations

import json
import subprocess
import time
import zlib
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest

from smsr.errors import ArrayNotFound, NotNumeric, TooLarge, UnreadableFile, WrongShape
from smsr.files import hdf5, open_array

if TYPE_CHECKING:
    from pathlib import Path

rng = np.random.default_rng(0)
W = rng.standard_normal((10, 600))
S = rng.standard_normal((15, 600))


def write_matlab(path: Path, arrays: dict[str, Any], **storage: Any) -> None:
    """Write as MATLAB does: a text before the HDF5 part, axes in reverse order, a class each."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            dataset = file.create_dataset(name.replace(".", "/"), data=array.T, **storage)
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


COMPRESSED = {"compression": "gzip", "chunks": True, "shuffle": True}


@pytest.mark.parametrize("storage", [{}, COMPRESSED], ids=["plain", "compressed"])
def test_matlab_arrays_come_back_as_matlab_shows_them(
    tmp_path: Path, storage: dict[str, Any]
) -> None:
    path = tmp_path / "w.mat"
    cube = rng.standard_normal((5, 40, 3))
    write_matlab(path, {"W": W, "GT.shape3D": S, "more.cube": cube}, **storage)
    for key, array in (("W", W), ("GT.shape3D", S), ("more.cube", cube)):
        opened = open_array(path, key=key)
        np.testing.assert_array_equal(opened, array)
        assert not opened.flags.writeable
        assert isinstance(opened, np.memmap) == (storage == {})
    np.testing.assert_array_equal(open_array(path), W)
    np.testing.assert_array_equal(open_array(path, role="ground_truth"), S)


@pytest.mark.parametrize(
    ("dtype", "storage"),
    [
        ("<f8", {}),
        (">f4", {}),
        ("<i8", {"chunks": (3, 7)}),
        ("u1", {"chunks": (3, 7), "compression": "gzip"}),
        (">i2", {"fletcher32": True}),
        ("<f2", {"chunks": (10, 60), "shuffle": True, "compression": "lzf"}),
    ],
)
def test_other_hdf5_keeps_its_order_of_axes(
    tmp_path: Path, dtype: str, storage: dict[str, Any]
) -> None:
    array = np.arange(600).reshape(10, 60).astype(dtype)
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file.create_dataset("group/W", data=array, **storage)
    opened = open_array(tmp_path / "w.h5")
    np.testing.assert_array_equal(opened, array)
    assert opened.dtype == array.dtype


@pytest.mark.parametrize("chunks", [(1, 1, 1), (2, 9, 3), (7, 50, 4), (7, 1, 1), (1, 50, 4)])
def test_arrays_are_put_together_from_blocks(
    tmp_path: Path, chunks: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5, "_BLOCK", 700)
    array = rng.standard_normal((7, 50, 4)).astype(np.float32)
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file.create_dataset("W", data=array, chunks=chunks, compression="lzf")
    np.testing.assert_array_equal(open_array(tmp_path / "w.h5"), array)


def test_what_is_no_real_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.mat"
    write_matlab(path, {"W": W, "text": np.zeros((1, 4), np.uint16)})
    with h5py.File(path, "r+") as file:
        file["text"].attrs["MATLAB_class"] = np.bytes_("char")
        file["complex"] = W * 1j
        file["strings"] = ["a", "b"]
        file.create_dataset("cell", data=[file["W"].ref], dtype=h5py.ref_dtype)
        empty = file.create_dataset("empty", data=np.zeros(2, np.uint64))
        empty.attrs["MATLAB_empty"] = np.uint8(1)
        file["#refs#/hidden"] = W
    for key in ("text", "complex", "strings", "cell"):
        with pytest.raises(NotNumeric):
            open_array(path, key=key)
    with pytest.raises((UnreadableFile, WrongShape), match="empty"):
        open_array(path, key="empty")
    np.testing.assert_array_equal(open_array(path), W)
    with pytest.raises(ArrayNotFound):
        open_array(path, key="#refs#.hidden")


def test_nothing_leads_to_other_files(tmp_path: Path) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["W"] = W
    (tmp_path / "raw.bin").write_bytes(W.tobytes())
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file["link"] = h5py.ExternalLink(secret, "/W")
        file["soft"] = h5py.SoftLink("/link")
        file.create_dataset(
            "external", shape=W.shape, dtype="<f8", external=[(tmp_path / "raw.bin", 0, W.nbytes)]
        )
        layout = h5py.VirtualLayout(W.shape, "<f8")
        layout[:] = h5py.VirtualSource(secret, "W", W.shape)
        file.create_virtual_dataset("virtual", layout)
        np.testing.assert_array_equal(file["external"][...], W)  # as HDF5 itself would
    for key in ("link", "soft"):
        with pytest.raises(ArrayNotFound):
            open_array(path, key=key)
    for key in ("external", "virtual"):
        with pytest.raises(UnreadableFile, match="other files"):
            open_array(path, key=key)


def test_cycles_of_groups_end(tmp_path: Path) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file["a/W"] = W
        file["a/again"] = file["a"]
    np.testing.assert_array_equal(open_array(path, key="a.W"), W)


def test_the_limit_is_checked_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("W", data=W, compression="gzip")
    assert open_array(path, limit=W.nbytes).nbytes == W.nbytes
    with pytest.raises(TooLarge):
        open_array(path, limit=W.nbytes - 1)


def test_data_that_were_never_written_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("W", shape=(10**6, 10**3), chunks=(1000, 1000), dtype="f8")
    with pytest.raises(UnreadableFile, match="never written"):
        open_array(path, limit=2**50)


def test_a_chunk_that_inflates_without_end_costs_this_process_nothing(tmp_path: Path) -> None:
    """HDF5 inflates a chunk to its end, whatever its size should be."""
    bomb = zlib.compressobj()
    start = bomb.compress(b"") + bomb.flush(zlib.Z_FULL_FLUSH)
    zeros = bomb.compress(bytes(2**24)) + bomb.flush(zlib.Z_FULL_FLUSH)  # can be repeated
    packed = start + 256 * zeros + bomb.flush()
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("W", (10, 600), "<f8", chunks=(10, 600), compression="gzip")
        dataset.id.write_direct_chunk((0, 0), packed)
    started = time.perf_counter()
    with pytest.raises(UnreadableFile):
        open_array(path)
    assert time.perf_counter() - started < 30


@pytest.mark.parametrize("part", [0.05, 0.3, 0.6, 0.99])
def test_truncated_files_are_refused(tmp_path: Path, part: float) -> None:
    path = tmp_path / "w.mat"
    write_matlab(path, {"W": W, "S": S}, **COMPRESSED)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(UnreadableFile):
        open_array(path)


def test_a_file_that_kills_the_reading_process_is_unreadable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file["W"] = W
    crashing = tmp_path / "crash.py"
    for death in ("os.kill(os.getpid(), signal.SIGSEGV)", "os._exit(0)", "print('{')"):
        crashing.write_text(f"import os, signal\n{death}\n")
        monkeypatch.setattr(hdf5, "_PROCESS", crashing)
        with pytest.raises(UnreadableFile):
            open_array(path)


def test_no_process_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "w.h5"
    with h5py.File(path, "w") as file:
        file["W"] = W
        file["V"] = W
    started: list[subprocess.Popen[bytes]] = []

    class Recorded(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Recorded)
    open_array(path, key="W")
    with pytest.raises(ArrayNotFound):
        open_array(path, key="X")
    assert len(started) == 2
    assert all(process.returncode is not None for process in started)


def test_the_reading_process_is_told_no_secrets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = tmp_path / "told.json"
    spy = tmp_path / "spy.py"
    spy.write_text(f"import json, os\njson.dump(dict(os.environ), open({str(told)!r}, 'w'))\n")
    monkeypatch.setattr(hdf5, "_PROCESS", spy)
    monkeypatch.setenv("SMSR_STORAGE_SECRET", "x")
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file["W"] = W
    with pytest.raises(UnreadableFile):
        open_array(tmp_path / "w.h5")
    assert "SMSR_STORAGE_SECRET" not in json.loads(told.read_text())
