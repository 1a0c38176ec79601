from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr.errors import AmbiguousArray, ArrayNotFound
from smsr.files import Role, open_array

if TYPE_CHECKING:
    from pathlib import Path

TRACKS = (20, 30)
SHAPES = (27, 30)
BOTH = (30, 30)
TRIANGLES = (50, 3)


def chosen(folder: Path, shapes: dict[str, tuple[int, ...]], role: Role) -> str:
    """Name of the array that is taken from a file of arrays of these shapes."""
    arrays = {name: np.full(shape, float(i)) for i, (name, shape) in enumerate(shapes.items())}
    np.savez(folder / "f.npz", **arrays)  # type: ignore[arg-type]
    return list(shapes)[int(open_array(folder / "f.npz", role=role).flat[0])]


@pytest.mark.parametrize(
    ("shapes", "role", "name"),
    [
        ({"a": TRACKS}, "measurements", "a"),
        ({"a": SHAPES}, "measurements", "a"),  # the only one; what is wrong is said later
        ({"S": SHAPES}, "measurements", "S"),
        ({"W": TRACKS, "V": TRACKS}, "measurements", "W"),
        ({"V": TRACKS, "tracks": TRACKS, "W": TRACKS}, "measurements", "W"),
        ({"a": TRACKS, "b": SHAPES, "c": TRIANGLES}, "measurements", "a"),
        ({"a": TRACKS, "b": SHAPES, "c": TRIANGLES}, "ground_truth", "b"),
        ({"a": TRACKS, "b": SHAPES, "c": TRIANGLES}, "faces", "c"),
        ({"a": BOTH, "S": BOTH}, "measurements", "a"),  # what is named after another role is not
        ({"W": BOTH, "b": BOTH}, "ground_truth", "b"),
        ({"W": TRACKS, "S": SHAPES, "S_world": SHAPES, "faces": TRIANGLES}, "ground_truth", "S"),
        ({"GT": SHAPES, "S": SHAPES}, "ground_truth", "GT"),
        ({"W": TRACKS, "F": TRIANGLES, "tri": TRIANGLES}, "faces", "F"),
        ({"a": (10, 2, 30), "b": (10, 3, 30)}, "measurements", "a"),
        ({"a": (10, 2, 30), "b": (10, 3, 30)}, "ground_truth", "b"),
        ({"a": (10, 30, 2), "b": (10, 30, 3)}, "ground_truth", "b"),
        ({"k": (1, 1), "t": (7,), "x": TRACKS}, "measurements", "x"),
        ({"W": (21, 30), "V": TRACKS}, "measurements", "W"),  # a name counts more than a shape
    ],
)
def test_the_obvious_array_is_taken(
    tmp_path: Path, shapes: dict[str, tuple[int, ...]], role: Role, name: str
) -> None:
    assert chosen(tmp_path, shapes, role) == name


@pytest.mark.parametrize(
    ("shapes", "role"),
    [
        ({"a": TRACKS, "b": TRACKS}, "measurements"),
        ({"a": BOTH, "b": BOTH}, "ground_truth"),
        ({"a": SHAPES, "b": (21, 30)}, "measurements"),
        ({"a": TRIANGLES, "b": TRIANGLES}, "faces"),
        ({"S": SHAPES, "faces": TRIANGLES}, "measurements"),
    ],
)
def test_what_is_not_obvious_is_asked(
    tmp_path: Path, shapes: dict[str, tuple[int, ...]], role: Role
) -> None:
    with pytest.raises(AmbiguousArray, match="key") as caught:
        chosen(tmp_path, shapes, role)
    assert caught.value.context["role"] == role
    assert caught.value.context["arrays"] == [
        {"name": name, "shape": list(shape)} for name, shape in shapes.items()
    ]


def test_many_arrays_are_not_all_listed(tmp_path: Path) -> None:
    with pytest.raises(AmbiguousArray, match="and 80 more") as caught:
        chosen(tmp_path, {f"x{i}": TRACKS for i in range(100)}, "measurements")
    assert len(caught.value.context["arrays"]) == 20  # type: ignore[arg-type]


def test_a_key_counts_more_than_names_and_shapes(tmp_path: Path) -> None:
    np.savez(tmp_path / "f.npz", W=np.zeros(TRACKS), V=np.ones(TRIANGLES))
    assert open_array(tmp_path / "f.npz", key="V").shape == TRIANGLES
    with pytest.raises(ArrayNotFound, match=r"W \(20, 30\), V \(50, 3\)"):
        open_array(tmp_path / "f.npz", key="tracks")
