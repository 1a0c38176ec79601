"""Cameras that stop, start and reverse: turns about one axis at one speed, switched in time.

A turn to and fro, or one in steps, is not uniform, yet it is described by very few numbers: one
angular velocity omega and the moments at which the camera switches between -omega, 0 and +omega.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import dct
from scipy.optimize import least_squares

from smsr import rotations as so3
from smsr.cameras.turn import Turn, steady_turn

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCKS = 80  # most pieces of time that velocities are averaged over, to begin with
_MOST_PIECES = 12
_MOST_COSINES = 36
_MARGIN = 10.0  # of the information criterion, log units
_UNEXPLAINED = 0.4  # most part of the velocities' power that two pieces may leave, per 2 / pieces
_OFF_LEVEL = 0.35  # most that a piece's velocity may be off its level, parts of the speed
_OUTLIER = 0.2  # radians; frames farther off count less in the fit


def fit_switched_turn(rotations: NDArray[np.float64]) -> Turn | None:
    """Fit a switched turn to cameras, where that is clearly their simplest description.

    Angular velocities, averaged over blocks of frames, are cut into the best pieces of constant
    velocity by dynamic programming. The Bayesian information criterion, with the number of
    independent samples taken from the correlation of the residual, has to prefer the pieces to
    as many cosines, and all pieces have to share one axis and one speed.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    Turn or None
        Switching times are real numbers, fitted by robust least squares.
    """
    frames = len(rotations)
    block = max(1, frames // _BLOCKS)
    velocities = angular_velocities(block_means(rotations, block))
    breaks = choose_breaks(velocities)
    if breaks is None:
        return None
    edges = [0, *breaks, len(velocities)]
    means = np.array([velocities[i:j].mean(axis=0) for i, j in pairwise(edges)])
    means /= block
    lengths = np.diff(edges)
    axis = np.linalg.eigh((means * lengths[:, None]).T @ means)[1][:, -1]
    along = means @ axis
    speed = float(np.median(np.abs(along)[np.abs(along) > 0.5 * np.abs(along).max()]))
    levels = np.clip(np.round(along / speed), -1.0, 1.0)
    off = np.linalg.norm(means - levels[:, None] * speed * axis, axis=1)
    switches = np.flatnonzero(np.diff(levels))
    if off.max() > _OFF_LEVEL * speed or not len(switches):
        return None
    times = (np.array(breaks, dtype=np.float64)[switches] + 0.5) * block
    levels = levels[np.concatenate([[0], switches + 1])]
    return _fit(rotations, speed * axis, levels, times)


def _fit(
    rotations: NDArray[np.float64],
    velocity: NDArray[np.float64],
    levels: NDArray[np.float64],
    times: NDArray[np.float64],
) -> Turn:
    """Fit velocity, start and switching times to cameras by robust least squares."""
    frames = len(rotations)
    time = np.arange(frames, dtype=np.float64)

    def turn(x: NDArray[np.float64]) -> Turn:
        edges = np.clip(np.sort(times + 5.0 * x[6:]), 1.0, frames - 2.0)
        edges = np.concatenate([[0.0], edges, [frames - 1.0]])
        at_edges = np.concatenate([[0.0], np.cumsum(levels * np.diff(edges))])
        angles = np.interp(time, edges, at_edges)
        return steady_turn(angles, velocity + x[:3] / frames, so3.exp(x[None, 3:6])[0] @ start)

    def error(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return so3.log(rotations @ turn(x).steady.transpose(0, 2, 1)).ravel()

    start = np.eye(3)
    unknown = np.zeros(6 + len(times))
    start = so3.mean_rotation(turn(unknown).steady.transpose(0, 2, 1) @ rotations)
    found = least_squares(error, unknown, loss="soft_l1", f_scale=_OUTLIER, max_nfev=15)
    return turn(found.x)


def angular_velocities(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vectors (T - 1, 3) from each camera to the next, in the camera frame."""
    return so3.log(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))


