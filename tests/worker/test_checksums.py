from __future__ import annotations

import hashlib
import zlib
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smsr.files.ply import write_ply
from worker.checksums import (
    CHECKSUMS,
    FRAME_CHECKSUMS,
    parse_checksums,
    shift_crc32,
    write_checksums,
)

if TYPE_CHECKING:
    from pathlib import Path


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_checksums_of_parts_make_that_of_the_whole(first: bytes, second: bytes) -> None:
    shifted = shift_crc32(np.array([zlib.crc32(first)], "<u4"), len(second))[0]
    assert int(shifted) ^ zlib.crc32(second) == zlib.crc32(first + second)


@pytest.mark.parametrize("faces", [0, 1, 40])
@pytest.mark.parametrize(("frames", "points"), [(1, 4), (5, 30)])
def test_checksums_are_those_of_the_files(
    tmp_path: Path, frames: int, points: int, faces: int
) -> None:
    generator = np.random.default_rng(0)
    shapes = generator.normal(size=(frames, points, 3)).astype("<f4")
    np.save(tmp_path / "shapes.npy", shapes)
    triangles = None
    if faces:
        triangles = generator.integers(0, points, (faces, 3))
        np.save(tmp_path / "faces.npy", triangles)
    names = ("shapes.npy", "cameras.npy", "faces.npy")
    write_checksums(tmp_path, names)
    found = parse_checksums((tmp_path / CHECKSUMS).read_bytes())
    assert set(found) == {name for name in names if (tmp_path / name).exists()}
    for name, checksum in found.items():
        data = (tmp_path / name).read_bytes()
        assert checksum.crc32 == zlib.crc32(data)
        assert checksum.sha256 == hashlib.sha256(data).hexdigest()
    stored = np.load(tmp_path / FRAME_CHECKSUMS)
    assert (stored.dtype, stored.shape) == (np.dtype("<u4"), (frames,))
    for t, checksum in enumerate(stored):
        write_ply(tmp_path / "frame.ply", shapes[t], triangles)
        assert checksum == zlib.crc32((tmp_path / "frame.ply").read_bytes())
