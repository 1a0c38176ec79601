"""Where the shapes of all points go: an array, or a file larger than memory."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from smsr.errors import WrongShape

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHAPES_FILE = "shapes.npy"
"""Name of the file of shapes in an output folder."""


class Sink(Protocol):
    """A place for shapes (T, N, 3) that is filled by ranges of points, from several threads."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Precision of the shapes."""
        ...

    def target(self, points: slice) -> NDArray[np.floating[Any]] | None:
        """Return the place in memory of these points, (T, n, 3), if there is one."""
        ...

    def write(self, points: slice, shapes: NDArray[np.floating[Any]]) -> None:
        """Take the shapes (T, n, 3) of these points, each frame contiguous."""
        ...

    def finish(self) -> NDArray[np.floating[Any]]:
        """Return all shapes."""
        ...

    def discard(self) -> None:
        """Remove what was written."""
        ...


class ArraySink:
    """Shapes in an array.

    Parameters
    ----------
    array : ndarray of shape (T, N, 3), float32 or float64
    """

    def __init__(self, array: NDArray[np.floating[Any]]) -> None:
        self._array = array
        self.dtype = array.dtype

    def target(self, points: slice) -> NDArray[np.floating[Any]]:
        """Return the view of these points."""
        return self._array[:, points]

    def write(self, points: slice, shapes: NDArray[np.floating[Any]]) -> None:
        """Do nothing: the shapes were made in place."""

    def finish(self) -> NDArray[np.floating[Any]]:
        """Return the array."""
        return self._array

    def discard(self) -> None:
        """Do nothing: the array is the caller's."""


class FileSink:
    """Shapes in a .npy file, float32 little endian, C order.

    Written by positioned writes, not through a memory map: a full disk then raises `OSError`
    where a map would end the process, and no page of the file counts as the process's memory.

    Parameters
    ----------
    folder : path
        Made if it does not exist; the file in it is `SHAPES_FILE`.
    frames, points : int
        T and N.
    """

    dtype = np.dtype("<f4")

    def __init__(self, folder: str | os.PathLike[str], frames: int, points: int) -> None:
        self.path = Path(folder) / SHAPES_FILE
        self._shape = (frames, points, 3)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("wb")
        self._lock = Lock()
        try:
            header = {"descr": self.dtype.str, "fortran_order": False, "shape": self._shape}
            np.lib.format.write_array_header_1_0(self._file, header)
            self._file.flush()
            self._start = self._file.tell()
            size = self._start + frames * points * 3 * self.dtype.itemsize
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._file.fileno(), 0, size)
            else:
                self._file.truncate(size)
        except BaseException:
            self.discard()
            raise

    def target(self, points: slice) -> None:
        """Return None: the shapes come in a buffer."""

    def write(self, points: slice, shapes: NDArray[np.floating[Any]]) -> None:
        """Write each frame's run of points."""
        _, total, axes = self._shape
        for frame, block in enumerate(shapes):
            position = (frame * total + points.start) * axes * self.dtype.itemsize
            self._write_at(self._start + position, memoryview(block).cast("B"))

    def _write_at(self, position: int, data: memoryview) -> None:
        if not hasattr(os, "pwrite"):  # Windows
            with self._lock:
                self._file.seek(position)
                self._file.write(data)
            return
        while data:
            written = os.pwrite(self._file.fileno(), data, position)
            data, position = data[written:], position + written

    def finish(self) -> NDArray[np.floating[Any]]:
        """Close the file and return it as a read-only map."""
        self._file.close()
        shapes: NDArray[np.floating[Any]] = np.load(self.path, mmap_mode="r")
        return shapes

    def discard(self) -> None:
        """Close and remove the file."""
        self._file.close()
        self.path.unlink(missing_ok=True)


def sink_for(
    out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None,
    frames: int,
    points: int,
    dtype: np.dtype[Any],
) -> Sink:
    """Return the sink for an array to fill, a folder to write to, or None for a new array.

    Raises
    ------
    WrongShape
        An array of another shape than (T, N, 3), or not of float32 or float64.
    """
    if out is None:
        return ArraySink(np.empty((frames, points, 3), dtype))
    if isinstance(out, np.ndarray):
        if out.shape != (frames, points, 3) or out.dtype not in (np.float32, np.float64):
            raise WrongShape(
                f"The output array has shape {out.shape} and dtype {out.dtype}; needed is "
                f"({frames}, {points}, 3), float32 or float64."
            )
        return ArraySink(out)
    return FileSink(out, frames, points)
