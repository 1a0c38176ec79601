"""The scale of the camera in each frame: an object that comes nearer, or a lens that zooms.

A camera far from the object sees it as the orthographic one does, larger or smaller by a factor
for each frame (scaled orthography, weak perspective),

    W_t = s_t R_t S_t .

The orthographic solver takes this for an object that swells and shrinks. The tracks alone cannot
tell the two apart, but few objects do: most of their points keep their distances, or some. So the
scale of a frame is the factor by which distances between points differ there from those in other
frames, whatever the rest of them does.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import maximum_filter1d

from smsr.cameras.constraints import (
    OrthonormalityForm,
    mean_square_length,
    orthonormality_form,
)
from smsr.cameras.estimate import corrective_matrix, scaled_motion, usable_rank
from smsr.cameras.relaxed import relaxed_factor
from smsr.progress import ignore, part_of
from smsr.reduction import Reduction
from smsr.shapes.lengths import chosen_points

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smsr.options import Options
    from smsr.progress import StageHook
    from smsr.rowspace import RowSpace

MOST_ROUNDS = 5
TOLERANCE = 0.005
"""Root mean square of the logarithms of a change that is none."""

_DIRECTIONS = 128
_RELAXATIONS = 3
_BASIS_SIZE = 4
_TRACE_WEIGHT = 1e-3

_MOST_POINTS = 48
_LEAST_LENGTH = 0.05  # of the object's size, below which two points are one
_LEAST_SPREAD = 0.01  # of the logarithm of a length: what keeps better counts no more
_SMALLEST = 0.03  # scale, as a part of the median
_FEWEST_FRAMES = 5
_SMOOTHING = 10.0  # halves what has a period of 11 frames
_JUMP = 0.06  # of the logarithm
_AROUND_JUMPS = 11  # frames
_UNSEEN = 1e-6  # size in the image, as a part of the largest
_POLISHES = 20
_POLISHED = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ScaleEstimate:
    """Scales of all frames.

    Attributes
    ----------
    scales : ndarray of shape (T,)
        s, of geometric mean 1.
    iterations : int
        Rounds, each of which solved for cameras and shapes.
    converged : bool
        Whether the last change was below the tolerance.
    reason : str
        Why it stopped, for a person.
    residuals : tuple of float
        Root mean square of the logarithms of the change in each round.
    """

    scales: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...] = ()


def varying_scales(
    space: RowSpace,
    options: Options,
    solve: Callable[[RowSpace, Options, StageHook], NDArray[np.float64]],
    hook: StageHook = ignore,
) -> ScaleEstimate:
    """Find the scale of the camera in each frame by turns with cameras and shapes.

    It starts from tracks that are equally large in all frames, so what scales there are hardly
    matters.

    Parameters
    ----------
    space : RowSpace
        The factored measurements W.
    options : Options
        Resolved.
    solve : callable
        Takes the factored measurements divided by scales, and options, and returns shapes
        (T, 3, s) of its sample of points.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    # The weakest directions tell of noise only, and take long to divide where frames are many.
    options = dataclasses.replace(options, noise=Reduction.of(space, options).points.noise)
    space = space.leading(_DIRECTIONS)
    sizes = np.linalg.norm(
        space.factor.reshape(space.frames, -1) / space.singular_values[0], axis=1
    )
    seen = sizes > _UNSEEN * sizes.max()
    scales = _interpolated(sizes, seen)
    chosen = chosen_points(space.sample / np.repeat(scales, 2)[:, None], _MOST_POINTS)
    hooks = [
        part_of(hook, k / (MOST_ROUNDS + 1), (k + 1) / (MOST_ROUNDS + 1))
        for k in range(MOST_ROUNDS + 1)
    ]
    for _ in range(_RELAXATIONS):
        reduction = Reduction.of(*divided(space, options, scales))
        scales = _interpolated(scales * relaxed_scales(reduction, hooks[0]), seen)
    residuals: list[float] = []
    for part in hooks[1:]:
        shapes = solve(*divided(space, options, scales), part)
        before = scales
        scales = _smooth(_interpolated(scales * common_scales(shapes[:, :, chosen]), seen))
        residuals.append(float(np.log(scales / before).std()))
        if residuals[-1] < TOLERANCE:
            break
    return ScaleEstimate(
        scales=scales,
        iterations=len(residuals),
        converged=residuals[-1] < TOLERANCE,
        reason=f"scale of the camera between {scales.min():.3g} and {scales.max():.3g} of its "
        f"mean; it changed by {residuals[-1]:.1%} in the last of {len(residuals)} rounds",
        residuals=tuple(residuals),
    )


def divided(
    space: RowSpace, options: Options, scales: NDArray[np.float64]
) -> tuple[RowSpace, Options]:
    """Return measurements divided by scales (T,), and options with the noise they have then."""
    if options.noise is not None:
        options = dataclasses.replace(options, noise=options.noise * noise_gain(scales))
    return space.divided(scales), options


