"""Files made to break readers: changed at random, or small on disk and huge in memory."""

from __future__ import annotations

import io
import json
import random
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest

from smsr.errors import InputError
from smsr.files import HEAD_BYTES, Role, check_prefix, load_faces, npy_header, open_array
from smsr.measurements import as_source
from tests.damage import CASES, SOUND, S, W, mutated

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

LIMIT = 2**20
SECONDS = 30.0


def opened(path: Path, role: Role, name: str) -> NDArray[Any]:
    """Open a file as the worker does."""
    array = open_array(path, role=role, limit=LIMIT, name=name)
    assert array.nbytes <= LIMIT
    float(np.sum(array, dtype=np.float64))  # every byte can be read
    if role == "measurements":
        as_source(array)
    if role == "faces":
        load_faces(array, 15)
    return array


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", SOUND)
def test_changed_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    """Nothing but an `InputError` comes out, and what a prefix is refused for is no good file."""
    random_ = random.Random(name)
    sound = SOUND[name]()
    path = tmp_path / name
    path.write_bytes(sound)
    expected = S if name == "fortran.npy" else W
    np.testing.assert_allclose(
        open_array(path, limit=LIMIT).reshape(expected.shape), expected, rtol=1e-4
    )
    refused, cases = 0, CASES or 300
    for _ in range(cases // 10 if name == "w.h5" else cases):  # which costs a process
        content = mutated(sound, random_)
        path.write_bytes(content)
        role: Role = random_.choice(["measurements", "ground_truth", "faces"])
        started = time.perf_counter()
        good = False
        try:
            opened(path, role, name)
            good = True
        except InputError as error:
            refused += 1
            assert error.detail
            json.dumps(error.context)
        try:
            check_prefix(content[:HEAD_BYTES], len(content), name, role, LIMIT)
        except InputError:
            assert not good or role == "ground_truth", content[:200]
        assert time.perf_counter() - started < SECONDS
    assert refused > 0


def test_no_bytes_at_all_are_refused_whatever_the_name(tmp_path: Path) -> None:
    for name in SOUND:
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(InputError):
            open_array(tmp_path / name)


BOMB_LIMIT = 2**26

OPEN_AND_MEASURE = """
import json, resource, sys, time
from smsr.errors import InputError
from smsr.files import open_array
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
for path in sys.argv[2:]:
    started = time.perf_counter()
    try:
        open_array(path, limit=int(sys.argv[1]))
        outcome = "opened"
    except InputError as error:
        outcome = type(error).__name__
    print(json.dumps([outcome, peak() - before, time.perf_counter() - started]))
"""


def zeros(size: int) -> bytes:
    """A zlib stream of zeros, made fast: a flushed block of deflate can be repeated."""
    compressor = zlib.compressobj()
    start = compressor.compress(b"") + compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(2**24)) + compressor.flush(zlib.Z_FULL_FLUSH)
    return start + block * (size // 2**24) + compressor.flush()


def zip_bomb(claimed: int) -> bytes:
    """An .npz whose member inflates to 4 GiB and says that it has `claimed` bytes."""
    header = npy_header((10, claimed // 80), "<f8")
    compressor = zlib.compressobj(wbits=-15)
    packed = compressor.compress(header) + compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(2**24)) + compressor.flush(zlib.Z_FULL_FLUSH)
    packed += block * 256 + compressor.flush()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("W.npy", packed)
    content = bytearray(buffer.getvalue())
    size = len(header) + claimed // 80 * 80
    for signature, method, length in ((b"PK\x03\x04", 8, 22), (b"PK\x01\x02", 10, 24)):
        at = content.index(signature)
        content[at + method] = zipfile.ZIP_DEFLATED
        content[at + length : at + length + 4] = struct.pack("<I", size)
    return bytes(content)


def mat_bomb(tag_size: int, shape: tuple[int, int]) -> bytes:
    """A compressed MATLAB variable that goes on for 4 GiB."""
    head = struct.pack("<II", 14, tag_size) + struct.pack("<IIII", 6, 8, 6, 0)
    head += struct.pack("<IIii", 5, 8, *shape) + struct.pack("<HHI", 1, 1, ord("W"))
    head += struct.pack("<II", 9, shape[0] * shape[1] * 8)
    compressor = zlib.compressobj()
    packed = compressor.compress(head) + compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(2**24)) + compressor.flush(zlib.Z_FULL_FLUSH)
    packed += block * 256 + compressor.flush()
    text = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    return text + struct.pack("<II", 15, len(packed)) + packed


def mat_struct_bomb() -> bytes:
    """A field that comes after one of 3 GiB."""
    size = 3 * 2**30
    head = struct.pack("<II", 14, size + 200) + struct.pack("<IIII", 6, 8, 2, 0)
    head += struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<HHI", 1, 1, ord("G"))
    head += struct.pack("<HHI", 5, 4, 8) + struct.pack("<II", 1, 16) + b"a".ljust(8, b"\0") * 2
    head += struct.pack("<II", 14, size)
    compressor = zlib.compressobj()
    packed = compressor.compress(head) + compressor.flush(zlib.Z_FULL_FLUSH)
    inner = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 2**14, 2**14)
    inner += struct.pack("<HHI", 1, 0, 0) + struct.pack("<II", 9, 2**31)
    packed += compressor.compress(inner) + compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(2**24)) + compressor.flush(zlib.Z_FULL_FLUSH)
    packed += block * 200 + compressor.flush()
    text = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    return text + struct.pack("<II", 15, len(packed)) + packed


