"""The most likely shapes under a Gaussian model of the deformation that is learnt with them.

Shapes of few basis shapes are simple, but of all simple ones the penalties on singular values take
the flattest. Here the shapes of all frames are one sample of a Gaussian process,

    E[S_t] = m,    cov(S_s, S_t) = a^|s - t| Sigma                          (S_t as a 3q-vector),

and the depths, conditioned on the tracks, are its posterior mean. Mean and covariance are learnt
from the same tracks by expectation and maximisation (Dempster, Laird, Rubin 1977), the correlation
by its moment (Yule, Walker). Unlike in a penalised fit, depths that are uncertain count in Sigma
with their uncertainty, which keeps it from shrinking onto what was found first, and where few
shapes are independent it is mixed with a simpler one. L. Torresani, A. Hertzmann, C. Bregler
(PAMI 2008) model basis weights so; here the whole shape is the state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri

from smsr.progress import ignore
from smsr.rotations import depths_along
from smsr.shapes.adjustment import SETTLED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook
    from smsr.shapes.adjustment import Adjustment
    from smsr.shapes.lengths import Evidence, Lengths

_FIRST_CORRELATION = 0.9
_MOST_CORRELATION = 0.9999
_SPANNED = 1e-9  # variance by the largest one
_OF_LOWER_QUARTILE = 0.25
_FEWEST_ROUNDS = 9  # without lengths
_FEWEST_MORE = 3  # with them
_ROUNDS_WITHOUT_LENGTHS = 0.6  # of all, at most
_FARTHEST = 8.0  # steps that an extrapolation goes at once
_ROUNDS_WITHOUT_TURNS = 5  # until the model has left the shapes that it was learnt from first


@dataclass(frozen=True, eq=False)
class Deformation:
    """A Gaussian autoregressive process of shapes.

    Attributes
    ----------
    mean : ndarray of shape (3q,)
        m.
    covariance : ndarray of shape (3q, 3q)
        Sigma, of full rank.
    correlation : float
        a, between consecutive frames, 0 <= a < 1.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    correlation: float

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """The inverse of the covariance."""
        return _inverse(self.covariance, np.tri(len(self.covariance), dtype=bool))

    def temporal_precision(self, frames: int) -> tuple[NDArray[np.float64], float]:
        """Return diagonal (T,) and off-diagonal of the inverse of ``a^|s - t|``, T >= 2."""
        scale = 1.0 / (1.0 - self.correlation**2)
        diagonal = np.full(frames, (1.0 + self.correlation**2) * scale)
        diagonal[[0, -1]] = scale
        return diagonal, -self.correlation * scale


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Depths given the tracks.

    Attributes
    ----------
    depths : ndarray of shape (T, q)
        Their mean.
    covariances : ndarray of shape (T, q, q)
        Of the depths of each frame.
    next_covariances : ndarray of shape (T - 1, q, q)
        Of the depths of each frame with those of the next.
    """

    depths: NDArray[np.float64]
    covariances: NDArray[np.float64]
    next_covariances: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LikelyShapes:
    """Outcome of `likely_shapes`.

    Attributes
    ----------
    shapes : ndarray of shape (T, 3, q)
        S, with W = R S as before, R after the adjustment.
    deformation : Deformation
        The model that they were found by.
    iterations : int
        Rounds of expectation and maximisation.
    change : float
        Of the depths in the last round, as a part of the deformation.
    support : float
        See `smsr.shapes.lengths.Evidence`; 0 without lengths.
    """

    shapes: NDArray[np.float64]
    deformation: Deformation
    iterations: int
    change: float
    support: float = 0.0


def likely_shapes(
    shapes: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    floor: float,
    max_iterations: int,
    tolerance: float,
    shrinkage: float = 0.0,
    lengths: Lengths | None = None,
    adjustment: Adjustment | None = None,
    hook: StageHook = ignore,
) -> LikelyShapes:
    """Move the depths of shapes to where the tracks are likelier, and lengths keep.

    Every third round is extrapolated. Rounds are few on purpose: the likelihood of a model with so
    many parameters goes on rising after the depths have become worse.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, q)
        S to start from, not rigid, T >= 2. What the cameras see of it stays.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    floor : float
        Standard deviation in every direction at least, as a part of the root mean square over
        frames and axes of the norm of a shape; more than 0, with shrinkage 1e-4 at least.
    max_iterations : int
        Most rounds, at least 1.
    tolerance : float
        Change of the depths in a round, as a part of the deformation, at which to stop.
    shrinkage : float
        See `learnt`.
    lengths : Lengths, optional
        Distances between points, some of which keep. They take part once the depths have settled
        without them, and from three fifths of the rounds on anyway.
    adjustment : Adjustment, optional
        Of the same cameras, which then go to where the tracks are likelier, too.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    frames = len(shapes)
    seen = rotations[:, :2] @ shapes
    axis, planar = as_seen(rotations, seen)
    latest = [depths_along(axis, shapes)]
    flat = shapes.reshape(frames, -1)
    size = float(np.linalg.norm(flat - flat.mean(axis=0)))
    variance = least_variance(shapes, floor)
    deformation = first_model(shapes, axis, variance, shrinkage)
    # Lengths hold on to depths that they find: a face that still was too flat stayed so.
    joins = math.ceil(_ROUNDS_WITHOUT_LENGTHS * max_iterations)
    fewest, support = _FEWEST_ROUNDS, 0.0
    for iteration in range(1, max_iterations + 1):
        evidence, complete = None, lengths is None or iteration > joins
        if lengths is not None and complete:
            evidence = lengths.evidence(latest[-1])
            support = evidence.support
        posterior = condition(deformation, planar, axis, evidence)
        change = float(np.linalg.norm(posterior.depths - latest[-1])) / size
        latest.append(posterior.depths)
        hook(iteration / max_iterations, iteration, change)
        turned = 0.0
        if adjustment is not None and _ROUNDS_WITHOUT_TURNS < iteration <= joins:
            turned = adjustment.step(turning_force(deformation, planar, rotations, posterior))
            rotations = adjustment.rotations()
            axis, planar = as_seen(rotations, seen)
        # The first steps are as small as the least variance is, whatever is still to come.
        settled = iteration >= fewest and change < tolerance and turned <= SETTLED
        if iteration == max_iterations or (settled and complete):
            break
        if not complete and (settled or iteration == joins):
            joins, fewest = iteration, iteration + _FEWEST_MORE
            latest = latest[-1:]  # steps with and without lengths lead to different places
        if len(latest) == 3:
            latest = [extrapolated(*latest)]
        shapes = planar + axis[:, :, None] * latest[-1][:, None]
        deformation = learnt(deformation, shapes, axis, posterior, variance, shrinkage=shrinkage)
    shapes = planar + axis[:, :, None] * latest[-1][:, None]
    return LikelyShapes(shapes, deformation, iteration, change, support)


