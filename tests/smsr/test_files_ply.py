from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import plyfile
import pytest
import trimesh

from smsr.files import ply_face_block, ply_header, write_ply
from smsr.files.ply import FACE_BYTES, VERTEX_BYTES

if TYPE_CHECKING:
    from pathlib import Path

VERTICES = np.random.default_rng(0).standard_normal((50, 3)).astype("<f4")
FACES = np.random.default_rng(1).integers(0, 50, (80, 3))


def test_header_stored_bytes_and_face_block_make_a_file_that_others_read() -> None:
    stored = VERTICES.tobytes()  # as a frame lies in shapes.npy
    content = ply_header(50, 80) + stored + ply_face_block(FACES)
    assert len(content) == len(ply_header(50, 80)) + 50 * VERTEX_BYTES + 80 * FACE_BYTES

    read = plyfile.PlyData.read(io.BytesIO(content))
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(read["vertex"][name], VERTICES[:, axis])
    np.testing.assert_array_equal(np.stack(read["face"]["vertex_indices"]), FACES)

    mesh: Any = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)


def test_bytes_are_those_that_plyfile_writes(tmp_path: Path) -> None:
    vertex = VERTICES.view([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]).reshape(-1)
    face = np.empty(80, [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = FACES
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face"),
    ]
    for kept, faces in ((elements, FACES), (elements[:1], None)):
        expected = io.BytesIO()
        plyfile.PlyData(kept, byte_order="<").write(expected)
        write_ply(tmp_path / "a.ply", VERTICES, faces)
        assert (tmp_path / "a.ply").read_bytes() == expected.getvalue()


@pytest.mark.parametrize("dtype", ["f8", ">f4", "f2"])
def test_other_types_are_written_as_float32(tmp_path: Path, dtype: str) -> None:
    vertices = np.asfortranarray(VERTICES.astype(dtype))
    write_ply(tmp_path / "a.ply", vertices)
    read = plyfile.PlyData.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(read["vertex"]["y"], vertices[:, 1].astype(np.float32))
    assert [element.name for element in read.elements] == ["vertex"]
