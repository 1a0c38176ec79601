"""A result as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A moving 3D surface and the camera that saw it: ``W_t = R_t S_t + t_t``.

    Attributes
    ----------
    job_id : str
        The job that made it.
    shapes : ndarray of shape (T, N, 3), float32
        S: points of each frame in the object's frame, each frame centred, in the unit of the
        measurements.
    cameras : ndarray of shape (T, 2, 3), float64
        R: orthonormal rows, times the scale of the camera with ``camera_scale=varying``.
    translations : ndarray of shape (T, 2), float64
        t: the centre of the shape in the image.
    faces : ndarray of shape (F, 3), int32, or None
        Triangles, where they were sent.
    report : dict
        How the result came about: options, stages, cautions, metrics (report.json).
    """

    job_id: str
    shapes: NDArray[np.float32]
    cameras: NDArray[np.float64]
    translations: NDArray[np.float64]
    faces: NDArray[np.int32] | None
    report: dict[str, Any]

    @property
    def metrics(self) -> dict[str, Any] | None:
        """Errors against the ground truth, where one was sent."""
        found: dict[str, Any] | None = self.report.get("metrics")
        return found


def read_result(job_id: str, npz: Path, report: dict[str, Any]) -> Result:
    """Read result.npz, whose checksums are looked at meanwhile."""
    with np.load(npz, allow_pickle=False) as arrays:
        return Result(
            job_id=job_id,
            shapes=arrays["shapes"],
            cameras=arrays["cameras"],
            translations=arrays["translations"],
            faces=arrays.get("faces"),
            report=report,
        )
