"""Reading measurement, ground-truth and face files; writing results."""

from smsr.files.formats import FileFormat, sniff
from smsr.files.npy import npy_header
from smsr.files.npz import write_npz
from smsr.files.opening import DEFAULT_LIMIT, open_array
from smsr.files.selection import Role

__all__ = [
    "DEFAULT_LIMIT",
    "FileFormat",
    "Role",
    "npy_header",
    "open_array",
    "sniff",
    "write_npz",
]
