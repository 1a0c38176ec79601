"""How sure cameras are: how far those of one half of the points are from those of the other half.

The points of an object are seen by the same cameras. Noise and deformation lead the cameras of each
half astray in ways of their own, and those of all points not much less.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.cameras.relaxed import relaxed_cameras

if TYPE_CHECKING:
    from numpy.typing import NDArray

FEWEST_POINTS = 12
"""Points that can be halved."""

_SPLITS = 3
_NEGLIGIBLE = 1e-9  # singular value, by the size of all tracks


def disagreement_of_halves(tracks: NDArray[np.float64], coordinates: NDArray[np.float64]) -> float:
    """Return the root mean square angle between the relaxed cameras of two halves of the points.

    The median over three ways to halve them: every second point counts, in the order of the points
    along one of the three strongest directions. So it is the same in whatever order they come. A
    half whose points all coincide says nothing, and does not count.

    Parameters
    ----------
    tracks : ndarray of shape (2T, n)
        Real points, rows u1, v1, u2, ..., T >= 3, n >= `FEWEST_POINTS`, with their noise: what is
        left of noise that was taken off all points together would be the same in both halves.
    coordinates : ndarray of shape (q, n)
        The points as combinations of virtual ones, strongest first.
    """
    least = _NEGLIGIBLE * float(np.linalg.norm(tracks))
    angles = []
    for along in coordinates[:_SPLITS]:
        order = np.argsort(along, kind="stable")
        first, second = (_relaxed(tracks[:, half], least) for half in (order[::2], order[1::2]))
        if first is not None and second is not None:
            angles.append(so3.angle_between_paths(first, second))
    return float(np.median(angles)) if angles else 0.0


def _relaxed(tracks: NDArray[np.float64], least: float) -> NDArray[np.float64] | None:
    """Return the relaxed cameras of tracks, from singular values above the least."""
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    left, values, _ = np.linalg.svd(centred, full_matrices=False)
    kept = values > least
    return relaxed_cameras(left[:, kept], values[kept]).rotations if kept.any() else None
