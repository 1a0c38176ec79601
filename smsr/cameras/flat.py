"""Cameras of an object that is flat but for its deformation: a sheet of paper, cloth, a flag.

The relaxed problem looks for the three columns of the cameras in the span of the tracks. Where the
mean shape is flat only two lie there: the third occurs only times the coefficients of the
deformation, which lead the relaxation astray. The other two are enough. They form for each frame a
2 x 2 matrix P_t, the orthographic view of a plane, in which nothing is longer than it is and
lengths along one direction stay as they are:

    the singular values of P_t are 1 and the cosine of the tilt of the plane.

P_t tells by how much and about which direction the plane is tilted, but not whether its near or its
far side is up (Necker's reversal). That is chosen for each frame so that the plane turns smoothly.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import find_peaks

from smsr import rotations as so3
from smsr.alignment import orthogonal_factor
from smsr.cameras.uniform import fit_uniform_turn

if TYPE_CHECKING:
    from numpy.typing import NDArray

FEWEST_FRAMES = 12
"""Three numbers of the plane and a tilt for each frame explain any few frames."""

_MISFIT = 0.08
"""Root mean square of what a length along the axis of the tilt may change by: those of a plane that
keeps its size change little, even where it bends."""

_FRAMES = 400
_LONGEST = 0.003  # weight of a plane seen from the front: without it one could always be smaller
_OUTLIER = 0.05
_USUAL_WIDTH = 0.8  # of a plane that turns evenly, as it is seen
_DETERMINED = 0.2  # change of the lengths by that of the plane, relative
_NEARLY_FRONTAL = 0.8  # length of a tilt, below which reversals are tried
_PASSAGE = 0.05  # by which tilts are longer before and after one
_REVERSALS = 12
_STEADY_FRAMES = 200
_STEADY = 0.1  # part of the rotation variance that a uniform turn may leave,
_STEADIER = 0.5  # also as a part of what it left before
_ROUNDS = 30


@dataclass(frozen=True, slots=True, eq=False)
class FlatViews:
    """Orthographic views of a plane.

    Attributes
    ----------
    rows : ndarray of shape (T, 2, 2)
        P, the first two columns of the cameras.
    tilts : ndarray of shape (T, 2)
        The third column, where the reversal of each frame is chosen.
    determined : bool
        Whether they tell how long the plane is in every direction. Otherwise it was taken to be
        seen from the front once.
    """

    rows: NDArray[np.float64]
    tilts: NDArray[np.float64]
    determined: bool = True

    @classmethod
    def of(cls, rotations: NDArray[np.float64], axes: NDArray[np.float64]) -> FlatViews:
        """Return how cameras (T, 3, 3) see the plane of the first two of axes (3, 3), columns."""
        cameras = rotations[:, :2] @ axes
        return cls(cameras[:, :, :2], cameras[:, :, 2])

    @property
    def cameras(self) -> NDArray[np.float64]:
        """R (T, 2, 3), of orthonormal rows."""
        return np.concatenate([self.rows, self.tilts[:, :, None]], axis=2)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Cameras (T, 3, 3) completed by the viewing direction."""
        return so3.complete(self.cameras)

    def every(self, step: int) -> FlatViews:
        """Return the views in every n-th frame."""
        return dataclasses.replace(self, rows=self.rows[::step], tilts=self.tilts[::step])

    def reversed_from(self, frame: int) -> FlatViews:
        """Return the views with the other side up from a frame on."""
        signs = np.where(np.arange(len(self.tilts)) < frame, 1.0, -1.0)
        return dataclasses.replace(self, tilts=self.tilts * signs[:, None])

    def frontal_frames(self, limit: float = _NEARLY_FRONTAL) -> list[int]:
        """Return the frames in which the plane passes the front, the nearest to it first.

        A reversal there changes least how the plane turns.

        Parameters
        ----------
        limit : float
            Sine of the angle from the front that is too much.
        """
        lengths = np.linalg.norm(self.tilts, axis=1)
        lowest, _ = find_peaks(-lengths, height=-limit, prominence=_PASSAGE)
        return sorted(lowest.tolist(), key=lambda t: float(lengths[t]))

    def nearest_to(self, rotations: NDArray[np.float64]) -> FlatViews:
        """Return the views with the reversals that bring them nearest to some cameras (T, 3, 3)."""
        views = self
        for _ in range(_ROUNDS):
            moments = np.einsum("tij,tik->jk", rotations[:, :2], views.cameras)
            wanted = (rotations[:, :2] @ orthogonal_factor(moments))[:, :, 2]
            signs = np.where((wanted * views.tilts).sum(axis=1) < 0.0, -1.0, 1.0)
            if (signs > 0.0).all():
                break
            views = dataclasses.replace(views, tilts=views.tilts * signs[:, None])
        return views


