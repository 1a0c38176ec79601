from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.io

from smsr.errors import InvalidFaces
from smsr.files import faces as module
from smsr.files import load_faces

if TYPE_CHECKING:
    from pathlib import Path

FACES = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 0]])


@pytest.mark.parametrize("dtype", ["i1", "u1", "i4", ">i4", "i8", "u8", "f4", "f8"])
def test_whole_numbers_of_any_type_become_int32(dtype: str) -> None:
    faces = load_faces(FACES.astype(dtype), 5)
    assert faces.dtype == np.int32
    assert faces.flags.c_contiguous
    np.testing.assert_array_equal(faces, FACES)


def test_faces_of_matlab_count_from_1(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "m.mat", {"W": np.zeros((10, 5)), "faces": FACES + 1.0})
    np.testing.assert_array_equal(load_faces(tmp_path / "m.mat", 5), FACES)


def test_faces_that_could_count_from_0_do() -> None:
    """Without the last point nothing says that they count from 1."""
    np.testing.assert_array_equal(load_faces([[1, 2, 3]], 5), [[1, 2, 3]])


def test_faces_of_files_are_found_by_key_and_role(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    np.savez(path, W=np.zeros((10, 5)), tri=FACES, other=FACES[::-1])
    np.testing.assert_array_equal(load_faces(path, 5), FACES)
    np.testing.assert_array_equal(load_faces(str(path), 5, key="other"), FACES[::-1])
    (tmp_path / "f.csv").write_text("0,1,2\n2,1,3\n3,4,0\n")
    np.testing.assert_array_equal(load_faces(tmp_path / "f.csv", 5), FACES)


@pytest.mark.parametrize("block", [1, 2, 100])
@pytest.mark.parametrize(
    ("face", "says"),
    [
        ([0, 1, 5], "0 to 4"),
        ([0, 1, 6], "0 to 4"),
        ([0, -1, 2], "0 to 4"),
        ([0, 1, 2**40], "0 to 4"),
        ([0, 1, 1.5], "not whole numbers"),
        ([0, 1, np.nan], "not whole numbers"),
        ([0, 1, np.inf], "not whole numbers"),
    ],
)
def test_the_first_bad_face_is_named(
    face: list[float], says: str, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_BLOCK", block)
    with pytest.raises(InvalidFaces, match=says) as caught:
        load_faces(np.array([*FACES.tolist(), face, face]), 5)
    assert caught.value.context == {"face": 3, "points": 5}


@pytest.mark.parametrize(
    "faces",
    [
        [0, 1, 2],
        [[0, 1, 2, 3]],
        [[[0, 1, 2]]],
        [[0, 1, 2], [1, 2]],
        [["a", "b", "c"]],
        [[True, False, True]],
        [[1j, 0, 2]],
        np.array([[None, 1, 2]]),
        7,
    ],
)
def test_what_are_no_triangles_is_refused(faces: Any) -> None:
    with pytest.raises(InvalidFaces):
        load_faces(faces, 5)


def test_no_faces_are_valid() -> None:
    assert load_faces(np.empty((0, 3), int), 5).shape == (0, 3)
