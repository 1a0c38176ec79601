"""Noise of the tracks: how much there is, and measurements with most of it taken off.

Noise spreads over all singular directions of W alike, the signal over few. The weakest directions
therefore tell its level, by the law of Marchenko and Pastur for the singular values of a random
matrix; the directions that do not rise above it are left out, and those that do are smoothed in
time only as far as the noise reaches.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import dct, idct

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST_NOISE = 0.003
"""Estimated noise below this part of the tracks' spread is taken for none: weak deformations of
clean tracks look like it."""

MOST_POINTS = 64
"""Most virtual points that are chosen unasked."""

NEGLIGIBLE_REST = 5e-4
"""Part of the norm of the tracks that may be left without depth."""

_FEWEST_FRAMES = 8
_FEWEST_POINTS = 6
_WEAKEST_PART = 0.25  # of the singular values, from which the level is estimated
_SPECTRUM_HALF_WIDTH = 8  # cosines on either side that share an estimate of power
_POWER_ABOVE_NOISE = 1.5  # least power, over that of the noise, for a cosine to be kept


@dataclass(frozen=True, slots=True, eq=False)
class VirtualPoints:
    """A few linear combinations of all points, which the solver works on in their place.

    Attributes
    ----------
    left : ndarray of shape (2T, q)
        U, orthonormal columns.
    values : ndarray of shape (q,)
        Sigma > 0, largest first; the virtual points are ``U Sigma``.
    coordinates : ndarray of shape (q, 2T)
        C, which takes the centred measurements of any points to their coordinates in terms of the
        virtual points: the measurements, less noise, are ``U Sigma C W``.
    noise : float
        Standard deviation of the noise that was taken off, in the units of W; 0 for none.
    neglected : float
        That of noise that was left in, as far as it can be estimated; infinite where there are too
        few frames or points to tell.
    """

    left: NDArray[np.float64]
    values: NDArray[np.float64]
    coordinates: NDArray[np.float64]
    noise: float = 0.0
    neglected: float = 0.0

    @property
    def measurements(self) -> NDArray[np.float64]:
        """``U Sigma`` (2T, q)."""
        product: NDArray[np.float64] = self.left * self.values
        return product

    def leading(self, count: int | None = None) -> VirtualPoints:
        """Return the first `count` virtual points, by default as many as matter.

        Those are the ones without which more than `NEGLIGIBLE_REST` of the tracks would be missing,
        and at most `MOST_POINTS`: the solver's cost grows with the square of their number.
        """
        if count is None:
            squares = self.values**2
            rest = np.cumsum(squares[::-1])[::-1]
            count = min(MOST_POINTS, int((rest > NEGLIGIBLE_REST**2 * rest[0]).sum()))
        if count >= len(self.values):
            return self
        return dataclasses.replace(
            self,
            left=self.left[:, :count],
            values=self.values[:count],
            coordinates=self.coordinates[:count],
        )


def virtual_points(
    left: NDArray[np.float64],
    values: NDArray[np.float64],
    points: int,
    noise: float | None = None,
) -> VirtualPoints:
    """Reduce factored measurements to virtual points without noise.

    Parameters
    ----------
    left : ndarray of shape (2T, r)
        Left singular vectors of the centred W, rows u1, v1, u2, ...
    values : ndarray of shape (r,)
        All singular values of it that are not zero, largest first.
    points : int
        N.
    noise : float, optional
        Standard deviation of the noise on each coordinate, 0 for none; estimated where it is not
        given, and then neglected below `LEAST_NOISE`.
    """
    rows = len(left)
    estimated = estimate_noise(values, rows, points)
    sigma = estimated if noise is None else noise
    spread = math.sqrt(float((values**2).sum()) / (rows * points))
    if sigma <= (LEAST_NOISE * spread if noise is None else 0.0):
        neglected = estimated if _can_tell(rows, points) else math.inf
        return VirtualPoints(left, values, left.T / values[:, None], neglected=neglected)
    kept = max(3, int((values > sigma * (math.sqrt(rows) + math.sqrt(points))).sum()))
    quiet = smooth_in_time(left[:, :kept] * values[:kept], sigma)
    directions, strengths, turn = np.linalg.svd(quiet, full_matrices=False)
    if strengths[0] <= 1e-9 * values[0]:  # nothing but noise, so there is nothing to take it off
        return VirtualPoints(left, values, left.T / values[:, None], neglected=math.inf)
    count = max(1, int((strengths > 1e-9 * strengths[0]).sum()))
    whitened = left[:, :kept].T / values[:kept, None]
    return VirtualPoints(
        directions[:, :count], strengths[:count], turn[:count] @ whitened, noise=sigma
    )


def estimate_noise(values: NDArray[np.float64], rows: int, points: int) -> float:
    """Estimate the standard deviation of white noise from the smallest singular values.

    Parameters
    ----------
    values : ndarray of shape (r,)
        Singular values of the centred W (rows x points), largest first; those left out are zero.
    rows, points : int
        2T and N.

    Returns
    -------
    float
        The median ratio of the smallest quarter of the singular values to the quantiles of the
        Marchenko-Pastur law; 0 where the matrix is too small to tell.
    """
    if not _can_tell(rows, points):
        return 0.0
    # Rows are centred on their mean, so W lies in points - 1 dimensions.
    columns = points - 1
    short, long = min(rows, columns), max(rows, columns)
    spectrum = np.zeros(short)
    count = min(short, len(values))
    spectrum[:count] = values[:count]
    count = max(2, math.ceil(_WEAKEST_PART * short))
    weakest = spectrum[::-1][:count]
    quantiles = marchenko_pastur_quantiles(short / long, (np.arange(count) + 0.5) / short)
    return float(np.median(weakest / (quantiles * math.sqrt(long))))


def _can_tell(rows: int, points: int) -> bool:
    """Tell whether the matrix is large enough for an estimate of its noise."""
    return rows >= 2 * _FEWEST_FRAMES and points >= _FEWEST_POINTS


def marchenko_pastur_quantiles(
    aspect: float, probabilities: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return quantiles of the singular values of a random matrix of unit noise.

    Parameters
    ----------
    aspect : float
        Shorter side of the matrix over its longer side.
    probabilities : ndarray of shape (n,)
        Between 0 and 1.

    Returns
    -------
    ndarray of shape (n,)
        Quantiles over the root of the longer side: between 1 -+ sqrt(aspect).
    """
    edges = (1.0 - math.sqrt(aspect)) ** 2, (1.0 + math.sqrt(aspect)) ** 2
    x = np.linspace(*edges, 4001)[1:-1]
    density = np.sqrt((x - edges[0]) * (edges[1] - x)) / x
    cumulative = np.cumsum(density)
    quantiles: NDArray[np.float64] = np.interp(
        probabilities, cumulative / cumulative[-1], np.sqrt(x)
    )
    return quantiles