def as_seen(
    rotations: NDArray[np.float64], seen: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return viewing directions (T, 3) and the shapes of zero depth (T, 3, q).

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    seen : ndarray of shape (T, 2, q)
        The tracks.
    """
    return np.ascontiguousarray(rotations[:, 2]), rotations[:, :2].transpose(0, 2, 1) @ seen


def least_variance(shapes: NDArray[np.float64], floor: float) -> float:
    """Return the variance that a floor, see `likely_shapes`, stands for."""
    return floor**2 * float((shapes**2).sum()) / (3 * len(shapes))


def first_model(
    shapes: NDArray[np.float64],
    axis: NDArray[np.float64],
    variance: float,
    shrinkage: float = 0.0,
) -> Deformation:
    """Return the model of shapes (T, 3, q) that are taken for certain, otherwise as `learnt`."""
    frames, _, points = shapes.shape
    flat = shapes.reshape(frames, -1)
    certain = np.zeros((frames, points, points))
    return learnt(
        Deformation(flat.mean(axis=0), np.eye(3 * points), _FIRST_CORRELATION),
        shapes,
        axis,
        Posterior(depths_along(axis, shapes), certain, certain[1:]),
        variance,
        shrinkage=shrinkage,
        keep_correlation=True,
    )


def extrapolated(
    first: NDArray[np.float64], second: NDArray[np.float64], third: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where three successive values of a slow iteration lead.

    Squared extrapolation (Varadhan, Roland, Scandinavian Journal of Statistics 2008, scheme S3), by
    a bounded number of steps at once.

    Parameters
    ----------
    first, second, third : ndarray
        Values, the latest one last.
    """
    step = second - first
    bend = third - second - step
    length = float(np.linalg.norm(step)) / max(float(np.linalg.norm(bend)), np.finfo(float).tiny)
    length = min(max(length, 1.0), _FARTHEST)
    return first + 2.0 * length * step + length**2 * bend


def condition(
    deformation: Deformation,
    planar: NDArray[np.float64],
    axis: NDArray[np.float64],
    evidence: Evidence | None = None,
) -> Posterior:
    """Return the depths given all that the cameras see.

    The precision of the depths of all frames is block-tridiagonal; it is factored from both ends to
    the middle, and mean and covariances follow on the way back (Rauch, Tung, Striebel 1965).

    Parameters
    ----------
    deformation : Deformation
        The model.
    planar : ndarray of shape (T, 3, q)
        The shapes of zero depth, R^+ W, T >= 2.
    axis : ndarray of shape (T, 3)
        Viewing directions.
    evidence : Evidence, optional
        What is known of the depths beside.
    """
    diagonal, coupling, force = _chain(deformation, planar, axis)
    if evidence is not None:
        diagonal += evidence.precision
        force += evidence.force
    return _posterior(diagonal, coupling, force)


def _chain(
    deformation: Deformation, planar: NDArray[np.float64], axis: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the precision of the depths and its product with their mean, as for `_posterior`."""
    frames, _, points = planar.shape
    here, ahead = deformation.temporal_precision(frames)
    precision = deformation.precision
    blocks = _by_axes(precision, points)
    diagonal = (_outer(axis, axis) * here[:, None] @ blocks).reshape(frames, points, points)
    coupling = (ahead * _outer(axis[:-1], axis[1:]) @ blocks).reshape(-1, points, points)
    return diagonal, coupling, -depths_along(axis, _pull(deformation, planar))


def _pull(deformation: Deformation, shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gradient of the log-density of shapes (T, 3, q), negated."""
    here, ahead = deformation.temporal_precision(len(shapes))
    rows = (shapes.reshape(len(shapes), -1) - deformation.mean) @ deformation.precision
    return _through_time(rows, here, ahead).reshape(shapes.shape)


def log_likelihood(
    deformation: Deformation, planar: NDArray[np.float64], axis: NDArray[np.float64]
) -> float:
    """Return the logarithm of the density of the tracks, by coordinate and but for a constant.

    The density of the shapes of zero depth over that of no depth given the tracks.

    Parameters
    ----------
    deformation : Deformation
        The model.
    planar : ndarray of shape (T, 3, q)
        The shapes of zero depth, R^+ W, T >= 2.
    axis : ndarray of shape (T, 3)
        Viewing directions.
    """
    frames, _, points = planar.shape
    diagonal, coupling, force = _chain(deformation, planar, axis)
    deviation = planar.reshape(frames, -1) - deformation.mean
    total = float((deviation * _pull(deformation, planar).reshape(frames, -1)).sum())
    total += frames * float(np.linalg.slogdet(deformation.covariance)[1])
    total += 3 * points * (frames - 1) * math.log1p(-(deformation.correlation**2))
    # Depths are eliminated one frame after the other.
    block, right = diagonal[0], force[0]
    for t in range(frames):
        solved = np.linalg.solve(block, right)
        total += float(np.linalg.slogdet(block)[1] - right @ solved)
        if t < frames - 1:
            right = force[t + 1] - coupling[t].T @ solved
            block = diagonal[t + 1] - coupling[t].T @ np.linalg.solve(block, coupling[t])
    likelihood: float = -total / (4 * frames * points)
    return likelihood


def _posterior(
    diagonal: NDArray[np.float64], coupling: NDArray[np.float64], force: NDArray[np.float64]
) -> Posterior:
    """Return mean and covariances of a chain from its precision and precision times mean.

    Both ends are eliminated at once, towards the middle: frame i with its mirror image, two
    matrices to a product, which costs little more than one.

    Parameters
    ----------
    diagonal : ndarray of shape (T, q, q)
        Precision of each frame, T >= 2.
    coupling : ndarray of shape (T - 1, q, q)
        Of each frame with the next.
    force : ndarray of shape (T, q)
        Precision times mean.
    """
    frames, points = force.shape
    pairs, below = (frames - 1) // 2, np.tri(points, dtype=bool)
    own = np.stack([diagonal[: pairs + 1], diagonal[::-1][: pairs + 1]], axis=1)
    inwards = np.stack([coupling[:pairs], coupling[::-1][:pairs].transpose(0, 2, 1)], axis=1)
    rights = np.stack([force[: pairs + 1], force[::-1][: pairs + 1]], axis=1)[..., None]
    inverses, gains = np.empty_like(inwards), np.empty_like(inwards)
    means = np.empty_like(rights)
    block, right = own[0], rights[0]
    for i in range(pairs):
        inverses[i, 0] = _inverse(block[0], below)
        inverses[i, 1] = _inverse(block[1], below)
        mean = np.matmul(inverses[i], right, out=means[i])
        gain = np.matmul(inverses[i], inwards[i], out=gains[i])
        back = inwards[i].transpose(0, 2, 1)
        block = own[i + 1] - back @ gain
        right = rights[i + 1] - back @ mean

    depths = np.empty_like(force)
    covariances = np.empty_like(diagonal)
    following = np.empty_like(coupling)
    last = frames - 1 - pairs
    if last == pairs:
        covariances[last] = _inverse(block[0] + block[1] - diagonal[last], below)
        depths[last] = covariances[last] @ (right[0] + right[1] - force[last][:, None])[:, 0]
    else:
        inverse = _inverse(block[0], below)
        mean, gain = inverse @ right[0], inverse @ coupling[pairs]
        covariances[last] = _inverse(block[1] - coupling[pairs].T @ gain, below)
        depths[last] = covariances[last] @ (right[1] - coupling[pairs].T @ mean)[:, 0]
        depths[pairs] = mean[:, 0] - gain @ depths[last]
        following[pairs] = -gain @ covariances[last]
        covariances[pairs] = inverse - following[pairs] @ gain.T
    middle = [pairs, last]
    mean, covariance = depths[middle][..., None], covariances[middle]
    for i in range(pairs - 1, -1, -1):
        gain = gains[i]
        mean = np.subtract(means[i], gain @ mean, out=means[i])
        joint = np.matmul(gain, covariance, out=inwards[i])
        inverses[i] += joint @ gain.transpose(0, 2, 1)
        covariance = inverses[i]
    depths[:pairs], depths[::-1][:pairs] = means[:pairs, 0, :, 0], means[:pairs, 1, :, 0]
    covariances[:pairs], covariances[::-1][:pairs] = inverses[:, 0], inverses[:, 1]
    following[:pairs] = -inwards[:, 0]
    following[::-1][:pairs] = -inwards[:, 1].transpose(0, 2, 1)
    return Posterior(depths, covariances, following)


def turning_force(
    deformation: Deformation,
    planar: NDArray[np.float64],
    rotations: NDArray[np.float64],
    posterior: Posterior,
) -> NDArray[np.float64]:
    """Return the gradient of the log-likelihood of the tracks by turns of the cameras.

    By Fisher's identity it is the mean, over the depths given the tracks, of the gradient of the
    log-density of the shapes, ``sum_n y_tn x h_tn`` with y = R S the shape and h that gradient by
    the shape, negated, both in the frame of the camera.

    Parameters
    ----------
    deformation : Deformation
        The model.
    planar : ndarray of shape (T, 3, q)
        The shapes of zero depth, R^+ W.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    posterior : Posterior
        Of the depths, see `condition`.

    Returns
    -------
    ndarray of shape (T, 3)
        By phi_t in ``G_t <- exp(phi_t) G_t``.
    """
    frames, _, points = planar.shape
    axis = rotations[:, 2]
    here, ahead = deformation.temporal_precision(frames)
    precision = deformation.precision
    shapes = planar + axis[:, :, None] * posterior.depths[:, None]
    pull = _pull(deformation, shapes)
    force: NDArray[np.float64] = np.cross(rotations @ shapes, rotations @ pull, axis=1).sum(axis=2)
    # The depths and the pull on them vary together.
    blocks = _by_axes(precision, points).T
    same = (posterior.covariances.reshape(frames, -1) @ blocks).reshape(-1, 3, 3)
    following = (posterior.next_covariances.reshape(frames - 1, -1) @ blocks).reshape(-1, 3, 3)
    joint = here[:, None] * np.einsum("tij,tj->ti", same, axis)
    joint[:-1] += ahead * np.einsum("tij,tj->ti", following, axis[1:])
    joint[1:] += ahead * np.einsum("tji,tj->ti", following, axis[:-1])
    joint = np.einsum("tij,tj->ti", rotations, joint)
    force[:, 0] -= joint[:, 1]
    force[:, 1] += joint[:, 0]
    return force


def _through_time(
    rows: NDArray[np.float64], here: NDArray[np.float64], ahead: float
) -> NDArray[np.float64]:
    """Multiply rows (T, n) by the tridiagonal matrix of `Deformation.temporal_precision`."""
    product = here[:, None] * rows
    product[:-1] += ahead * rows[1:]
    product[1:] += ahead * rows[:-1]
    return product


def _inverse(matrix: NDArray[np.float64], below: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the inverse of a symmetric positive definite matrix, near it where it is not.

    By its Cholesky factor, which takes half the time of a general inverse and is symmetric. `below`
    is true on and below the diagonal.
    """
    factor, failed = dpotrf(matrix, lower=1, clean=0)
    if failed:
        values, vectors = np.linalg.eigh(matrix)
        values = np.maximum(values, np.finfo(float).eps * np.abs(values).max())
        return np.asarray(vectors / values @ vectors.T, dtype=np.float64)
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    inverse: NDArray[np.float64] = np.where(below, lower, lower.T)
    return inverse


def learnt(
    deformation: Deformation,
    shapes: NDArray[np.float64],
    axis: NDArray[np.float64],
    posterior: Posterior,
    variance: float,
    *,
    shrinkage: float = 0.0,
    keep_correlation: bool = False,
) -> Deformation:
    """Return the model of the largest expected likelihood, with a least variance.

    The correlation is not the likeliest, but that of all directions of the former model alike:
    directions that hardly move are near the least variance, and would have it near 1.

    Parameters
    ----------
    deformation : Deformation
        The former model.
    shapes : ndarray of shape (T, 3, q)
        S of the mean depths.
    axis : ndarray of shape (T, 3)
        Viewing directions.
    posterior : Posterior
        Of the depths, see `condition`.
    variance : float
        See `least_variance`.
    shrinkage : float
        Weight of a simpler model beside a covariance that is learnt from one shape, see `_shrunk`.
        0 where each camera turns freely and where cameras are compared by likelihood: they would be
        turned to explain motion that only the simpler model knows of.
    keep_correlation : bool
        Leave the correlation as it was.
    """
    frames = len(shapes)
    flat = shapes.reshape(frames, -1)
    weights = np.full(frames, 1.0 - deformation.correlation)
    weights[[0, -1]] = 1.0
    mean = weights @ flat / weights.sum()
    deviation = flat - mean
    ends = deviation[[0, -1]]
    same = deviation.T @ deviation + _spread(axis, axis, posterior.covariances)
    at_ends = ends.T @ ends + _spread(axis[[0, -1]], axis[[0, -1]], posterior.covariances[[0, -1]])
    following = deviation[:-1].T @ deviation[1:]
    following += _spread(axis[:-1], axis[1:], posterior.next_covariances)
    correlation = deformation.correlation
    if not keep_correlation:
        precision = deformation.precision
        ratio = float((precision * following).sum() / (precision * same).sum())
        correlation = min(max(ratio, 0.0), _MOST_CORRELATION)
    scale = 1.0 / (1.0 - correlation**2)
    covariance = (
        scale
        / frames
        * (same + correlation**2 * (same - at_ends) - correlation * (following + following.T))
    )
    covariance = 0.5 * (covariance + covariance.T)
    if shrinkage > 0.0:
        covariance = _shrunk(covariance, frames, correlation, shrinkage)
    covariance[np.diag_indices_from(covariance)] += variance
    return Deformation(mean, covariance, correlation)


def _shrunk(
    covariance: NDArray[np.float64], frames: int, correlation: float, shrinkage: float
) -> NDArray[np.float64]:
    """Return a covariance (3q, 3q) that is as unsure as one learnt from few shapes must be.

    A model of fewer parameters is mixed in, as by Ledoit and Wolf (Journal of Multivariate Analysis
    2004): all points move along the axes alike, ``A kron C``, with A how shapes move along the
    axes and C how points move together. Its part is the less, the more shapes are independent,
    ``T (1 - a^2) / (1 + a^2)`` (Bartlett, Journal of the Royal Statistical Society 1935) and one to
    begin with. Were the process what it is taken for, all T frames would count; but real motion is
    smoother, and the covariance is learnt from depths that it gave itself. Of few basis shapes the
    model is wrong, as it moves where they do not. So its part stays below what the covariance has,
    in units of the model, in most directions.
    """
    blocks = covariance.reshape(3, len(covariance) // 3, 3, -1)
    of_axes, of_points = np.einsum("aibi->ab", blocks), np.einsum("aiaj->ij", blocks)
    size = float(np.trace(of_axes))
    if size == 0.0:  # nothing moves
        return covariance
    along, axes = np.linalg.eigh(of_axes / size)
    together, points = np.linalg.eigh(of_points)
    variances = np.maximum(np.kron(along, together), 0.0)
    directions = np.kron(axes, points)
    spanned = variances > _SPANNED * variances[-1]
    whitened = directions[:, spanned] / np.sqrt(variances[spanned])
    parts = np.linalg.eigvalsh(whitened.T @ covariance @ whitened)
    independent = 1.0 + frames * (1.0 - correlation**2) / (1.0 + correlation**2)
    part = min(shrinkage / independent, _OF_LOWER_QUARTILE * float(np.quantile(parts, 0.25)))
    mixed: NDArray[np.float64] = covariance + part * np.kron(of_axes / size, of_points)
    return mixed / (1.0 + part)


def _outer(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products (T, 9) of the coordinates of directions (T, 3)."""
    return (first[:, :, None] * second[:, None, :]).reshape(len(first), 9)


def _by_axes(matrix: NDArray[np.float64], points: int) -> NDArray[np.float64]:
    """Return a matrix (3q, 3q) as its nine blocks (9, q^2), one for each pair of axes."""
    blocks = matrix.reshape(3, points, 3, points).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(blocks).reshape(9, points * points)


def _spread(
    first: NDArray[np.float64], second: NDArray[np.float64], covariances: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sum (3q, 3q) of covariances (T, q, q) of depths along two directions (T, 3)."""
    frames, points, _ = covariances.shape
    blocks = _outer(first, second).T @ covariances.reshape(frames, points * points)
    spread = blocks.reshape(3, 3, points, points).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(spread).reshape(3 * points, 3 * points)
