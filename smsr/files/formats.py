"""Which format a file has: by its first bytes, then by its name."""

from __future__ import annotations

import enum
from pathlib import PurePath

from smsr.errors import EmptyFile, UnsupportedFormat

HEAD_BYTES = 64 * 2**10
"""How much of a file's beginning is enough for `sniff` and `check_prefix`."""


class FileFormat(enum.StrEnum):
    """A format that is read here."""

    NPY = "npy"
    NPZ = "npz"
    MAT5 = "mat5"
    HDF5 = "hdf5"
    TEXT = "text"
    TEXT_GZ = "text-gz"


_SUFFIXES = {
    FileFormat.NPY: (".npy",),
    FileFormat.NPZ: (".npz",),
    FileFormat.MAT5: (".mat",),
    FileFormat.HDF5: (".h5", ".hdf5"),
    FileFormat.TEXT: (".csv", ".txt", ".tsv", ".dat"),
    FileFormat.TEXT_GZ: (".csv.gz", ".txt.gz"),
}
"""Customary ends of names; files of MATLAB 7.3 are HDF5 and end in .mat."""

SUFFIXES = tuple(suffix for suffixes in _SUFFIXES.values() for suffix in suffixes)
"""Ends of the names of files that are read here."""

_READABLE = f"{', '.join(SUFFIXES[:-1])} and {SUFFIXES[-1]}"
_TEXT_SUFFIXES = frozenset(_SUFFIXES[FileFormat.TEXT])
_BINARY_SUFFIXES = frozenset(
    suffix
    for kind in (FileFormat.NPY, FileFormat.NPZ, FileFormat.HDF5)
    for suffix in _SUFFIXES[kind]
)
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_GZIP = b"\x1f\x8b"
_TEXT_BYTES = frozenset(bytes(range(32, 127)) + b"\t\n\r")
_FOREIGN = {
    b"\x80\x03": "a Python pickle, which is never read because it can run code",
    b"\x80\x04": "a Python pickle, which is never read because it can run code",
    b"\x80\x05": "a Python pickle, which is never read because it can run code",
    b"%PDF": "a PDF document",
    b"\x89PNG": "an image",
    b"\xff\xd8\xff": "an image",
    b"ply\n": "a PLY mesh; give points as arrays",
    b"ply\r": "a PLY mesh; give points as arrays",
    b"PAR1": "a Parquet table",
    b"BZh": "compressed by bzip2; unpack it first",
    b"\xfd7zXZ": "compressed by xz; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed by Zstandard; unpack it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
}


def sniff(head: bytes, name: str) -> FileFormat:
    """Say which format a file has.

    Parameters
    ----------
    head : bytes
        The file's first bytes, `HEAD_BYTES` of them or all if it is shorter.
    name : str
        The file's name; it only decides where the bytes do not.

    Raises
    ------
    EmptyFile
        No bytes at all.
    UnsupportedFormat
        None of the formats of `FileFormat`.
    """
    if not head:
        raise EmptyFile(f"{name} is empty.")
    if head.startswith(b"\x93NUMPY"):
        return FileFormat.NPY
    if head.startswith(b"PK\x03\x04") and b"[Content_Types].xml" in head[:256]:
        raise UnsupportedFormat(f"{name} is an Office document; save the table as .csv.")
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return FileFormat.NPZ
    if any(head.startswith(_HDF5_SIGNATURE, at) for at in (0, 512, 1024, 2048, 4096)):
        return FileFormat.HDF5
    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        return FileFormat.MAT5
    if head.startswith(_GZIP):
        return FileFormat.TEXT_GZ
    for magic, what in _FOREIGN.items():
        if head.startswith(magic):
            raise UnsupportedFormat(f"{name} is {what}. Readable are {_READABLE}.")
    # MATLAB writes text under .mat with "save -ascii"; the others never hold text.
    if _is_text(head) and PurePath(name).suffix.lower() not in _BINARY_SUFFIXES:
        return FileFormat.TEXT
    raise UnsupportedFormat(f"{name} is in no format that is read here: {_READABLE}.{_hint(name)}")


def _is_text(head: bytes) -> bool:
    return _TEXT_BYTES.issuperset(head.removeprefix(b"\xef\xbb\xbf"))


def _hint(name: str) -> str:
    match PurePath(name).suffix.lower():
        case suffix if suffix in _BINARY_SUFFIXES:
            return f" Its name ends in {suffix}, but it does not begin like such a file."
        case ".mat":
            return " If it is a MATLAB file of version 4, save it again with -v7 or -v7.3."
        case suffix if suffix in _TEXT_SUFFIXES:
            return " Its name is that of a text file, but it holds bytes that are no text."
        case _:
            return ""