def block_means(rotations: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    """Return the mean rotation of each block of frames, the last incomplete block left out."""
    if block <= 1:
        return rotations
    count = len(rotations) // block
    sums = rotations[: count * block].reshape(count, block, 3, 3).sum(axis=1)
    return so3.nearest_rotations(sums)


def choose_breaks(velocities: NDArray[np.float64]) -> list[int] | None:
    """Return where to cut velocities (n, 3) into constant pieces, None if that explains little."""
    count = len(velocities)
    shortest = max(4, count // 30)
    segmentations = segment(velocities, min(_MOST_PIECES, max(1, count // shortest)), shortest)
    if len(segmentations) < 2:
        return None
    power = float((velocities**2).sum())
    if power == 0.0:
        return None
    trial = [0, *segmentations[min(len(segmentations) - 1, 3)][1], count]
    rest = np.concatenate([velocities[i:j] - velocities[i:j].mean(0) for i, j in pairwise(trial)])
    samples = max(4.0, count / correlation_length(rest))

    def criterion(error: float, parameters: float) -> float:
        return 1.5 * samples * math.log(max(error / power, 1e-6)) + parameters / 2.0 * math.log(
            samples
        )

    pieces = [criterion(error, 4 * n + 3) for n, (error, _) in enumerate(segmentations)]
    spectrum = (dct(velocities, axis=0, norm="ortho") ** 2).sum(axis=1)
    left = spectrum.sum() - np.cumsum(spectrum)
    cosines = min(criterion(left[n], 3 * (n + 1)) for n in range(min(count // 2, _MOST_COSINES)))
    best = int(np.argmin(pieces))
    for n in range(1, best + 1):
        explained = segmentations[n][0] <= _UNEXPLAINED / (n + 1) * power
        if explained and pieces[n] <= pieces[best] + _MARGIN:
            return segmentations[n][1] if pieces[n] <= cosines - _MARGIN else None
    return None


def segment(values: NDArray[np.float64], most: int, shortest: int) -> list[tuple[float, list[int]]]:
    """Cut a sequence into 1, 2, ... constant pieces of least squared error.

    Parameters
    ----------
    values : ndarray of shape (n, d)
        The sequence.
    most : int
        Most pieces.
    shortest : int
        Least length of a piece.

    Returns
    -------
    list of (float, list of int)
        Squared error and breaks for 1, 2, ... pieces, as far as they fit in.
    """
    count = len(values)
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum((values**2).sum(axis=1))])
    index = np.arange(count + 1)
    lengths = index[None] - index[:, None]
    error = squares[None] - squares[:, None]
    error = error - ((sums[None] - sums[:, None]) ** 2).sum(axis=2) / np.maximum(lengths, 1)
    error = np.where(lengths >= shortest, np.maximum(error, 0.0), np.inf)
    best = error[0].copy()
    found: list[tuple[float, list[int]]] = [(float(best[count]), [])]
    previous: list[NDArray[np.intp]] = []
    for _ in range(1, most):
        total = best[:, None] + error
        cut = total.argmin(axis=0)
        best = total[cut, index]
        previous.append(cut)
        if not np.isfinite(best[count]):
            break
        breaks: list[int] = []
        end = count
        for cuts in reversed(previous):
            end = int(cuts[end])
            breaks.append(end)
        found.append((float(best[count]), breaks[::-1]))
    return found


def correlation_length(residual: NDArray[np.float64]) -> float:
    """Return over how many entries a sequence (n, d) is correlated, at least 1."""
    count = len(residual)
    residual = residual - residual.mean(axis=0)
    power = max(float((residual**2).sum()), np.finfo(float).tiny)
    correlation = np.array(
        [(residual[: count - k] * residual[k:]).sum() for k in range(max(2, count // 3))]
    )
    correlation /= power
    low = correlation < 0.05
    end = int(np.argmax(low)) if low.any() else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(correlation[1:end].sum()))
