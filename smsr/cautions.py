"""Warnings about inputs and results that a user can act on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from smsr.result import Caution

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from smsr.result import StageReport

_FLAT = 0.01
_RIGID = 0.002
_LOST = 0.01
_LITTLE_ROTATION = math.radians(10.0)


def input_cautions(values: NDArray[np.float64], kept: int) -> list[Caution]:
    """Judge the singular values of the measurements.

    Parameters
    ----------
    values : ndarray of shape (r,)
        Singular values of the centred W, largest first.
    kept : int
        Number of virtual points.
    """
    found = []
    if _part_beyond(values, 2) < _FLAT:
        found.append(
            Caution(
                "near-planar",
                "Two directions explain 99 % of the tracks: the object is nearly flat or hardly "
                "turns against the camera. Its depth is a guess.",
            )
        )
    elif _part_beyond(values, 3) < _RIGID:
        found.append(
            Caution(
                "rigid",
                "Three directions explain the tracks: the object does not deform, or too little "
                "to tell its deformation from noise.",
            )
        )
    if _part_beyond(values, kept) > _LOST:
        found.append(
            Caution(
                "truncated",
                f"{_part_beyond(values, kept):.1%} of the tracks lie outside the {kept} virtual "
                "points that were solved for and have zero depth. Raise virtual_points.",
            )
        )
    return found


def camera_cautions(rotations: NDArray[np.float64]) -> list[Caution]:
    """Judge cameras (T, 3, 3) by how far their viewing directions spread."""
    axes = rotations[:, 2]
    # The farthest from the farthest: nearly the widest angle, without comparing all pairs.
    far = axes[(axes @ axes[0]).argmin()]
    spread = math.acos(min(1.0, max(-1.0, float((axes @ far).min()))))
    if spread >= _LITTLE_ROTATION:
        return []
    return [
        Caution(
            "little-rotation",
            f"The camera turns by {math.degrees(spread):.1f} degrees only around the object, so "
            "depth is uncertain. Tracks over more frames or with more motion would help.",
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


def _part_beyond(values: NDArray[np.float64], count: int) -> float:
    """Return the part of the norm of the measurements beyond the first singular directions."""
    return float(np.linalg.norm(values[count:]) / np.linalg.norm(values))
