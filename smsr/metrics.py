"""Errors of a reconstruction against ground truth: e3D and its relatives.

Ground truth and shapes are centred in each frame and aligned by one orthogonal matrix for the
whole sequence, reflections allowed. A scale is fitted only where cameras of varying scale leave the
size of the object open. Everything is computed in double precision by
chunks of points, so single-precision arrays of millions of points are read through their memory
maps and never copied whole.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from smsr.alignment import orthogonal_factor
from smsr.errors import (
    AmbiguousLayout,
    GroundTruthMismatch,
    InvalidOption,
    NotFinite,
    NotNumeric,
    WrongShape,
)
from smsr.measurements import unmasked

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    from smsr.result import MovingSurface

Frame: TypeAlias = Literal["auto", "camera", "object"]

_BLOCK_BYTES = 16 * 2**20
"""Size of one double-precision block of one array; about six of them are alive at a time."""

_FIXED_CAMERA_TOLERANCE = 0.02
"""Part of the image that a fixed camera may leave unexplained whatever the noise: a camera that
turns by less than about a degree is the same as none."""

_FIXED_CAMERA_NOISE_RATIO = 1.25
"""How much more variance than free cameras, whose residual is pure noise, a fixed one may leave."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """How far a reconstruction is from the truth.

    Attributes
    ----------
    e3d : float
        Mean Euclidean distance between points in units of sigma (Eq. 24 of the paper, with the
        distance that its text names): ``1/(sigma T N) sum_t sum_j ||G_tj - c X_tj||``. Sigma is the
        mean over frames and axes of the standard deviation of the true coordinates over points.
    e3d_squared : float
        The same with the squared distance, as Eq. 24 is printed. It has the unit of the data.
    e3d_per_frame : float
        The same as `e3d`, with an alignment for each frame on its own: what is left when drift of
        the cameras is forgiven.
    per_frame : tuple of T floats
        Each frame's part of `e3d`, whose mean is `e3d`.
    relative_rms : float
        Mean over frames of ``||c X_t - G_t||_F / ||G_t||_F`` (Sec. 4.4), over the frames in which
        the true points do not all coincide.
    frame : {"camera", "object"}
        Which shapes were compared, ``R3_t S_t`` or ``S_t``.
    alignment : ndarray of shape (3, 3), float64, read-only
        Orthogonal Q that carries the centred shapes onto the centred truth, ``G_tj ~ c Q X_tj``.
    scale : float
        The factor c on all shapes: 1, but for cameras of varying scale, which tell no absolute
        size. It is the best one then, for the sequence as a whole.
    """

    e3d: float
    e3d_squared: float
    e3d_per_frame: float
    per_frame: tuple[float, ...]
    relative_rms: float
    frame: Literal["camera", "object"]
    alignment: NDArray[np.float64]
    scale: float = 1.0

    def __post_init__(self) -> None:
        self.alignment.flags.writeable = False

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, dicts and numbers, ready for JSON."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**values, "per_frame": list(self.per_frame), "alignment": self.alignment.tolist()}


def evaluate(
    ground_truth: ArrayLike, reconstruction: MovingSurface, *, frame: Frame = "auto"
) -> Evaluation:
    """Compare a reconstruction with ground truth.

    Parameters
    ----------
    ground_truth : array-like of shape (3T, N), (T, N, 3) or (T, 3, N)
        True points, in any order of points that agrees with the measurements. Rows of the first
        form are x1, y1, z1, x2, ...
    reconstruction : MovingSurface
        What `smsr.reconstruct` returned or `smsr.files.open_result` opened.
    frame : {"auto", "camera", "object"}
        Whether the ground truth is given in the frame of the moving camera, so that one fixed
        camera maps every frame of it to the image (its x and y rows are the centred measurements,
        up to a choice of axes), or in a frame in which the camera moves. "auto" finds out.

    Returns
    -------
    Evaluation

    Raises
    ------
    GroundTruthMismatch
        Other frames or points than the reconstruction, or true points that all coincide.
    AmbiguousLayout
        A (T, 3, 3) array, whose axes cannot be told apart.
    NotNumeric, NotFinite
        Entries that are no real numbers, or NaN, infinite, or too large to be squared.
    InvalidOption
        An unknown `frame`.

    Notes
    -----
    "auto" compares two explanations of the reconstructed images ``R_t S_t``, without scale, by the
    ground truth: one affine camera for the sequence, and one for each frame. The second fits either
    kind of ground truth up to noise. The first fits as well only if the ground truth turns with the
    camera.
    """
    if frame not in ("auto", "camera", "object"):
        raise InvalidOption(
            f"frame must be auto, camera or object; it was {frame!r}.", option="frame"
        )
    shapes = reconstruction.shapes
    frames, points = shapes.shape[:2]
    truth = as_shapes(ground_truth, frames, points)

    moments = _moments(truth, shapes)
    rotations = reconstruction.rotations.astype(np.float64)
    chosen = _detect_frame(moments, rotations[:, :2]) if frame == "auto" else frame
    turns = np.broadcast_to(np.eye(3), (frames, 3, 3)) if chosen == "object" else rotations
    cross = moments.cross @ turns.transpose(0, 2, 1)
    alignment = orthogonal_factor(cross.sum(axis=0))
    scale = 1.0
    if (reconstruction.scales != 1.0).any():
        size = max(float(np.einsum("tii->", moments.shape)), np.finfo(float).tiny)
        scale = float(np.einsum("ij,tij->", alignment, cross)) / size
    per_frame_alignment = orthogonal_factor(cross)

    deviations = np.sqrt(np.einsum("tii->ti", moments.truth) / points)
    sigma = float(deviations.mean())
    if sigma == 0.0:
        raise GroundTruthMismatch(
            "All true points coincide in every frame, so no error can be measured against them."
        )
    distances, free_distances = _distances(
        truth,
        shapes,
        moments,
        [scale * (alignment @ turns), scale * (per_frame_alignment @ turns)],
    )
    per_frame = distances.sums / (sigma * points)
    extent = np.sqrt(np.einsum("tii->t", moments.truth))
    seen = extent > 0.0
    return Evaluation(
        e3d=float(per_frame.mean()),
        e3d_squared=float(distances.squares.mean() / (sigma * points)),
        e3d_per_frame=float(free_distances.sums.mean() / (sigma * points)),
        per_frame=tuple(per_frame.tolist()),
        relative_rms=float((np.sqrt(distances.squares[seen]) / extent[seen]).mean()),
        frame=chosen,
        alignment=alignment,
        scale=scale,
    )


def as_shapes(ground_truth: ArrayLike, frames: int, points: int) -> NDArray[Any]:
    """View ground truth of any accepted layout as (T, N, 3), without a copy unless it is masked.

    Parameters
    ----------
    ground_truth : array-like of shape (3T, N), (T, N, 3) or (T, 3, N)
    frames, points : int
        T and N of the measurements.

    Raises
    ------
    GroundTruthMismatch, AmbiguousLayout, WrongShape, NotNumeric
        As in `evaluate`.
    """
    try:
        array = np.asarray(unmasked(ground_truth))
    except ValueError as error:  # nested lists of different lengths
        raise WrongShape(f"The ground truth is no array: {error}.") from error
    if array.dtype.kind not in "fiu":
        raise NotNumeric(
            f"The ground truth has entries of type {array.dtype}; real numbers are needed."
        )
    expected = (
        f"For {frames} frames of {points} points it must have {3 * frames} rows and {points} "
        f"columns (rows x1, y1, z1, x2, ...), or the shape ({frames}, {points}, 3) or "
        f"({frames}, 3, {points})"
    )
    shape = list(array.shape)
    if array.ndim == 2:
        if array.shape == (3 * frames, points):
            return array.reshape(frames, 3, points).transpose(0, 2, 1)
    elif array.ndim == 3:
        if array.shape[1:] == (3, 3):
            raise AmbiguousLayout(
                f"The ground truth has the shape {array.shape}; with 3 points its axes cannot be "
                f"told apart.",
                shape=shape,
            )
        if array.shape == (frames, points, 3):
            return array
        if array.shape == (frames, 3, points):
            return array.transpose(0, 2, 1)
    else:
        raise WrongShape(
            f"The ground truth has {array.ndim} axes; it must have 2 or 3. {expected}.", shape=shape
        )
    raise GroundTruthMismatch(
        f"The ground truth has the shape {array.shape}. {expected}.",
        shape=shape,
        frames=frames,
        points=points,
    )


@dataclass(frozen=True, slots=True)
class _Moments:
    """Means and centred second moments, summed over points, of each frame's two point sets."""

    count: int
    truth_mean: NDArray[np.float64]  # (T, 3)
    shape_mean: NDArray[np.float64]  # (T, 3)
    truth: NDArray[np.float64]  # (T, 3, 3), sum of g g^T
    cross: NDArray[np.float64]  # (T, 3, 3), sum of g x^T
    shape: NDArray[np.float64]  # (T, 3, 3), sum of x x^T

    def merged(self, other: _Moments) -> _Moments:
        """Moments of both sets of points together (Chan, Golub and LeVeque 1983)."""
        count = self.count + other.count
        share = other.count / count
        g = other.truth_mean - self.truth_mean
        x = other.shape_mean - self.shape_mean
        weight = self.count * share
        return _Moments(
            count,
            self.truth_mean + share * g,
            self.shape_mean + share * x,
            self.truth + other.truth + weight * _outer(g, g),
            self.cross + other.cross + weight * _outer(g, x),
            self.shape + other.shape + weight * _outer(x, x),
        )


