"""Which cameras to take."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smsr.cameras.relaxed import relaxed_cameras
from smsr.progress import ignore

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate
    from smsr.options import Options
    from smsr.progress import StageHook


def estimate_cameras(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    options: Options,
    hook: StageHook = ignore,
) -> CameraEstimate:
    """Find the cameras of all frames in the way that the options ask for.

    Parameters
    ----------
    left : ndarray of shape (2T, q)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (q,)
        Singular values, largest first, of measurements of unit variance.
    options : Options
        Resolved by `smsr.options.resolve`.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    return relaxed_cameras(
        left,
        values,
        basis_size=options.basis_size or 10,
        max_iterations=options.camera_iterations,
        tolerance=options.camera_tolerance,
        hook=hook,
    )
