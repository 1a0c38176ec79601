"""Reading measurement, ground-truth and face files; writing results."""

from smsr.files.faces import load_faces
from smsr.files.formats import HEAD_BYTES, SUFFIXES, FileFormat, sniff
from smsr.files.glb import Glb, GlbOptions, write_glb
from smsr.files.npy import npy_header
from smsr.files.npz import write_npz
from smsr.files.opening import DEFAULT_LIMIT, open_array
from smsr.files.ply import ply_face_block, ply_header, write_ply
from smsr.files.prefix import Beginning, check_prefix
from smsr.files.results import open_result
from smsr.files.selection import Role
from smsr.files.xdmf import write_xdmf

__all__ = [
    "DEFAULT_LIMIT",
    "HEAD_BYTES",
    "SUFFIXES",
    "Beginning",
    "FileFormat",
    "Glb",
    "GlbOptions",
    "Role",
    "check_prefix",
    "load_faces",
    "npy_header",
    "open_array",
    "open_result",
    "ply_face_block",
    "ply_header",
    "sniff",
    "write_glb",
    "write_npz",
    "write_ply",
    "write_xdmf",
]
