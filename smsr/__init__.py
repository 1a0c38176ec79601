"""Moving 3D surfaces from 2D point tracks of one orthographic camera."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from smsr.errors import SmsrError
from smsr.options import Options
from smsr.progress import STAGES, Progress, ProgressCallback

if TYPE_CHECKING:
    from smsr.metrics import Evaluation, evaluate
    from smsr.pipeline import reconstruct
    from smsr.result import Diagnostics, MovingSurface, Reconstruction

__version__ = "0.1.0"

__all__ = [
    "STAGES",
    "Diagnostics",
    "Evaluation",
    "MovingSurface",
    "Options",
    "Progress",
    "ProgressCallback",
    "Reconstruction",
    "SmsrError",
    "evaluate",
    "reconstruct",
]

# Programs that never solve, as an API process or a client, need not load SciPy for the names of
# errors and options: what needs it is loaded when it is first asked for (PEP 562).
_LOADED_LATER = {
    "reconstruct": "smsr.pipeline",
    "Evaluation": "smsr.metrics",
    "evaluate": "smsr.metrics",
    "Diagnostics": "smsr.result",
    "MovingSurface": "smsr.result",
    "Reconstruction": "smsr.result",
}


def __getattr__(name: str) -> Any:
    """Load what stands in `_LOADED_LATER`."""
    if name not in _LOADED_LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LOADED_LATER[name]), name)


def __dir__() -> list[str]:
    """List what there is, loaded or not."""
    return sorted({*globals(), *__all__})
