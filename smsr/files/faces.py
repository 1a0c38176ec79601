"""Triangles of a surface: point indices, checked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smsr.errors import InvalidFaces
from smsr.files.opening import DEFAULT_LIMIT, open_array

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_BLOCK = 2**20


def load_faces(
    faces: ArrayLike | str | os.PathLike[str],
    points: int,
    *,
    key: str | None = None,
    limit: int = DEFAULT_LIMIT,
    name: str | None = None,
) -> NDArray[np.int32]:
    """Load the triangles of a surface and check them against its points.

    Parameters
    ----------
    faces : array-like of shape (F, 3) or path
        Point indices, three a row; whole numbers of any type (MATLAB and text files hold them as
        floating-point numbers). Indices count from 0. If the smallest is 1 and the largest is
        `points`, they count from 1, as MATLAB does, and are moved down by 1; that is the one case
        in which they cannot count from 0.
    points : int
        N.
    key, limit, name
        For a file, as in `open_array`.

    Returns
    -------
    ndarray of shape (F, 3), int32
        Counting from 0, C-ordered.

    Raises
    ------
    InvalidFaces
        Another shape, entries that are no whole numbers, or an index that is no point; the message
        names the first such face.
    """
    if isinstance(faces, str | os.PathLike):
        array = open_array(Path(faces), key=key, role="faces", limit=limit, name=name)
    else:
        try:
            array = np.asarray(faces)
        except ValueError as error:
            raise InvalidFaces(f"The faces are no array: {error}.") from None
    check_faces_shape(array.shape, array.dtype)
    return _indices(array, points)


def check_faces_shape(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Refuse faces by what a header tells."""
    if len(shape) != 2 or shape[1] != 3:
        raise InvalidFaces(
            f"The faces have the shape {shape}; they must be triangles, of shape (F, 3).",
            shape=list(shape),
        )
    if dtype.kind not in "iuf":
        raise InvalidFaces(f"The faces have entries of type {dtype}; they must be whole numbers.")


def _indices(array: NDArray[Any], points: int) -> NDArray[np.int32]:
    checked = np.empty(array.shape, np.int32)
    low, high = points, -1
    for start in range(0, len(array), _BLOCK):
        block = array[start : start + _BLOCK]
        # Also false for NaN. N itself passes here: it is the last point of faces that count from 1.
        good = (block >= 0) & (block <= points)
        if array.dtype.kind == "f":
            good &= np.floor(block) == block
        if not good.all():
            _refuse(array, start + int(np.argmin(good.all(axis=1))), points)
        checked[start : start + _BLOCK] = block
        low, high = min(low, int(block.min())), max(high, int(block.max()))
    if high == points:
        if low != 1:
            _refuse(array, int(np.argmax((array == points).any(axis=1))), points)
        checked -= 1
    return checked


def _refuse(array: NDArray[Any], face: int, points: int) -> None:
    corners = array[face].tolist()
    whole = all(float(corner).is_integer() for corner in corners)
    rule = f"indices of {points} points must be 0 to {points - 1}" if whole else "not whole numbers"
    raise InvalidFaces(
        f"Face {face} (counted from 0) is {corners}: {rule}.", face=face, points=points
    )
