"""Which shapes to take: simple ones, refined to likely depths as far as these can be believed."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from smsr.progress import ignore, part_of
from smsr.shapes.credibility import (
    DOUBTFUL,
    credible_depth,
    trust,
    with_deep_shapes,
    with_mean_depth,
)
from smsr.shapes.estimate import turned_to
from smsr.shapes.likely import with_likely_depth
from smsr.shapes.low_rank import low_rank_shapes, reweighted_shapes
from smsr.shapes.paper import published_shapes
from smsr.shapes.rigid import rigid_shapes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from smsr.options import Options
    from smsr.progress import StageHook
    from smsr.shapes.estimate import ShapeEstimate


_ROUGHLY = 5.0  # times the tolerance, for the start of a refinement
_LITTLE = 0.25  # part of the depths below which refining it is not worth the time


def estimate_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    options: Options,
    *,
    camera_model: str = "relaxed",
    coherent: bool = False,
    simpler: NDArray[np.float64] | None = None,
    simpler_share: float = 0.0,
    adjustable: NDArray[np.float64] | None = None,
    noise: float = 0.0,
    points: NDArray[np.float64] | None = None,
    hook: StageHook = ignore,
) -> ShapeEstimate:
    """Find the shapes of all frames in the way that the options ask for.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ..., of unit spectral norm.
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    options : Options
        Resolved by `smsr.options.resolve`.
    camera_model : str
        How the cameras were found: 'rigid' says that the object is.
    coherent : bool
        See `reweighted_shapes`.
    simpler : ndarray of shape (T, 3, 3), optional
    simpler_share : float
    adjustable : ndarray of shape (k, T, 3), optional
        See `smsr.cameras.CameraEstimate`.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.
    points : ndarray of shape (N, n), optional
        Some real points in terms of the columns of W, where these are virtual ones.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    share = 0.0 if simpler is None else simpler_share * trust(noise)
    blended = options.shape_method == "auto" and share < 1.0
    if simpler is not None and simpler_share == 1.0 and not blended:
        found = estimate_shapes(
            measurements,
            simpler,
            options,
            camera_model=camera_model,
            coherent=coherent,
            noise=noise,
            points=points,
            hook=hook,
        )
        return dataclasses.replace(found, shapes=turned_to(found.shapes, simpler, rotations))
    limits: dict[str, Any] = {
        "max_iterations": options.shape_iterations,
        "tolerance": options.shape_tolerance,
        "hook": hook,
    }
    if options.shape_method == "paper":
        return published_shapes(
            measurements,
            rotations,
            penalty=options.penalty,
            penalty_growth=options.penalty_growth,
            **limits,
        )
    if options.shape_method == "nuclear":
        return low_rank_shapes(measurements, rotations, **limits)
    if options.shape_method == "auto" and camera_model == "rigid":
        return rigid_shapes(measurements, rotations)
    limits["motion_weight"] = options.motion_weight
    limits["coherent"] = coherent
    if options.shape_method == "reweighted":
        return reweighted_shapes(measurements, rotations, **limits)

    def solve(
        cameras: NDArray[np.float64],
        weight: float,
        adjustable: NDArray[np.float64] | None = None,
    ) -> ShapeEstimate:
        return believable_shapes(
            measurements,
            cameras,
            weight=weight,
            adjustable=adjustable,
            noise=noise,
            points=points,
            **limits,
        )

    found = solve(rotations, 1.0 - share, adjustable)
    if simpler is None or share == 0.0:
        return found
    if found.rotations is not None:
        rotations = found.rotations
    return with_mean_depth(found, rotations, solve(simpler, share), simpler, share)


def believable_shapes(
    measurements: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    weight: float = 1.0,
    adjustable: NDArray[np.float64] | None = None,
    noise: float = 0.0,
    points: NDArray[np.float64] | None = None,
    max_iterations: int = 1000,
    tolerance: float = 1e-4,
    hook: StageHook = ignore,
    **problem: Any,
) -> ShapeEstimate:
    """Find the shapes that some cameras see, with as much depth as can be believed.

    They are simple ones (`reweighted_shapes`), refined to likely depths (`with_likely_depth`), with
    less depth or more where that is doubtful (`credible_depth`, `with_deep_shapes`).

    Parameters
    ----------
    measurements, rotations, max_iterations, tolerance, hook
        As for `low_rank_shapes`.
    weight : float
        Part of the result that the shapes will make: refining a little is not worth the time.
    adjustable, noise, points
        See `estimate_shapes`.
    **problem
        `motion_weight` and `coherent` of `reweighted_shapes`.
    """

    def enter(
        cameras: NDArray[np.float64], adjustable: NDArray[np.float64] | None, *, deep: bool
    ) -> ShapeEstimate:
        refined = weight >= _LITTLE
        first, second = part_of(hook, 0.0, 0.4), part_of(hook, 0.4, 1.0)
        found = reweighted_shapes(
            measurements,
            cameras,
            deep=deep,
            max_iterations=max_iterations,
            # The start of a refinement need not be so exact: five times here move the end by 0.1 %.
            tolerance=_ROUGHLY * tolerance if refined else tolerance,
            hook=first if refined else hook,
            **problem,
        )
        if not refined:
            return found
        return with_likely_depth(
            found,
            cameras,
            noise,
            points=points,
            adjustable=adjustable,
            doubtful=deep,
            max_iterations=max_iterations,
            hook=second,
        )

    found = enter(rotations, adjustable, deep=False)
    if found.rotations is not None:
        rotations = found.rotations
    found = credible_depth(found, rotations)
    if found.complexity < DOUBTFUL or trust(noise) == 0.0:
        return found
    return with_deep_shapes(found, enter(rotations, None, deep=True), rotations, noise)
