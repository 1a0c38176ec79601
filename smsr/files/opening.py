"""Opening an array in a file of any readable format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from smsr.errors import TooLarge
from smsr.files.formats import HEAD_BYTES, FileFormat, sniff
from smsr.files.hdf5 import open_hdf5
from smsr.files.mat5 import open_mat5
from smsr.files.npy import open_npy
from smsr.files.npz import open_npz
from smsr.files.selection import Role, StoredArray, check_chosen, select
from smsr.files.text import open_text, open_text_gz

if TYPE_CHECKING:
    import os
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

DEFAULT_LIMIT = 16 * 2**30
"""Largest array that is opened, in bytes once decompressed."""

_OPENERS: dict[FileFormat, Callable[[Path, int], AbstractContextManager[list[StoredArray]]]] = {
    FileFormat.NPY: open_npy,
    FileFormat.NPZ: open_npz,
    FileFormat.MAT5: open_mat5,
    FileFormat.HDF5: open_hdf5,
    FileFormat.TEXT: open_text,
    FileFormat.TEXT_GZ: open_text_gz,
}


def open_array(
    path: str | os.PathLike[str],
    *,
    key: str | None = None,
    role: Role = "measurements",
    limit: int = DEFAULT_LIMIT,
    name: str | None = None,
) -> NDArray[Any]:
    """Open an array of real numbers in a file.

    Parameters
    ----------
    path : path
        A NumPy (.npy, .npz), MATLAB (version 5 or 7.3), HDF5 or text file, the last gzipped or not;
        `smsr.files.SUFFIXES` has the usual ends of names. The content decides, not the name.
    key : str, optional
        Name of the array in a file of several; ``"GT.shape3D"`` is the field of a MATLAB struct.
    role : {"measurements", "ground_truth", "faces"}
        What the array is for; it decides which is taken when no key is given.
    limit : int
        Most bytes of the array once decompressed. It is checked before anything is allocated.
    name : str, optional
        Name of the file for messages, where `path` is a temporary one.

    Returns
    -------
    ndarray
        Read-only, with the dtype of the file; a memory map for .npy, for members of an .npz that
        are stored, and for data of a .mat file that are not compressed.

    Raises
    ------
    EmptyFile, UnsupportedFormat, UnreadableFile
        What is in the file cannot be read.
    ArrayNotFound, AmbiguousArray
        No array in it is the one that is meant, or several could be.
    NotNumeric, WrongShape, TooLarge
        The array cannot be used.
    OSError
        The file is missing or may not be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    opener = _OPENERS[sniff(head, name or path.name)]
    try:
        with opener(path, limit) as stored:
            chosen = select(stored, key, role)
            check_chosen(chosen, limit)
            array = chosen.read()
    except MemoryError:
        raise TooLarge("The array does not fit into memory.") from None
    array.flags.writeable = False
    return array
