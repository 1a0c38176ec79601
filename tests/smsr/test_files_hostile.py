"""Files made to break readers: changed at random, or small on disk and huge in memory."""

from __future__ import annotations

import gzip
import io
import json
import os
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
import scipy.io

from smsr.errors import InputError
from smsr.files import HEAD_BYTES, Role, check_prefix, load_faces, npy_header, open_array
from smsr.measurements import as_source

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

CASES = int(os.environ.get("SMSR_MUTATIONS", "300"))
"""Changed files of each format; an HDF5 file costs a process, so of those there are a tenth."""

LIMIT = 2**20
SECONDS = 30.0

rng = np.random.default_rng(0)
W = rng.standard_normal((12, 15))
S = rng.standard_normal((18, 15)).astype(np.float32)
FACES = rng.integers(0, 15, (9, 3), dtype=np.int32)


def by_numpy(save: Callable[..., Any], *arrays: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arrays, **named)
    return buffer.getvalue()


def by_scipy(*, compress: bool) -> bytes:
    buffer: Any = io.BytesIO()
    cells = np.array([W, "x"], dtype=object)
    content = {"W": W, "GT": {"name": "x", "shape3D": S}, "faces": FACES, "cells": cells}
    scipy.io.savemat(buffer, content, do_compression=compress)
    return bytes(buffer.getvalue())


def by_h5py() -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.create_dataset("W", data=W.T, chunks=(5, 12), compression="gzip", shuffle=True)
        file["GT/shape3D"] = S
        file.create_dataset("faces", data=FACES, chunks=(9, 2), compression="lzf")
        file["W"].attrs["MATLAB_class"] = np.bytes_("double")
    return buffer.getvalue()


def by_savetxt(**how: Any) -> bytes:
    buffer = io.BytesIO()
    np.savetxt(buffer, W, **how)
    return buffer.getvalue()


SOUND: dict[str, Callable[[], bytes]] = {
    "c.npy": lambda: by_numpy(np.save, W),
    "fortran.npy": lambda: by_numpy(np.save, np.asfortranarray(S.reshape(6, 3, 15))),
    "stored.npz": lambda: by_numpy(np.savez, W=W, S=S, faces=FACES),
    "deflated.npz": lambda: by_numpy(np.savez_compressed, W=W, S=S, faces=FACES),
    "plain.mat": lambda: by_scipy(compress=False),
    "compressed.mat": lambda: by_scipy(compress=True),
    "w.h5": by_h5py,
    "commas.csv": lambda: by_savetxt(delimiter=",", header="a,b"),
    "blanks.txt": lambda: by_savetxt(fmt="%g"),
    "packed.csv.gz": lambda: gzip.compress(by_savetxt(delimiter=";", fmt="%g")),
}

EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1]


def mutated(content: bytes, random_: random.Random) -> bytes:
    """Change a file in one to three ways, more often near its ends, where headers stand."""
    data = bytearray(content)
    for _ in range(random_.choice([1, 1, 2, 3])):
        if not data:
            break
        near = min(len(data), random_.choice([64, 512, len(data)]))
        at = random_.randrange(near) if random_.random() < 0.7 else len(data) - 1
        at -= random_.randrange(near) if at == len(data) - 1 else 0
        at = max(at, 0)
        match random_.randrange(8):
            case 0:
                del data[at:]
            case 1:
                data[at] ^= 1 << random_.randrange(8)
            case 2:
                data[at] = random_.choice([0, 1, 0x7F, 0x80, 0xFF, random_.randrange(256)])
            case 3:
                size = random_.choice([1, 2, 4, 8])
                value = random_.choice(EXTREMES) & (2 ** (8 * size) - 1)
                data[at : at + size] = value.to_bytes(size, random_.choice(["little", "big"]))
            case 4:
                del data[at : at + random_.choice([1, 2, 8, 100])]
            case 5:
                data[at:at] = data[at : at + random_.choice([1, 8, 100])]
            case 6:
                data[at:at] = random_.randbytes(random_.choice([1, 4, 16]))
            case 7:  # digits of a text or of a header
                digits = [i for i, byte in enumerate(data[:2000]) if 48 <= byte <= 57]
                if digits:
                    data[random_.choice(digits)] = random_.choice(b"0123456789-.eLj(),'")
    return bytes(data)


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
    refused = 0
    for _ in range(CASES // 10 if name == "w.h5" else CASES):
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
