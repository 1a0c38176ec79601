"""Published figures of other methods and of the paper itself: its Table 1.

The paper is Ansari, Golyanik and Stricker, "Scalable Dense Monocular Surface Reconstruction", 3DV
2017. All are e3D (Eq. 24, with the Euclidean distance) after one orthogonal alignment of the whole
sequence. Those of dinosaur compare in the camera frame, where its ground truth does not sit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Figure:
    """One published figure.

    Attributes
    ----------
    e3d : float
        The error.
    basis_size : int or None
        K, the number of basis shapes it was reached with, where published.
    """

    e3d: float
    basis_size: int | None = None


def _row(**columns: float | tuple[float, int]) -> dict[str, Figure]:
    return {
        name: Figure(*value) if isinstance(value, tuple) else Figure(value)
        for name, value in columns.items()
    }


PUBLISHED: Final[dict[str, dict[str, Figure]]] = {
    "MP": _row(
        drink=0.4604, pickup=0.4332, stretch=0.8549, yoga=0.8039, dinosaur=0.4894, dance=0.1949
    ),
    "PTA": _row(
        drink=(0.0250, 13),
        pickup=(0.2369, 12),
        stretch=(0.1088, 12),
        yoga=(0.1625, 11),
        dinosaur=(0.6265, 2),
        dance=(0.2958, 5),
    ),
    "CSF1": _row(
        drink=(0.0223, 6),
        pickup=(0.2301, 6),
        stretch=(0.0710, 8),
        yoga=(0.1467, 7),
        dinosaur=(0.6022, 2),
        dance=(0.2694, 2),
    ),
    "CSF2": _row(
        drink=(0.0223, 6),
        pickup=(0.2277, 3),
        stretch=(0.0684, 8),
        yoga=(0.1465, 7),
        dinosaur=(0.6003, 2),
        dance=(0.1957, 7),
    ),
    "BMM": _row(
        drink=(0.0266, 12),
        pickup=(0.1731, 12),
        stretch=(0.1034, 11),
        yoga=(0.1150, 10),
        dinosaur=0.5874,
        dance=(0.1864, 10),
    ),
    "Lee et al.": _row(
        drink=0.8754, pickup=1.0689, stretch=0.9005, yoga=1.2276, dinosaur=0.5079, dance=0.1156
    ),
    "SMSR (paper)": _row(
        drink=0.0287, pickup=0.2020, stretch=0.0783, yoga=0.1493, dinosaur=0.4678, dance=0.6407
    ),
}
"""Figures by method, then by set."""

METHODS: Final[dict[str, str]] = {
    "MP": "Paladini et al., Optimal metric projections for deformable and articulated "
    "structure-from-motion, IJCV 2012",
    "PTA": "Akhter et al., Trajectory space: a dual representation for nonrigid structure from "
    "motion, PAMI 2011",
    "CSF1": "Gotardo and Martinez, Computing smooth time-trajectories for camera and deformable "
    "shape in structure from motion with occlusion, PAMI 2011",
    "CSF2": "Gotardo and Martinez, Non-rigid structure from motion with complementary rank-3 "
    "spaces, CVPR 2011",
    "BMM": "Dai et al., A simple prior-free method for non-rigid structure-from-motion "
    "factorization, IJCV 2014",
    "Lee et al.": "Lee et al., Consensus of non-rigid reconstructions, CVPR 2016",
    "SMSR (paper)": "Ansari et al., Scalable dense monocular surface reconstruction, 3DV 2017",
}
"""What each method is."""


def best_published(dataset: str) -> tuple[str, float] | None:
    """Return the method of the lowest published error on a set and that error, or None."""
    known = [(m, row[dataset].e3d) for m, row in PUBLISHED.items() if dataset in row]
    return min(known, key=lambda pair: pair[1]) if known else None