def flat_views(left: NDArray[np.float64], values: NDArray[np.float64]) -> FlatViews | None:
    """Find the views of a plane in the two leading directions of the tracks.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred measurements, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        Singular values, largest first.

    Returns
    -------
    FlatViews or None
        None where the two directions are not seen as a plane is, or on too few frames.
    """
    if len(values) < 2 or values[1] <= 1e-6 * values[0] or len(left) < 2 * FEWEST_FRAMES:
        return None
    images = (left[:, :2] * values[:2]).reshape(-1, 2, 2)
    to_true_size, determined = _to_true_size(images)
    axes, lengths, right = np.linalg.svd(images @ to_true_size)
    if ((lengths[:, 0] - 1.0) ** 2).mean() > _MISFIT**2:
        return None
    cosines = np.minimum(lengths[:, 1] / np.maximum(lengths[:, 0], np.finfo(float).tiny), 1.0)
    rows = axes @ (np.stack([np.ones_like(cosines), cosines], axis=1)[:, :, None] * right)
    tilts = axes[:, :, 1] * np.sqrt(1.0 - cosines**2)[:, None]
    return FlatViews(rows, smoothest_signs(tilts)[:, None] * tilts, determined)


def _to_true_size(images: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return the matrix (2, 2) that makes of images (T, 2, 2) of a plane views of unit scale.

    Cameras that turn about an axis in the plane leave open how long it is across: the longest that
    is never seen longer than that is taken, as if it had once been seen from the front. Whether
    that was not needed is returned as well.
    """
    some = images[:: math.ceil(len(images) / _FRAMES)]
    seen = np.sqrt((some**2).mean(axis=(0, 1)) * 2.0)
    width, height = _USUAL_WIDTH / np.maximum(seen, np.finfo(float).tiny)

    def matrix(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([[x[0] * width, 0.0], [x[1] * height, x[2] * height]])

    def excess(x: NDArray[np.float64]) -> NDArray[np.float64]:
        largest, smallest = _singular_values(some @ matrix(x))
        return np.concatenate([largest - 1.0, math.sqrt(_LONGEST) * (1.0 - smallest)])

    found = least_squares(excess, [1.0, 0.0, 1.0], loss="soft_l1", f_scale=_OUTLIER, max_nfev=50)
    by_size = np.asarray(found.jac)[: len(some)]
    changes = np.linalg.svd(by_size, compute_uv=False) / math.sqrt(len(some))
    return matrix(found.x), bool(changes[-1] > _DETERMINED)


def _singular_values(
    matrices: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the larger and the smaller singular values (T,) of matrices (T, 2, 2)."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    same, other = np.hypot(a + d, b - c), np.hypot(a - d, b + c)
    return 0.5 * (same + other), 0.5 * np.abs(same - other)


def smoothest_signs(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return signs (T,) that make of vectors (T, d), known but for their signs, a smooth path.

    Of all choices that with the least sum of squared second differences, by dynamic programming
    over the relative signs of neighbours.
    """
    frames = len(vectors)
    ways = np.array([1.0, -1.0])
    # For relative signs a, b before and after a frame: || b n[t+1] - 2 n[t] + a n[t-1] ||^2.
    before = ways[:, None, None] * vectors[:-2] - 2.0 * vectors[1:-1]
    costs = ((before[:, None] + ways[None, :, None, None] * vectors[2:]) ** 2).sum(axis=3)
    least, came_from = np.zeros(2), np.zeros((frames - 2, 2), dtype=np.intp)
    for t in range(frames - 2):
        totals = least[:, None] + costs[:, :, t]
        came_from[t] = totals.argmin(axis=0)
        least = totals.min(axis=0)
    chosen = [int(least.argmin())]
    for t in range(frames - 3, -1, -1):
        chosen.append(int(came_from[t, chosen[-1]]))
    return np.concatenate([[1.0], np.cumprod(ways[chosen[::-1]])])


def steadier(views: FlatViews) -> FlatViews:
    """Return the views with the reversals that make of them a uniform turn, if some do.

    Nearly from the front, the tilt of a plane that bends is uncertain, and with it the side that is
    up behind that frame. A camera that keeps turning tells.
    """
    step = math.ceil(len(views.tilts) / _STEADY_FRAMES)
    first = least = _unsteadiness(views.every(step))
    steady, frames = views, views.frontal_frames()[:_REVERSALS]
    while least > 0.0:
        trials = [steady.reversed_from(t) for t in frames]
        scores = [_unsteadiness(trial.every(step)) for trial in trials]
        if not scores or min(scores) >= least:
            break
        least = min(scores)
        steady = trials[scores.index(least)]
    return steady if least < min(_STEADY, _STEADIER * first) else views


def _unsteadiness(views: FlatViews) -> float:
    """Return which part of the rotation variance a uniform turn leaves."""
    rotations = views.rotations
    angles = so3.angles_between(fit_uniform_turn(rotations).rotations, rotations)
    return so3.part_of_rotation(float((angles**2).mean()), rotations)
