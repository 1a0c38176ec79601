"""PLY, binary little endian: the vertex block is the bytes of a float32 (N, 3) array.

So a file can be put together from a header, a range of a stored array and a block of faces, without
touching the vertices. Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])

VERTEX_BYTES = 12
FACE_BYTES = _FACE.itemsize


def ply_header(points: int, faces: int = 0) -> bytes:
    """Return the header of a PLY file.

    Parameters
    ----------
    points : int
        Number of vertices; ``12 * points`` bytes of ``'<f4'`` x, y, z must follow.
    faces : int
        Number of triangles; a `ply_face_block` must follow the vertices if there are any.
    """
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {points}",
        "property float x",
        "property float y",
        "property float z",
    ]
    if faces:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def ply_face_block(faces: NDArray[np.integer[Any]]) -> bytes:
    """Return triangles as a PLY file holds them.

    Parameters
    ----------
    faces : ndarray of shape (F, 3)
        Point indices, from 0.

    Returns
    -------
    bytes
        ``13 * F`` bytes: a count of 3 and three int32 for each triangle.
    """
    block = np.empty(len(faces), _FACE)
    block["count"] = 3
    block["indices"] = faces
    return block.tobytes()


def write_ply(
    path: str | os.PathLike[str],
    vertices: NDArray[np.floating[Any]],
    faces: NDArray[np.integer[Any]] | None = None,
) -> None:
    """Write a surface as a PLY file.

    Parameters
    ----------
    path : path
    vertices : ndarray of shape (N, 3)
        Written as float32.
    faces : ndarray of shape (F, 3), optional
        Point indices, from 0.
    """
    with Path(path).open("wb") as file:
        file.write(ply_header(len(vertices), 0 if faces is None else len(faces)))
        np.ascontiguousarray(vertices, "<f4").tofile(file)
        if faces is not None:
            file.write(ply_face_block(faces))
