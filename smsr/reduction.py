"""What the solver works on: the measurements as a few virtual points of unit spectral norm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smsr.noise import virtual_points

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from smsr.noise import VirtualPoints
    from smsr.options import Options
    from smsr.rowspace import RowSpace


@dataclass(frozen=True, slots=True, eq=False)
class Reduction:
    """Measurements reduced to virtual points; penalties of the solver have a fixed scale.

    Attributes
    ----------
    points : VirtualPoints
        In the units of W.
    unit : float
        Spectral norm of W, less noise.
    values : ndarray of shape (q,)
        Singular values of the virtual points over `unit`, largest first.
    noise : float
        Standard deviation of the noise that was taken off, as a part of the tracks' spread.
    neglected : float
        The same of noise that was left in, see `smsr.noise.VirtualPoints`.
    sample : ndarray of shape (q, s)
        Some real points as combinations of the virtual ones.
    tracks : ndarray of shape (2T, s)
        The same points as they were measured, centred, over `unit`.
    """

    points: VirtualPoints
    unit: float
    values: NDArray[np.float64]
    noise: float
    neglected: float
    sample: NDArray[np.float64]
    tracks: NDArray[np.float64]

    @classmethod
    def of(cls, space: RowSpace, options: Options) -> Reduction:
        """Reduce factored measurements as the options ask for."""
        points = virtual_points(
            space.left, space.singular_values, space.points, options.noise
        ).leading(options.virtual_points)
        unit = float(points.values[0])
        return cls(
            points=points,
            unit=unit,
            values=points.values / unit,
            noise=points.noise / space.spread,
            neglected=points.neglected / space.spread,
            sample=points.coordinates @ space.sample,
            tracks=space.sample / unit,
        )

    @property
    def left(self) -> NDArray[np.float64]:
        """U (2T, q), the left singular vectors of the virtual points."""
        return self.points.left

    @property
    def measurements(self) -> NDArray[np.float64]:
        """The virtual points (2T, q), of unit spectral norm."""
        product: NDArray[np.float64] = self.left * self.values
        return product