@dataclass(frozen=True, slots=True)
class _Distances:
    """Distances and squared distances of each frame, summed over points."""

    sums: NDArray[np.float64]
    squares: NDArray[np.float64]


def _outer(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[:, :, None] * b[:, None, :]


def _blocks(
    truth: NDArray[Any], shapes: NDArray[Any]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield both arrays by chunks of points, as (T, 3, n) in double precision.

    Chunks of points suit row-major and column-major files alike: neither is read twice. Shapes that
    are a dask array are computed block by block.
    """
    frames, points = shapes.shape[:2]
    size = max(1, _BLOCK_BYTES // (24 * frames))
    for start in range(0, points, size):
        chosen = np.s_[:, start : start + size]
        yield (
            truth[chosen].transpose(0, 2, 1).astype(np.float64, order="C"),
            np.asarray(shapes[chosen]).transpose(0, 2, 1).astype(np.float64, order="C"),
        )


def _moments(truth: NDArray[Any], shapes: NDArray[Any]) -> _Moments:
    total: _Moments | None = None
    with np.errstate(over="ignore", invalid="ignore"):
        for g, x in _blocks(truth, shapes):
            g_mean, x_mean = g.mean(axis=2), x.mean(axis=2)
            if not np.isfinite(g_mean).all():
                _refuse_values(g, 0 if total is None else total.count)
            g -= g_mean[:, :, None]
            x -= x_mean[:, :, None]
            g_t, x_t = g.transpose(0, 2, 1), x.transpose(0, 2, 1)
            block = _Moments(g.shape[2], g_mean, x_mean, g @ g_t, g @ x_t, x @ x_t)
            total = block if total is None else total.merged(block)
    if total is None or not (np.isfinite(total.truth).all() and np.isfinite(total.cross).all()):
        raise NotFinite(
            "The ground truth or the shapes have entries that are too large to be squared."
        )
    return total


def _refuse_values(block: NDArray[np.float64], first_point: int) -> None:
    where = np.argwhere(~np.isfinite(block))
    if not len(where):
        raise NotFinite("The ground truth has entries that are too large to be summed.")
    frame, axis, point = (int(i) for i in where[0])
    value = block[frame, axis, point]
    point += first_point
    raise NotFinite(
        f"The ground truth has the value {value} in frame {frame}, point {point}, axis "
        f"{'xyz'[axis]} (counted from 0); every entry must be finite.",
        frame=frame,
        point=point,
        axis="xyz"[axis],
    )


def _distances(
    truth: NDArray[Any],
    shapes: NDArray[Any],
    moments: _Moments,
    candidates: list[NDArray[np.float64]],
) -> list[_Distances]:
    """Distances between the centred truth and the centred shapes under (T, 3, 3) transforms."""
    totals = [_Distances(np.zeros(len(truth)), np.zeros(len(truth))) for _ in candidates]
    for g, x in _blocks(truth, shapes):
        g -= moments.truth_mean[:, :, None]
        x -= moments.shape_mean[:, :, None]
        for transforms, total in zip(candidates, totals, strict=True):
            difference = transforms @ x
            difference -= g
            squared = np.einsum("tin,tin->tn", difference, difference)
            total.squares[:] += squared.sum(axis=1)
            total.sums[:] += np.sqrt(squared, out=squared).sum(axis=1)
    return totals


def _detect_frame(moments: _Moments, R: NDArray[np.float64]) -> Literal["camera", "object"]:
    """Say whether one fixed camera explains the images of the ground truth."""
    image = np.einsum("tij,tjk,tik->", R, moments.shape, R)  # sum of ||R_t x||^2
    cross = R @ moments.cross.transpose(0, 2, 1)  # sum of (R_t x) g^T
    free = image - np.sum(_explained(cross, moments.truth))
    fixed = image - float(_explained(cross.sum(axis=0), moments.truth.sum(axis=0)))
    # Each frame's free camera has 6 parameters for 2 (N - 1) centred coordinates; with as many
    # parameters as coordinates its residual says nothing of the noise.
    spare = moments.count - 4
    noise = max(free, 0.0) * (moments.count - 1) / spare if spare > 0 else 0.0
    allowed = _FIXED_CAMERA_NOISE_RATIO * noise + _FIXED_CAMERA_TOLERANCE**2 * image
    return "camera" if fixed <= allowed else "object"


def _explained(cross: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of squares that the best affine camera explains, from its normal equations."""
    inverse = np.linalg.pinv(truth, rcond=1e-12, hermitian=True)
    explained: NDArray[np.float64] = np.einsum("...ij,...jk,...ik->...", cross, inverse, cross)
    return explained