def noise_gain(scales: NDArray[np.float64]) -> float:
    """Return by how much the noise of measurements grows when they are divided by scales (T,)."""
    return float(np.sqrt((1.0 / scales**2).mean()))


def relaxed_scales(reduction: Reduction, hook: StageHook = ignore) -> NDArray[np.float64]:
    """Return scales of the cameras (T,), of geometric mean 1, from a convex problem.

    It is that of `smsr.cameras.relaxed.relaxed_factor`, but for rows of each ``M'_t Q`` that are
    equally long (paper, Eq. 8), whatever their length, and of mean length 1. Their length is the
    scale times the coefficient of one basis shape, which the trace brings near the mean shape.
    """
    motion = scaled_motion(
        reduction.left, reduction.values, usable_rank(reduction.values, 3 * _BASIS_SIZE)
    )
    mean, frames = mean_square_length(motion), len(motion) // 2
    equal = orthonormality_form(motion, rows="equal")
    form = OrthonormalityForm(
        equal.hessian + frames * np.outer(mean, mean), frames * mean, float(frames)
    )
    F, _ = relaxed_factor(motion, trace_weight=_TRACE_WEIGHT, form=form, hook=hook)
    rows = (motion @ corrective_matrix(F)).reshape(frames, -1)
    return _normalised(np.linalg.norm(rows, axis=1))


def common_scales(shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by what factor the distances between points differ from frame to frame.

    The logarithm of each distance is that of its usual value, plus that of the scale of the frame,
    plus a rest: a two-way table, fitted by medians (Tukey's median polish), in which distances
    count by how well they keep.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, n)
        S of some points.

    Returns
    -------
    ndarray of shape (T,)
        Scales of geometric mean 1.
    """
    points = shapes.shape[2]
    first, second = np.triu_indices(points, 1)
    apart = np.take(shapes, first, axis=2) - np.take(shapes, second, axis=2)
    lengths = np.sqrt(np.einsum("tip,tip->tp", apart, apart))
    sizes = np.sqrt((lengths**2).mean(axis=1))
    usual = np.median(lengths / np.maximum(sizes, np.finfo(float).tiny)[:, None], axis=0)
    lengths = lengths[:, usual > _LEAST_LENGTH]
    if lengths.shape[1] == 0:
        return _normalised(sizes)
    logarithms = np.log(np.maximum(lengths, _SMALLEST**2 * np.median(lengths)))
    rows = np.zeros(len(shapes))
    for _ in range(_POLISHES):
        rests = logarithms - rows[:, None]
        columns = np.median(rests, axis=0)
        spread = np.median(np.abs(rests - columns), axis=0)
        before = rows
        rows = _weighted_medians(logarithms - columns, 1.0 / (spread + _LEAST_SPREAD) ** 2)
        rows = rows - rows.mean()
        if np.abs(rows - before).max() < _POLISHED:
            break
    return _normalised(np.exp(rows))


def growth(shapes: NDArray[np.float64]) -> float:
    """Return by what factor the distances between points grow together, or shrink.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, n)
        S of some points.

    Returns
    -------
    float
        The 95th percentile of the scales that are common to them over the 5th.
    """
    least, most = np.percentile(common_scales(shapes), (5.0, 95.0))
    return float(most / least)


def _weighted_medians(
    values: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the medians (T,) of the rows of values (T, p), each column with its weight (p,)."""
    order = np.argsort(values, axis=1)
    share = np.cumsum(weights[order], axis=1)
    middle = (share < 0.5 * share[:, -1:]).sum(axis=1)
    return np.take_along_axis(values, np.take_along_axis(order, middle[:, None], 1), 1)[:, 0]


def _smooth(scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return scales without what changes within a few frames, but where they jump.

    Cameras come nearer slowly. What shakes is the way they look, and errors in the scale would
    hide how steadily the object moves.
    """
    if len(scales) < _FEWEST_FRAMES:
        return scales
    frames, logarithms = np.arange(len(scales), dtype=np.float64), np.log(scales)
    smooth = make_smoothing_spline(frames, logarithms, lam=_SMOOTHING)(frames)
    jumps = maximum_filter1d(np.abs(logarithms - smooth), _AROUND_JUMPS) > _JUMP
    return _normalised(np.exp(np.where(jumps, logarithms, smooth)))


def _interpolated(scales: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return scales with those of frames in which no two points differ taken from their neighbours.

    Parameters
    ----------
    scales : ndarray of shape (T,)
    seen : ndarray of shape (T,)
        Which frames are others.
    """
    frames = np.arange(len(scales))
    known = np.log(_normalised(scales[seen]))
    return _normalised(np.exp(np.interp(frames, frames[seen], known)))


def _normalised(scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return scales of geometric mean 1, none far below the others."""
    positive = scales[scales > 0.0]
    if len(positive) == 0:
        return np.ones(len(scales))
    logarithms = np.log(np.maximum(scales, _SMALLEST * float(np.median(positive))))
    normalised: NDArray[np.float64] = np.exp(logarithms - logarithms.mean())
    return normalised
