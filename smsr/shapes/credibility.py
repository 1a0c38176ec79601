"""How much depth can be believed, and shapes that have so much.

Where the camera turns little, right depth makes shapes hardly simpler than wrong depth does. What
else there is to tell by: how steadily the object moves, how wide it is, and what another way into
the problem and other cameras find.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.rotations import depths_along, spread_of_views
from smsr.shapes.estimate import planar_shapes, turned_to

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.shapes.estimate import ShapeEstimate


DOUBTFUL = 0.6
"""Complexity above which the way into the problem decides on the depth."""

FLAT = (0.85, 0.95)
"""Complexities between which depth is faded out."""

_DEEPEST = 2.0  # by the extent in the image

_STEADY = (1.0, 3.0)  # ratios of second differences between which shapes become sure
_UNSTEADY = (0.1, 0.25)  # products of both ratios between which they stop to be wrong

_DEEP = (0.7, 0.85)  # complexities between which unsteady deep shapes lose their part
_DEEPEST_BY_WIDTH = 1.25
_NOISIEST = 0.15  # part of the tracks' spread
_FEW_VIEWS = (math.radians(30.0), math.radians(45.0))  # widest angles between viewing directions


def faded(value: float, limits: tuple[float, float]) -> float:
    """Return 1 up to the first limit, 0 from the second on, and evenly less between them."""
    low, high = limits
    return min(max((high - value) / (high - low), 0.0), 1.0)


def steadiness(shapes: NDArray[np.float64], rotations: NDArray[np.float64]) -> float:
    """Return what the steadiness of the shapes says for them: 1 for sure, 0 nothing, -1 against.

    A camera held in the hand shakes, and an object rarely does: where the tracks, and flat shapes,
    have much larger second differences in time, depth explains the shake, which wrong depth cannot.
    (Flat ones too, for they explain as much of a roll about the viewing direction.) Where the
    product of the ratios of first and of second differences is far below 1, most of the motion is
    that of the depths, which the tracks cannot have told.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, N)
        S.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    seen = rotations[:, :2] @ shapes
    flat = planar_shapes(seen.reshape(-1, seen.shape[2]), rotations)
    ratios = []
    for order in (1, 2):
        tracks, without, moved = (
            float((np.diff(each, n=order, axis=0) ** 2).sum()) for each in (seen, flat, shapes)
        )
        least = min(tracks, without)
        # Two frames have no second differences, and an object at rest has none either.
        ratios.append(least / moved if moved > 0.0 else 1.0)
    motion, shake = ratios
    low, high = _STEADY
    sure = min(math.log(max(shake, low) / low) / math.log(high / low), 1.0)
    return sure - faded(motion * shake, _UNSTEADY)


def trust(noise: float) -> float:
    """Return how far the simplicity of shapes can be trusted: noise makes wrong depths simple."""
    return max(1.0 - (noise / _NOISIEST) ** 2, 0.0)


def with_deep_shapes(
    estimate: ShapeEstimate,
    deep: ShapeEstimate,
    rotations: NDArray[np.float64],
    noise: float = 0.0,
) -> ShapeEstimate:
    """Return shapes between those entered from flat and those entered from deep ones.

    Where the camera turns little, the nuclear norm hardly changes between the two, and one has too
    little depth and the other often too much. Deep shapes count as far as they make the shapes
    simpler or are steadier than the tracks, and with little more depth than the object is wide;
    where the camera hardly turns, all depth is taken back if they are far less steady.

    Parameters
    ----------
    estimate, deep : ShapeEstimate
        Entered from flat shapes and from those of least motion.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    noise : float
        As a part of the tracks' spread: the more there was, the less does simplicity say.
    """
    part = max(faded(deep.complexity, _DEEP) * trust(noise), deep.steadiness)
    doubt = faded(spread_of_views(rotations), _FEW_VIEWS)
    keep = 1.0 + doubt * min(deep.steadiness, 0.0)
    if part == 0.0 and keep == 1.0:
        return estimate
    seen = rotations @ deep.shapes
    depth = math.sqrt(float((seen[:, 2] ** 2).mean()))
    image = seen[:, :2].transpose(1, 0, 2).reshape(2, -1)
    width = float(np.linalg.norm(image, 2)) / math.sqrt(seen[:, 2].size)
    width *= _DEEPEST_BY_WIDTH
    depths = min(1.0, width / max(depth, np.finfo(float).tiny)) * seen[:, 2]
    axis = rotations[:, 2]
    present = depths_along(axis, estimate.shapes)
    change = keep * (present + part * (depths - present)) - present
    reason = f"{estimate.reason}; {part:.0%} of shapes with full depth: {deep.reason}"
    if keep < 1.0:
        reason += f"; {keep:.0%} of the depth was kept, for likely depths move more than the tracks"
    return dataclasses.replace(
        estimate,
        shapes=estimate.shapes + axis[:, :, None] * change[:, None],
        steadiness=deep.steadiness,
        iterations=estimate.iterations + deep.iterations,
        converged=estimate.converged and deep.converged,
        reason=reason,
    )


def with_mean_depth(
    estimate: ShapeEstimate,
    rotations: NDArray[np.float64],
    other: ShapeEstimate,
    others: NDArray[np.float64],
    share: float = 0.5,
) -> ShapeEstimate:
    """Return shapes with a mean of the depths that two sets of cameras see.

    An object that turns as a whole looks simpler to cameras that turn with it. Their depths may
    then be the better ones, though their path is not the camera's. Complexity and steadiness are
    means, too.

    Parameters
    ----------
    estimate : ShapeEstimate
        Found with `rotations`.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    other : ShapeEstimate
        Found with `others`.
    others : ndarray of shape (T, 3, 3)
        Other cameras for the same tracks.
    share : float
        Weight of the other depths, 0 to 1.
    """
    turned = turned_to(other.shapes, others, rotations)
    return dataclasses.replace(
        estimate,
        shapes=estimate.shapes + share * (turned - estimate.shapes),
        complexity=estimate.complexity + share * (other.complexity - estimate.complexity),
        steadiness=estimate.steadiness + share * (other.steadiness - estimate.steadiness),
        iterations=estimate.iterations + other.iterations,
        converged=estimate.converged and other.converged,
        reason=f"{estimate.reason}; free cameras, {share:.0%} of their depths: {other.reason}",
    )


def credible_depth(estimate: ShapeEstimate, rotations: NDArray[np.float64]) -> ShapeEstimate:
    """Return the shapes with no more depth than the tracks bear out.

    Depth is faded out where it makes the shapes no simpler than the flat tracks are, and bounded
    to twice the extent in the image, beyond which it comes from cameras that hardly turn.

    Parameters
    ----------
    estimate : ShapeEstimate
        With its complexity.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    seen = rotations @ estimate.shapes
    depth, image = (seen[:, 2] ** 2).mean(), (seen[:, :2] ** 2).mean()
    ratio = math.sqrt(depth / max(image, np.finfo(float).tiny))
    keep = faded(estimate.complexity, FLAT)
    keep *= min(1.0, _DEEPEST / max(ratio, np.finfo(float).tiny))
    if keep == 1.0:
        return estimate
    excess = (1.0 - keep) * seen[:, 2]
    shapes = estimate.shapes - rotations[:, 2][:, :, None] * excess[:, None]
    return dataclasses.replace(
        estimate, shapes=shapes, reason=f"{estimate.reason}; {keep:.0%} of the depth was kept"
    )