def smooth_in_time(tracks: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Apply a Wiener filter in time to each track, with the power of the signal as it is found.

    Each track's cosine transform is shrunk by ``1 - sigma^2 / P``, P its mean power over
    neighbouring cosines. No band is cut off by decree: where a shaking camera has power, at
    whatever frequency, it is kept.

    Parameters
    ----------
    tracks : ndarray of shape (2T, q)
        Rows u1, v1, u2, ...
    sigma : float
        Standard deviation of the noise on each entry.
    """
    frames = len(tracks) // 2
    spectrum = dct(tracks.reshape(frames, 2, -1), axis=0, norm="ortho")
    total = np.zeros((frames + 1, tracks.shape[1]))
    np.cumsum((spectrum**2).mean(axis=1), axis=0, out=total[1:])
    index = np.arange(frames)
    first = np.maximum(index - _SPECTRUM_HALF_WIDTH, 0)
    last = np.minimum(index + _SPECTRUM_HALF_WIDTH + 1, frames)
    power = (total[last] - total[first]) / (last - first)[:, None]
    power = np.maximum(power, np.finfo(float).tiny)
    gain = np.where(power > _POWER_ABOVE_NOISE * sigma**2, 1.0 - sigma**2 / power, 0.0)
    smooth: NDArray[np.float64] = idct(spectrum * gain[:, None], axis=0, norm="ortho")
    return smooth.reshape(tracks.shape)
