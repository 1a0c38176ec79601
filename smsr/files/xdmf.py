"""XDMF: a small text file that tells ParaView and VTK where the numbers of a result.npz lie.

The shapes stay where they are, stored in the .npz as they are in memory; each frame is a grid whose
points are read from a position of that file. XDMF 2, https://www.xdmf.org.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from smsr.errors import ArrayNotFound, UnsupportedFormat
from smsr.files.opening import open_array
from smsr.files.results import open_result

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


def write_xdmf(
    path: str | os.PathLike[str],
    result: str | os.PathLike[str],
    *,
    fps: float = 25.0,
    every: int = 1,
) -> None:
    """Write an XDMF file that shows a result.npz as a moving surface, or as moving points.

    Each point has its ``motion`` since the frame before, a vector in the unit of the measurements.

    Parameters
    ----------
    path : path
        The file that is written. It names the result by the way from its folder to it, so the two
        are moved together.
    result : path
        A result.npz as `write_npz` writes it.
    fps : float
        Frames of the sequence per second.
    every : int
        Takes only every n-th frame, from the first on.

    Raises
    ------
    UnsupportedFormat
        The arrays are compressed or not in C order, so that no position of the file holds them.
    ArrayNotFound, WrongShape, UnreadableFile
        As `smsr.files.open_result`.
    """
    shapes = open_result(result).shapes
    try:
        faces: NDArray[Any] | None = open_array(result, key="faces", role="faces")
    except ArrayNotFound:
        faces = None
    name = os.path.relpath(result, Path(path).parent)
    lines = _lines(name, shapes, faces, fps, every)
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _lines(
    name: str, shapes: NDArray[Any], faces: NDArray[Any] | None, fps: float, every: int
) -> Iterator[str]:
    points = shapes.shape[1]
    if faces is None:
        topology = f'<Topology TopologyType="Polyvertex" NumberOfElements="{points}"/>'
    else:
        topology = (
            f'<Topology TopologyType="Triangle" NumberOfElements="{len(faces)}">'
            f"{_item(name, faces, 0, len(faces))}</Topology>"
        )
    yield '<?xml version="1.0" encoding="utf-8"?>'
    yield '<Xdmf Version="2.0"><Domain>'
    yield '<Grid Name="surface" GridType="Collection" CollectionType="Temporal">'
    for t in range(0, len(shapes), every):
        now = _item(name, shapes, t * points, points)
        before = _item(name, shapes, max(t - 1, 0) * points, points)
        # VTK 9 takes the points of two grids for the same where the texts of their items are,
        # whatever their positions: blanks behind the name, t as a binary number, tell them apart.
        mark = f"{t:b}".replace("0", " ").replace("1", "\t")
        yield f'<Grid Name="frame {t}"><Time Value="{t / fps:.9g}"/>'
        yield topology
        yield f'<Geometry GeometryType="XYZ">{now.replace("</", f"{mark}</")}</Geometry>'
        yield '<Attribute Name="motion" AttributeType="Vector" Center="Node">'
        yield f'<DataItem ItemType="Function" Function="$0 - $1" Dimensions="{points} 3">'
        yield f"{now}{before}</DataItem></Attribute></Grid>"
    yield "</Grid></Domain></Xdmf>"


def _item(name: str, array: NDArray[Any], row: int, rows: int) -> str:
    """Return the element that stands for rows of an array (..., 3) in a file."""
    if not isinstance(array, np.memmap) or not array.flags.c_contiguous:
        raise UnsupportedFormat(
            f"{name} is compressed or not in C order; XDMF needs the arrays as they are in a "
            "result.npz that smsr wrote."
        )
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[array.dtype.kind]
    endian = "Big" if array.dtype.str.startswith(">") else "Little"
    seek = array.offset + row * 3 * array.itemsize
    return (
        f'<DataItem Format="Binary" NumberType="{kind}" Precision="{array.itemsize}" '
        f'Endian="{endian}" Dimensions="{rows} 3" Seek="{seek}">{escape(name)}</DataItem>'
    )
