"""A fixed choice among the object frames and the mirror images that explain the same tracks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3

if TYPE_CHECKING:
    from numpy.typing import NDArray


def fix_gauge(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn the object frame so that the camera of the middle frame is the identity.

    Of the two mirror images that an orthographic camera cannot tell apart, the one is taken whose
    object turns, on the whole, with the positive sense about a positive image axis. The choice
    uses cameras alone, so it does not depend on the order of the points.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction, in any object frame.

    Returns
    -------
    ndarray of shape (T, 3, 3)
        Cameras of the same motion; shapes have to be found (or turned) for them.
    """
    fixed: NDArray[np.float64] = rotations @ rotations[len(rotations) // 2].T
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
    return so3.mirror(fixed) if decisive < 0.0 else fixed
