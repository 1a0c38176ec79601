"""Warnings about inputs and results that a user can act on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.cameras.rigid import RIGID_REST, part_beyond
from smsr.cameras.trial import LOOSE
from smsr.result import Caution
from smsr.rotations import spread_of_views

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from smsr.cameras import CameraEstimate
    from smsr.noise import VirtualPoints
    from smsr.result import StageReport

_FLAT = 0.01
_LOST = 0.01
_NOISY = 0.02
_UNDECIDED = 10.0  # degrees
_WEAK_DEPTH = 0.75
_STEADY_ENOUGH = 0.5
_GROWING = 1.25
_GROWING_IN_DOUBT = 1.5
_LITTLE_ROTATION = math.radians(10.0)
_SEEN_AROUND = math.radians(150.0)
_KEEP_REVERSALS = LOOSE | {"flat", "shaken"}


def input_cautions(
    values: NDArray[np.float64],
    solved: VirtualPoints,
    points: int,
    *,
    flat: bool = False,
    rigid: bool = True,
) -> list[Caution]:
    """Judge the singular values of the measurements.

    Parameters
    ----------
    values : ndarray of shape (r,)
        Singular values of the centred W, largest first.
    solved : VirtualPoints
        What of them was solved for.
    points : int
        N.
    flat : bool
        Whether the object was seen to be flat but for its deformation: then few directions are no
        reason to doubt its depth.
    rigid : bool
        Whether the object may be rigid: no cameras that suppose so were refused, nor is it flat.
    """
    found = []
    rows, kept = len(solved.left), len(solved.values)
    if part_beyond(values, 2) < _FLAT and not flat:
        found.append(
            Caution(
                "near-planar",
                "Two directions explain 99 % of the tracks: the object is nearly flat or hardly "
                "turns against the camera. Its depth is a guess.",
            )
        )
    elif rigid and part_beyond(values, 3) < RIGID_REST:
        found.append(
            Caution(
                "rigid",
                "Three directions explain the tracks: the object does not deform, or too little "
                "to tell its deformation from noise.",
            )
        )
    spread = float(np.linalg.norm(values)) / math.sqrt(rows * points)
    if solved.noise > _NOISY * spread:
        found.append(
            Caution(
                "noisy",
                f"The tracks carry noise of {solved.noise:.3g}, {solved.noise / spread:.0%} of "
                "their spread. It was taken off, and fine deformations with it. If it is less, "
                "give its standard deviation as the option noise.",
            )
        )
    elif solved.noise == 0.0 and part_beyond(values, kept) > _LOST:
        found.append(
            Caution(
                "truncated",
                f"{part_beyond(values, kept):.1%} of the tracks lie outside the {kept} virtual "
                "points that were solved for and have zero depth. Raise virtual_points.",
            )
        )
    return found


def gap_cautions(missing: float, rejected: float) -> list[Caution]:
    """Tell what parts of the positions were filled in."""
    found = []
    if missing > 0.0:
        found.append(
            Caution(
                "missing",
                f"{missing:.1%} of the positions were not seen and were filled in from the rest; "
                "shapes are less certain there.",
            )
        )
    if rejected > 0.0:
        found.append(
            Caution(
                "outliers",
                f"{rejected:.2%} of the positions were taken as gross errors and filled in anew. "
                "With outliers='keep' they are left as they are.",
            )
        )
    return found


def camera_cautions(rotations: NDArray[np.float64], estimate: CameraEstimate) -> list[Caution]:
    """Judge cameras (T, 3, 3) by the spread of viewing directions and how well they are decided."""
    found = []
    spread = spread_of_views(rotations)
    if spread < _LITTLE_ROTATION:
        found.append(
            Caution(
                "little-rotation",
                f"The camera turns by {math.degrees(spread):.1f} degrees only around the object, "
                "so depth is uncertain. Tracks over more frames or with more motion would help.",
            )
        )
    if not estimate.criteria.get("width_is_determined", 1.0) and spread < _SEEN_AROUND:
        found.append(
            Caution(
                "assumed-width",
                "The object is flat but for its deformation, and the camera turns by "
                f"{math.degrees(spread):.0f} degrees about much the same axis. The tracks hardly "
                "tell how long it is across: it was taken to be seen from the front once. If it "
                "was not, it is longer, and tilted more.",
            )
        )
    views = round(estimate.criteria.get("frontal_views", 0.0))
    if estimate.model in _KEEP_REVERSALS and views > 0:
        found.append(
            Caution(
                "reversals",
                "The object is flat but for its deformation, and it is seen from the front "
                f"{'once' if views == 1 else f'{views} times'}. The tracks hardly tell which of "
                "its sides tilts away after that: it may be mirrored in depth from there on.",
            )
        )
    disagreement = estimate.criteria.get("disagreement", 0.0)
    if estimate.model in {"relaxed", "shaken"} and disagreement > _UNDECIDED:
        found.append(
            Caution(
                "cameras-undecided",
                f"Cameras that differ by {disagreement:.0f} degrees explain the tracks about "
                "equally well, and no simple path of the camera decides between them. Shapes may "
                "turn slowly against each other; compare them in the camera frame.",
            )
        )
    return found


def depth_cautions(complexity: float, steadiness: float) -> list[Caution]:
    """Judge how much simpler and steadier depth makes the shapes.

    Parameters
    ----------
    complexity : float
        See `smsr.shapes.problem.DepthProblem.complexity`.
    steadiness : float
        See `smsr.shapes.credibility.steadiness`.
    """
    if complexity <= _WEAK_DEPTH or steadiness > _STEADY_ENOUGH:
        return []
    return [
        Caution(
            "weak-depth",
            f"With depth the shapes are only {max(0.0, 1.0 - complexity):.0%} simpler than the "
            "flat tracks, so the tracks say little about depth. It was reduced where they say "
            "nothing.",
        )
    ]


def size_cautions(growth: float, complexity: float) -> list[Caution]:
    """Judge by what factor the object grows.

    Parameters
    ----------
    growth : float
        See `smsr.scales.growth`.
    complexity : float
        See `smsr.shapes.problem.DepthProblem.complexity`: where depth is a guess, so are distances.
    """
    if growth <= (_GROWING if complexity <= _WEAK_DEPTH else _GROWING_IN_DOUBT):
        return []
    return [
        Caution(
            "size-changes",
            f"Distances between points grow or shrink together, by a factor of {growth:.2g}. If "
            "the object came nearer or went away, or the camera zoomed, take "
            "camera_scale='varying'.",
        )
    ]


def convergence_cautions(stages: Iterable[StageReport]) -> list[Caution]:
    """Name the stages that stopped at their limit of iterations."""
    return [
        Caution(
            "not-converged",
            f"The stage {stage.name!r} stopped after {stage.iterations} iterations without "
            f"meeting its tolerance ({stage.reason}).",
        )
        for stage in stages
        if not stage.converged
    ]