def gzip_bomb(line: bytes) -> bytes:
    compressor = zlib.compressobj(wbits=31)
    data = compressor.compress(b"") + compressor.flush(zlib.Z_FULL_FLUSH)
    lines = line * (2**24 // len(line))
    block = compressor.compress(lines) + compressor.flush(zlib.Z_FULL_FLUSH)
    return data + block * 256 + compressor.flush()


def hdf5_bomb() -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        dataset = file.create_dataset("W", (10, 600), "<f8", chunks=(10, 600), compression="gzip")
        dataset.id.write_direct_chunk((0, 0), zeros(2**32))
    return buffer.getvalue()


BOMBS: dict[str, Callable[[], bytes]] = {
    "honest.npz": lambda: zip_bomb(2**31),
    "lying.npz": lambda: zip_bomb(2**20),
    "honest.mat": lambda: mat_bomb(2**32 - 8, (2**14, 2**15 - 1)),
    "lying.mat": lambda: mat_bomb(56 + 8 * 6000, (10, 600)),
    "lying_more.mat": lambda: mat_bomb(2**32 - 8, (10, 600)),
    "struct.mat": mat_struct_bomb,
    "zeros.csv.gz": lambda: gzip_bomb(b"\0"),
    "one_line.csv.gz": lambda: gzip_bomb(b"1"),
    "lines.csv.gz": lambda: gzip_bomb(b"1,1,1,1\n"),
    "comments.csv.gz": lambda: gzip_bomb(b"# nothing\n"),
    "empty_lines.csv.gz": lambda: gzip_bomb(b"\n"),
    "chunk.h5": hdf5_bomb,
}


@pytest.mark.skipif(sys.platform == "win32", reason="measures memory by getrusage")
def test_bombs_are_refused_quickly_and_in_little_memory(tmp_path: Path) -> None:
    for name, bomb in BOMBS.items():
        (tmp_path / name).write_bytes(bomb())
        assert (tmp_path / name).stat().st_size < 2**25
    paths = [str(tmp_path / name) for name in BOMBS]
    command = [sys.executable, "-c", OPEN_AND_MEASURE, str(BOMB_LIMIT), *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    for name, line in zip(BOMBS, done.stdout.splitlines(), strict=True):
        outcome, memory, seconds = json.loads(line)
        assert outcome in ("TooLarge", "UnreadableFile", "UnsupportedFormat"), (name, outcome)
        assert memory < 4 * BOMB_LIMIT, name
        assert seconds < SECONDS, name
