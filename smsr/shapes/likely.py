"""Depths that a Gaussian model of the deformation and lengths that keep make likely."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from smsr.progress import ignore
from smsr.rotations import depths_along
from smsr.shapes.adjustment import Adjustment
from smsr.shapes.credibility import faded, steadiness, trust
from smsr.shapes.deformation import likely_shapes
from smsr.shapes.estimate import turned_to
from smsr.shapes.lengths import Lengths, chosen_points
from smsr.shapes.low_rank import MOST_FLICKER, RIGID

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook
    from smsr.shapes.estimate import ShapeEstimate


LIKELY = (0.6, 0.9)
"""Complexities between which the likely depths lose their part, unless the shapes are steady."""

_NOISIEST = 0.4  # part of the tracks' spread
_DIRECTIONS = 24
_FLOOR = 0.0008
_FLOOR_BY_NOISE = 0.07
_SHRINKAGE = 0.07
_TOLERANCE = 5e-4
_LEAST_ROUNDS = 20
_MOST_ROUNDS = 60
_FRAMES_IN_ALL_ROUNDS = 60_000


def with_likely_depth(
    estimate: ShapeEstimate,
    rotations: NDArray[np.float64],
    noise: float = 0.0,
    *,
    points: NDArray[np.float64] | None = None,
    adjustable: NDArray[np.float64] | None = None,
    doubtful: bool = False,
    max_iterations: int = 1000,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Return the shapes with depths that are likelier under a Gaussian model of the deformation.

    See `smsr.shapes.deformation` and `smsr.shapes.lengths`. The depths count less where depth is
    doubtful and where noise was taken off (what is left of it looks like deformation). Of motion
    that flickered the Gaussian model knows nothing: there lengths count more, and where none keep,
    depths less.

    Parameters
    ----------
    estimate : ShapeEstimate
        With its complexity and flicker, T >= 2.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.
    points : ndarray of shape (q, n), optional
        Some real points in terms of the q that the shapes have; without it, these are real.
    adjustable : ndarray of shape (k, T, 3), optional
        What may change of the cameras, see `smsr.shapes.adjustment`. They do as far as the
        depths count.
    doubtful : bool
        Do this for doubtful depths, too: how steady the shapes become then may remove the doubt.
    max_iterations : int
        Of all, those that the estimate took included.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    part, certain = faded(estimate.complexity, LIKELY), max(1.0 - noise / _NOISIEST, 0.0)
    # The more frames there are, the surer is each round, and the longer it takes.
    rounds = max(_LEAST_ROUNDS, min(_MOST_ROUNDS, _FRAMES_IN_ALL_ROUNDS // len(rotations)))
    rounds = min(rounds, max_iterations - estimate.iterations)
    if certain == 0.0 or (part == 0.0 and not doubtful) or rounds < 1:
        return estimate
    # Directions that carry little of the tracks have hardly any depth, and cost as much as others.
    seen = (rotations[:, :2] @ estimate.shapes).reshape(2 * len(rotations), -1)
    _, values, right = np.linalg.svd(seen, full_matrices=False)
    count = min(_DIRECTIONS, int((values > 1e-9 * values[0]).sum()))
    directions = right[:count].T
    some = estimate.shapes @ directions
    flat = some.reshape(len(some), -1)
    if np.linalg.norm(flat - flat.mean(axis=0)) <= RIGID * np.linalg.norm(flat):
        return estimate
    chosen = chosen_points(seen if points is None else seen @ points)
    lengths = Lengths(
        estimate.shapes[:, :, chosen] if points is None else estimate.shapes @ points[:, chosen],
        directions[chosen].T if points is None else directions.T @ points[:, chosen],
        rotations[:, 2],
        depths_along(rotations[:, 2], some),
        noise=noise,
        weight=1.0 + estimate.flicker,
    )
    adjustment = None if adjustable is None else Adjustment(rotations, adjustable)
    likely = likely_shapes(
        some,
        rotations,
        lengths=lengths,
        adjustment=adjustment,
        floor=_FLOOR + _FLOOR_BY_NOISE * noise,
        shrinkage=_SHRINKAGE,
        max_iterations=rounds,
        tolerance=_TOLERANCE,
        hook=hook,
    )
    likely_cameras = rotations if adjustment is None else adjustment.rotations()
    steady = steadiness(likely.shapes, likely_cameras)
    part = max(part, steady) * certain
    part *= 1.0 - (1.0 - likely.support) * estimate.flicker / MOST_FLICKER
    shapes, others, adjusted = estimate.shapes, likely.shapes, None
    if adjustment is not None:
        adjusted = adjustment.rotations(part)
        shapes, some = (turned_to(each, rotations, adjusted) for each in (shapes, some))
        others = turned_to(others, likely_cameras, adjusted)
    return dataclasses.replace(
        estimate,
        shapes=shapes + part * (others - some) @ directions.T,
        steadiness=steady * trust(noise),
        rotations=adjusted,
        iterations=estimate.iterations + likely.iterations,
        reason=f"{estimate.reason}; {part:.0%} of depths as a Gaussian deformation has them, "
        f"{likely.support:.0%} of points with lengths that keep",
    )
