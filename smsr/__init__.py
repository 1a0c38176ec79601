"""Moving 3D surfaces from 2D point tracks of one orthographic camera."""

from smsr.errors import SmsrError
from smsr.metrics import Evaluation, evaluate
from smsr.options import Options
from smsr.pipeline import STAGES, reconstruct
from smsr.progress import Progress, ProgressCallback
from smsr.result import Diagnostics, Reconstruction

__version__ = "0.1.0"

__all__ = [
    "STAGES",
    "Diagnostics",
    "Evaluation",
    "Options",
    "Progress",
    "ProgressCallback",
    "Reconstruction",
    "SmsrError",
    "evaluate",
    "reconstruct",
]
