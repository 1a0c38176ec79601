"""A fixed choice among the object frames and the mirror images that explain the same tracks."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.estimate import CameraEstimate


def fix_gauge(estimate: CameraEstimate) -> CameraEstimate:
    """Turn the object frame so that the camera of the middle frame is the identity.

    Of the two mirror images that an orthographic camera cannot tell apart, the one is taken whose
    object turns, on the whole, with the positive sense about a positive image axis. The choice
    uses cameras alone, so it does not depend on the order of the points.

    Parameters
    ----------
    estimate : CameraEstimate
        Cameras in any object frame.

    Returns
    -------
    CameraEstimate
        Cameras of the same motion; shapes have to be found (or turned) for them.
    """
    middle = estimate.rotations[len(estimate.rotations) // 2]
    rotations = estimate.rotations @ middle.T
    simpler = None if estimate.simpler is None else estimate.simpler @ middle.T
    adjustable = estimate.adjustable
    if _turns_negatively(rotations):
        rotations = so3.mirror(rotations)
        simpler = None if simpler is None else so3.mirror(simpler)
        # exp(v) in the mirror is exp(-D v), D = diag(1, 1, -1)
        adjustable = None if adjustable is None else adjustable * [-1.0, -1.0, 1.0]
    return dataclasses.replace(
        estimate, rotations=rotations, simpler=simpler, adjustable=adjustable
    )


def _turns_negatively(fixed: NDArray[np.float64]) -> bool:
    """Tell which of the two mirror images cameras (T, 3, 3) belong to."""
    tilt = fixed[:, :2, 2]
    time = np.arange(len(tilt)) - (len(tilt) - 1) / 2
    trend = time @ tilt
    largest = np.abs(trend).max()
    if largest <= 1e-6 * np.abs(time).sum():
        flat = tilt.ravel()
        trend = flat
        largest = np.abs(flat).max()
    # Among components of nearly the same size take the first, so that rounding decides nothing.
    decisive = trend[np.argmax(np.abs(trend) >= 0.999 * largest)]
    return bool(decisive < 0.0)
