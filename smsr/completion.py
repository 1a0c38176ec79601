"""Tracks with gaps and with gross errors, completed before anything is solved.

Seen positions follow a low-rank model, ``w_tn = M_t b_n + t_t``, whose coefficients b_n describe a
point and whose motion M_t (2 x r) moves little between frames. The model is fitted to a sample of
the points by alternating least squares; its rank comes from positions that are seen but held out
in the pattern of the gaps. Gaps of any point are then filled from the fit to the rest of its track
and, over short gaps, from what the fit leaves over before and after. Filling needs one point at a
time, so a completed source still streams.

A gross error stands out twice: from the model, and from the same track a frame earlier and later.
Fast but true motion does not stand out from the first, a badly modelled part not from the second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import solveh_banded

from smsr.errors import NotFinite, NotNumeric, TooFewObservations, WrongShape
from smsr.measurements import (
    CHUNK_BYTES,
    MINIMUM_FRAMES,
    MINIMUM_POINTS,
    check_values,
    chunk_points,
)
from smsr.streaming import checked_chunks, one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    from smsr.measurements import Chunk, MeasurementSource
    from smsr.options import Options

_SAMPLE = 500  # points that the model is fitted to
_HIGHEST_RANK = 36
_PATIENCE = 2  # ranks tried beyond the best
_GOOD_ENOUGH = 1.05  # of the least held-out error, for the sake of a lower rank
_HELD_OUT = 0.1
_STEPS = 6  # alternations at each rank on the way
_LAST_STEPS = 100
_ROUNDING = 1e-8  # of the spread: residuals below are none
_RIDGE = 1e-13

_SUSPECT_RANK = 18  # beyond, the model follows errors
_SUSPECT_PASSES = 6
_SUSPECT = 8.0  # medians of the distances
_GROSS = 0.05  # of the spread


@dataclass(frozen=True, slots=True)
class Gaps:
    """What was not taken as observed.

    Attributes
    ----------
    missing : int
        Positions that were not seen.
    rejected : int
        Positions that were seen and taken as gross errors.
    """

    missing: int = 0
    rejected: int = 0


def completed(
    source: MeasurementSource, options: Options, visibility: ArrayLike | None = None
) -> tuple[MeasurementSource, Gaps]:
    """Return a source without gaps and gross errors, as far as the options ask for that.

    Parameters
    ----------
    source : MeasurementSource
        W; NaN in either coordinate says that a point is not seen in a frame.
    options : Options
        `missing` and `outliers` count.
    visibility : array_like of shape (T, N), bool, optional
        True where a point is seen. What the source holds elsewhere is not used.

    Returns
    -------
    source : MeasurementSource
        The same source where there is nothing to fill. Otherwise one that fills blocks as they
        are read; what was observed is left as it is.
    gaps : Gaps
        What is filled.

    Raises
    ------
    WrongShape, NotNumeric
        The visibility does not fit the measurements or is not boolean.
    NotFinite
        An infinite entry.
    TooFewObservations
        A frame with fewer than 4 points that are seen, or a point seen in fewer than 3 frames.
    """
    seen = None if visibility is None else _checked_visibility(visibility, source)
    reject = options.outliers == "reject"
    if seen is None and options.missing == "refuse" and not reject:
        return source, Gaps()
    survey = _survey(source, seen)
    if survey.missing and seen is None and options.missing == "refuse":
        check_values(source)  # says where
    if survey.missing == 0 and not reject:
        return source, Gaps()
    with one_blas_thread():
        model = fit_motion(survey.sample, survey.sample_seen, reject=reject)
        filled = CompletedSource(source, seen, model)
        rejected = sum(filled.count_rejected()) if reject else 0
    if survey.missing + rejected == 0:
        return source, Gaps()
    return filled, Gaps(survey.missing, rejected)


@dataclass(frozen=True, slots=True, eq=False)
class CompletedSource:
    """A source whose gaps are filled as its blocks are read.

    Parameters
    ----------
    source : MeasurementSource
    seen : ndarray of shape (T, N), bool, optional
        True where a point is seen, beside what NaN says.
    model : MotionModel
        Fitted to the source.
    """

    source: MeasurementSource
    seen: NDArray[np.bool_] | None
    model: MotionModel

    @property
    def frames(self) -> int:
        """T."""
        return self.source.frames

    @property
    def points(self) -> int:
        """N."""
        return self.source.points

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries: that of the source, or float64 for integers."""
        dtype = np.dtype(self.source.dtype)
        return dtype if dtype.kind == "f" else np.dtype(np.float64)

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Iterate over filled blocks; see `smsr.measurements.MeasurementSource.chunks`."""
        for points, block in self.source.chunks(size):
            yield points, self._filled(points, block)

    def count_rejected(self) -> Iterator[int]:
        """Yield the number of gross errors, block by block."""
        for points, block in self.source.chunks(chunk_points(self.source)):
            tracks, seen = _tracks_of(block, points, self.seen)
            yield int(np.count_nonzero(self.model.gross_errors(tracks, seen)))

    def _filled(self, points: slice, block: NDArray[Any]) -> NDArray[Any]:
        tracks, seen = _tracks_of(block, points, self.seen)
        if self.model.limits:
            seen &= ~self.model.gross_errors(tracks, seen)
        gappy = np.flatnonzero(~seen.all(axis=0))
        if not len(gappy):
            return block
        seen = seen[:, gappy]
        guess = self.model.fill(tracks[:, :, gappy], seen)
        filled = block.astype(self.dtype)  # a copy
        shaped = filled.reshape(self.frames, 2, -1)
        shaped[:, :, gappy] = np.where(seen[:, None], shaped[:, :, gappy], guess)
        return filled


@dataclass(frozen=True, slots=True, eq=False)
class MotionModel:
    """How all points move: ``w_tn = M_t b_n + t_t + noise``, b_n of unit covariance.

    Attributes
    ----------
    motion : ndarray of shape (T, 2, r + 1)
        M_t with t_t as its last column; the columns of M are orthogonal, strongest first.
    variance : float
        Of what the model leaves over, a coordinate, times the frames over which that is alike.
    bridging : bool
        Whether that is interpolated over gaps.
    limits : tuple of Limits
        What is a gross error beside the model of each rank; empty to take everything.
    """

    motion: NDArray[np.float64]
    variance: float
    bridging: bool
    limits: tuple[Limits, ...] = ()

    @property
    def rank(self) -> int:
        """Rank r of the model."""
        return int(self.motion.shape[2]) - 1

    def fill(self, tracks: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the tracks (T, 2, n) as the model has them, given where they are seen (T, n)."""
        found = _coefficients(self.motion, tracks, seen.astype(np.float64), self.variance)
        predicted = _predicted(found, self.motion)
        if self.bridging:
            predicted += _bridged(tracks - predicted, seen)
        return predicted

    def gross_errors(
        self, tracks: NDArray[np.float64], seen: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which of the seen positions (T, n) are gross errors."""
        kept = seen
        for limits in self.limits:
            motion = _leading(self.motion, limits.rank)
            weights = kept.astype(np.float64)
            variance = max(self.variance, limits.variance)
            for _ in range(_STEPS):
                found = _coefficients(motion, tracks, weights, variance)
                predicted = _predicted(found, motion)
                weights = _robust_weights(tracks - predicted, kept, limits)
            kept = _without_suspects(tracks - predicted, kept, limits)
        return seen & ~kept


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """How far positions usually are from a model and from their own past and future.

    Attributes
    ----------
    rank : int
        Of the model.
    variance : float
        Of a coordinate's distance from the model.
    model, neighbours : ndarray of shape (T,)
        Median distance in each frame, at least that of all frames.
    gross : float
        Distance below which nothing is a gross error.
    """

    rank: int
    variance: float
    model: NDArray[np.float64]
    neighbours: NDArray[np.float64]
    gross: float


def fit_motion(
    tracks: NDArray[np.float64], seen: NDArray[np.bool_], *, reject: bool = False
) -> MotionModel:
    """Fit the low-rank model to the positions that are seen.

    Parameters
    ----------
    tracks : ndarray of shape (T, 2, n)
        Positions that are not seen may hold anything finite.
    seen : ndarray of shape (T, n), bool
    reject : bool
        Whether gross errors are to be found and left out.

    Returns
    -------
    MotionModel
    """
    limits: tuple[Limits, ...] = ()
    robust = _Fit(tracks, seen)
    highest = min(_HIGHEST_RANK, tracks.shape[2] - 1, 2 * len(tracks) - 1)
    if reject:
        for rank in _ranks(min(_SUSPECT_RANK, highest // 2)):
            robust.grow(rank)
            limits += (robust.reject(),)
        seen = robust.seen
    held = _held_out(seen)
    fit = _Fit(tracks, seen & ~held)
    bridging = _grow_to_best_rank(fit, held, highest)
    fit.finish(seen)
    return MotionModel(fit.motion, fit.variance * fit.repeats, bridging, limits)


class _Fit:
    """A model on its way: coefficients and motion in turn, of growing rank."""

    def __init__(self, tracks: NDArray[np.float64], seen: NDArray[np.bool_]) -> None:
        self.tracks = tracks
        self.seen = seen
        self.weights = seen.astype(np.float64)
        centre = np.array(
            [np.median(frame[:, here], axis=1) for frame, here in zip(tracks, seen, strict=True)]
        )
        self.motion: NDArray[np.float64] = centre[:, :, None]
        self.found = np.zeros((tracks.shape[2], 0))
        # Before there is a model, tracks are straight across gaps and no farther out than most.
        rest = tracks - self.motion
        self.spread = 1.4826 * float(np.median(np.abs(rest.transpose(0, 2, 1)[seen])))
        self.spread = self.spread or float(np.abs(rest).max()) or 1.0
        rest = np.where(seen[:, None], rest, _bridged(rest, seen))
        self.rest = np.clip(rest, -5 * self.spread, 5 * self.spread)
        self.variance = self.spread**2
        self.repeats = 1.0

    def grow(self, rank: int) -> None:
        """Raise the rank, starting from the strongest directions of what is left over."""
        frames, _, points = self.tracks.shape
        new = rank - self.found.shape[1]
        left, values, right = np.linalg.svd(self.rest.reshape(2 * frames, points), False)
        scaled = (left[:, :new] * values[:new]).reshape(frames, 2, new) / np.sqrt(points)
        self.motion = np.concatenate(
            [self.motion[:, :, :-1], scaled, self.motion[:, :, -1:]], axis=2
        )
        self.found = np.concatenate([self.found, right[:new].T * np.sqrt(points)], axis=1)
        self._normalise()
        self._measure()
        for _ in range(_STEPS):
            self._step()

    def finish(self, seen: NDArray[np.bool_]) -> None:
        """Take all that is seen and iterate until gaps no longer change by a part of the noise."""
        self.seen = seen
        self.weights = seen.astype(np.float64)
        self._measure()
        before = _predicted(self.found, self.motion)
        for _ in range(_LAST_STEPS):
            self._step()
            after = _predicted(self.found, self.motion)
            change = float(np.sqrt(np.mean((after - before) ** 2)))
            if change <= max(0.004 * np.sqrt(self.variance), 0.1 * _ROUNDING * self.spread):
                return
            before = after

    def reject(self) -> Limits:
        """Leave out gross errors and return what they were told by."""
        residual = self.tracks - _predicted(self.found, self.motion)
        limits = _limits(residual, self.seen, self.found.shape[1], _GROSS * self.spread)
        for _ in range(_STEPS):
            self.weights = _robust_weights(residual, self.seen, limits)
            self._measure()
            self._step()
            residual = self.tracks - _predicted(self.found, self.motion)
            limits = _limits(residual, self.seen, limits.rank, limits.gross)
        self.seen = _without_suspects(residual, self.seen, limits)
        self.weights = self.seen.astype(np.float64)
        self._measure()
        return limits

    def _step(self) -> None:
        self.motion = _motion(self.found, self.motion, self.tracks, self.weights, self.variance)
        self.found = _coefficients(
            self.motion, self.tracks, self.weights, self.variance * self.repeats
        )
        self._normalise()
        self._measure()

    def _measure(self) -> None:
        """Find what is left over where points are seen."""
        self.rest = (self.tracks - _predicted(self.found, self.motion)) * (self.weights > 0)[
            :, None
        ]
        squares = float(np.sum(self.rest**2 * self.weights[:, None]))
        least = (_ROUNDING * self.spread) ** 2
        self.variance = max(squares / (2 * float(self.weights.sum())), least)
        # What is left over is alike from frame to frame; it counts as often as it is independent.
        ahead, behind = self.rest[1:], self.rest[:-1]
        both = (self.weights[1:] > 0) & (self.weights[:-1] > 0)
        common = float(np.sum(ahead * behind * both[:, None]))
        power = float(np.sum((ahead**2 + behind**2) * both[:, None])) / 2
        alike = min(max(common / power, 0.0), 0.999) if power > 0.0 else 0.0
        self.repeats = min((1 + alike) / (1 - alike), len(self.tracks) / 4)

    def _normalise(self) -> None:
        """Give the coefficients zero mean and unit covariance, the motion orthogonal columns."""
        mean = self.found.mean(axis=0)
        motion, centre = self.motion[:, :, :-1], self.motion[:, :, -1:]
        centre = centre + (motion @ mean)[:, :, None]
        left, values, right = np.linalg.svd(self.found - mean, full_matrices=False)
        root = np.sqrt(len(self.found))
        motion = motion @ (right.T * (values / root))
        columns = motion.reshape(-1, motion.shape[2])
        axes = np.linalg.eigh(columns.T @ columns)[1][:, ::-1]
        self.found = left @ axes * root
        self.motion = np.concatenate([motion @ axes, centre], axis=2)


def _coefficients(
    motion: NDArray[np.float64],
    tracks: NDArray[np.float64],
    weights: NDArray[np.float64],
    variance: float,
) -> NDArray[np.float64]:
    """Return the likeliest coefficients (n, r) of points, which have unit covariance a priori."""
    frames, rank = len(motion), motion.shape[2] - 1
    axes = motion[:, :, :rank]
    squares = (axes.transpose(0, 2, 1) @ axes).reshape(frames, rank * rank)
    ridge = max(variance, _RIDGE * float(np.sum(axes**2)))
    normal = (weights.T @ squares).reshape(-1, rank, rank) + ridge * np.eye(rank)
    weighted = (tracks - motion[:, :, rank:]) * weights[:, None]
    right = weighted.reshape(2 * frames, -1).T @ axes.reshape(2 * frames, rank)
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)


def _motion(
    found: NDArray[np.float64],
    before: NDArray[np.float64],
    tracks: NDArray[np.float64],
    weights: NDArray[np.float64],
    variance: float,
) -> NDArray[np.float64]:
    """Return the likeliest motion (T, 2, r + 1), whose accelerations are as large as before.

    Frames are coupled by their second differences only, so the normal equations are banded; both
    coordinates share them. The translation is free.
    """
    frames = len(tracks)
    known = np.concatenate([found, np.ones((len(found), 1))], axis=1)
    size = known.shape[1]
    pairs = (known[:, :, None] * known[:, None, :]).reshape(-1, size * size)
    blocks = (weights @ pairs).reshape(frames, size, size)
    right = (tracks * weights[:, None]) @ known

    energy = (before**2).mean(axis=(0, 1))
    bends = (np.diff(before, n=2, axis=0) ** 2).mean(axis=(0, 1))
    stiffness = variance / (bends + 1e-6 * energy + np.finfo(float).tiny)
    level = 1e-3 * variance / (energy + np.finfo(float).tiny)
    stiffness[-1] = level[-1] = 0.0
    # Directions that have died out need no more than to stay so.
    stiffness, level = (np.minimum(weight, 1e8 * len(found)) for weight in (stiffness, level))

    # The squared second differences as a matrix: its main diagonal and the one beside.
    windows = np.ones(frames - 2)
    main, near = np.convolve(windows, [1, 4, 1]), np.convolve(windows, [-2, -2])
    index = np.arange(size)
    blocks[:, index, index] += level + main[:, None] * stiffness + 1e-12 * len(found)
    bands = np.zeros((2 * size + 1, frames, size))
    for offset in range(size):
        bands[2 * size - offset, :, offset:] = np.diagonal(blocks, offset, 1, 2)
    bands[size, 1:] += near[:, None] * stiffness
    bands[0, 2:] += stiffness
    solution = solveh_banded(
        bands.reshape(2 * size + 1, frames * size),
        right.transpose(0, 2, 1).reshape(frames * size, 2),
        overwrite_ab=True,
        overwrite_b=True,
        check_finite=False,
    )
    result: NDArray[np.float64] = solution.reshape(frames, size, 2).transpose(0, 2, 1)
    return result


def _predicted(found: NDArray[np.float64], motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tracks (T, 2, n) that coefficients and motion make."""
    predicted: NDArray[np.float64] = motion[:, :, :-1] @ found.T + motion[:, :, -1:]
    return predicted


def _leading(motion: NDArray[np.float64], rank: int) -> NDArray[np.float64]:
    """Return the motion of lower rank."""
    return np.concatenate([motion[:, :, :rank], motion[:, :, -1:]], axis=2)


def _bridged(
    values: NDArray[np.float64], seen: NDArray[np.bool_], *, itself: bool = True
) -> NDArray[np.float64]:
    """Interpolate each track (T, 2, n) over the frames where it is not seen, flat beyond its ends.

    With ``itself=False`` every frame is interpolated from others.
    """
    frames, points = seen.shape
    time = np.arange(frames)[:, None]
    last = np.maximum.accumulate(np.where(seen, time, -1), axis=0)
    following = np.minimum.accumulate(np.where(seen, time, frames)[::-1], axis=0)[::-1]
    if not itself:
        last = np.concatenate([np.full((1, points), -1), last[:-1]])
        following = np.concatenate([following[1:], np.full((1, points), frames)])
    start = np.clip(np.where(last < 0, following, last), 0, frames - 1)
    end = np.clip(np.where(following >= frames, last, following), 0, frames - 1)
    part = ((time - start) / np.maximum(end - start, 1))[:, None] * (end > start)[:, None]
    from_start = np.take_along_axis(values, start[:, None], axis=0)
    from_end = np.take_along_axis(values, end[:, None], axis=0)
    bridged: NDArray[np.float64] = from_start + part * (from_end - from_start)
    return bridged


def _distances(
    residual: NDArray[np.float64], seen: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far seen positions (T, n) are from the model and from their neighbours in time."""
    neighbours = residual - _bridged(residual, seen, itself=False)
    return np.linalg.norm(residual, axis=1), np.linalg.norm(neighbours, axis=1)


def _medians(values: NDArray[np.float64], seen: NDArray[np.bool_], axis: int) -> Any:
    """Return medians over the seen entries along an axis, which stays."""
    masked = np.where(seen, values, np.nan)
    count = np.count_nonzero(seen, axis=axis, keepdims=True)
    ordered = np.sort(masked, axis=axis)  # NaN last
    middle = np.maximum(count - 1, 0) // 2
    found = np.take_along_axis(ordered, middle, axis=axis)
    return np.where(count > 0, found, 0.0)


def _limits(
    residual: NDArray[np.float64], seen: NDArray[np.bool_], rank: int, gross: float
) -> Limits:
    """Measure how far the seen positions of a sample usually are."""
    usual = [
        np.maximum(_medians(distance, seen, 1)[:, 0], np.median(distance[seen]))
        for distance in _distances(residual, seen)
    ]
    variance = float(np.median(np.sum(residual**2, axis=1)[seen]))
    return Limits(rank, variance, usual[0], usual[1], gross)


def _robust_weights(
    residual: NDArray[np.float64], seen: NDArray[np.bool_], limits: Limits
) -> NDArray[np.float64]:
    """Return weights (T, n) of least squares that hardly heed what is far off (Geman, McClure)."""
    distance = np.linalg.norm(residual, axis=1)
    usual = np.maximum(limits.model[:, None], _medians(distance, seen, 0))
    usual = np.maximum(usual, np.finfo(float).tiny)
    weights: NDArray[np.float64] = seen / (1 + (2 * distance / (_SUSPECT * usual)) ** 2) ** 2
    return weights


def _without_suspects(
    residual: NDArray[np.float64], seen: NDArray[np.bool_], limits: Limits
) -> NDArray[np.bool_]:
    """Return what of the seen positions (T, n) is no gross error.

    The neighbours of an error seem to be off, too; so only the worst within three frames goes, and
    the others are judged again.
    """
    kept = seen
    for _ in range(_SUSPECT_PASSES):
        scores = np.full(seen.shape, np.inf)
        usuals = (limits.model, limits.neighbours)
        for distance, usual in zip(_distances(residual, kept), usuals, strict=True):
            large = np.maximum(usual[:, None], _medians(distance, kept, 0))
            large = np.maximum(_SUSPECT * large, limits.gross)
            scores = np.minimum(scores, distance / large)
        scores[~kept] = 0.0
        around = np.pad(scores, ((1, 1), (0, 0)))
        suspect = (scores > 1) & (scores >= around[:-2]) & (scores >= around[2:])
        # Too little of a track would be left to judge the rest by.
        suspect &= np.count_nonzero(kept, axis=0) > 2 * MINIMUM_FRAMES
        if not suspect.any():
            break
        kept = kept & ~suspect
    return kept


def _ranks(highest: int) -> Iterator[int]:
    """Yield the ranks to go through: a basis shape more each, later several."""
    rank = 3
    while rank < highest:
        yield rank
        rank += 3 if rank < 18 else 6 if rank < 36 else 12
    yield highest


def _grow_to_best_rank(fit: _Fit, held: NDArray[np.bool_], highest: int) -> bool:
    """Give the fit the rank that predicts held-out positions best; return whether to bridge.

    Of the few positions of a small matrix none can be spared: then it is the lowest rank.
    """
    if not held.any():
        fit.grow(min(3, highest))
        return False
    tried: list[tuple[float, bool, NDArray[np.float64], NDArray[np.float64]]] = []
    best, best_at = np.inf, 0
    for index, rank in enumerate(_ranks(highest)):
        fit.grow(rank)
        plain = fit.tracks - _predicted(fit.found, fit.motion)
        bridged = plain - _bridged(plain, fit.seen)
        for residual, bridging in ((plain, False), (bridged, True)):
            error = float(np.sqrt(np.mean(np.sum(residual**2, axis=1)[held])))
            tried.append((error, bridging, fit.found, fit.motion))
            if error < best:
                best, best_at = error, index
        if index - best_at >= _PATIENCE or best <= 10 * _ROUNDING * fit.spread:
            break
    _, bridging, fit.found, fit.motion = next(
        attempt for attempt in tried if attempt[0] <= _GOOD_ENOUGH * best
    )
    return bridging


def _held_out(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Choose seen positions (T, n) to hold out, in gaps such as there are already."""
    rng = np.random.default_rng(0)
    frames, points = seen.shape
    held = np.zeros_like(seen)
    wanted = _HELD_OUT * np.count_nonzero(seen)
    # A spell of each track only: with more held out than that, every model would look too rich.
    spell = -(-frames // 4)
    for point in rng.permutation(points):
        if np.count_nonzero(held) >= wanted:
            break
        gaps = np.roll(~seen[:, rng.integers(points)], rng.integers(frames)) & seen[:, point]
        start = rng.integers(frames - spell + 1)
        here = slice(start, start + spell)
        if 2 * np.count_nonzero(gaps[here]) <= np.count_nonzero(seen[:, point]):
            held[here, point] = gaps[here]
    if np.count_nonzero(held) < wanted / 10:
        held = (rng.random(seen.shape) < _HELD_OUT / 2) & seen
    left = np.count_nonzero(seen & ~held, axis=1)
    held[left < MINIMUM_POINTS] = False
    return held


@dataclass(frozen=True, slots=True, eq=False)
class _Survey:
    """What one pass found: gaps, and a sample of the points."""

    missing: int
    sample: NDArray[np.float64]
    sample_seen: NDArray[np.bool_]


def _survey(source: MeasurementSource, visibility: NDArray[np.bool_] | None) -> _Survey:
    """Read the source once: refuse what cannot be completed, count gaps, take a sample."""
    frames, points = source.frames, source.points
    by_frame = np.zeros(frames, dtype=np.int64)
    by_point = np.zeros(points, dtype=np.int64)
    wanted = np.unique(np.linspace(0, points - 1, min(points, _SAMPLE)).astype(np.intp))
    samples, sample_seen = [], []
    for columns, block in checked_chunks(source, chunk_points(source, CHUNK_BYTES)):
        tracks, seen = _tracks_of(block, columns, visibility)
        _refuse_infinite(tracks, columns)
        by_frame += np.count_nonzero(seen, axis=1)
        by_point[columns] = np.count_nonzero(seen, axis=0)
        here = wanted[(wanted >= columns.start) & (wanted < columns.stop)] - columns.start
        samples.append(tracks[:, :, here])
        sample_seen.append(seen[:, here])
    _refuse_few(by_frame, by_point)
    return _Survey(
        missing=frames * points - int(by_frame.sum()),
        sample=np.concatenate(samples, axis=2),
        sample_seen=np.concatenate(sample_seen, axis=1),
    )


def _tracks_of(
    block: NDArray[Any], points: slice, visibility: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a block (2T, n) as tracks (T, 2, n), zero where they are not seen, and what is."""
    tracks: NDArray[np.float64] = np.array(block, dtype=np.float64).reshape(len(block) // 2, 2, -1)
    seen = np.asarray(~np.isnan(tracks).any(axis=1))
    if visibility is not None:
        seen &= visibility[:, points]
    tracks.transpose(0, 2, 1)[~seen] = 0.0
    return tracks, seen


def _checked_visibility(visibility: ArrayLike, source: MeasurementSource) -> NDArray[np.bool_]:
    mask = np.asarray(visibility)
    if mask.dtype != np.bool_:
        raise NotNumeric(
            f"The visibility has dtype {mask.dtype}; it must be bool, True where a point is seen.",
            dtype=str(mask.dtype),
        )
    if mask.shape != (source.frames, source.points):
        raise WrongShape(
            f"The visibility has shape {mask.shape}; {source.frames} frames of {source.points} "
            f"points need ({source.frames}, {source.points}).",
            shape=list(mask.shape),
        )
    return mask


def _refuse_infinite(tracks: NDArray[np.float64], points: slice) -> None:
    infinite = np.isinf(tracks)
    if not infinite.any():
        return
    frame, axis, column = (int(i) for i in np.unravel_index(infinite.argmax(), infinite.shape))
    point = points.start + column
    raise NotFinite(
        f"Coordinate {'uv'[axis]} of point {point} in frame {frame} is infinite (counting from 0). "
        "Positions that were not seen are NaN, or False in the visibility.",
        frame=frame,
        point=point,
        coordinate="uv"[axis],
    )


def _refuse_few(by_frame: NDArray[np.int64], by_point: NDArray[np.int64]) -> None:
    """Refuse frames and points of which too little is seen to place the rest."""
    frame, point = int(by_frame.argmin()), int(by_point.argmin())
    if by_frame[frame] < MINIMUM_POINTS:
        raise TooFewObservations(
            f"Frame {frame} (counting from 0) has {by_frame[frame]} points that are seen; at least "
            f"{MINIMUM_POINTS} are needed. Leave the frame out.",
            frame=frame,
            seen=int(by_frame[frame]),
            minimum=MINIMUM_POINTS,
        )
    if by_point[point] < MINIMUM_FRAMES:
        raise TooFewObservations(
            f"Point {point} (counting from 0) is seen in {by_point[point]} frames; at least "
            f"{MINIMUM_FRAMES} are needed. Leave the point out.",
            point=point,
            seen=int(by_point[point]),
            minimum=MINIMUM_FRAMES,
        )
