"""What every way of finding shapes returns, and what is read off it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smsr.proximal import singular_values

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class ShapeEstimate:
    """Shapes of all frames.

    Attributes
    ----------
    shapes : ndarray of shape (T, 3, N)
        S, with ``R_t S_t = W_t`` to rounding.
    iterations : int
        Of the solver, all rounds together.
    converged : bool
        Whether the last round met its tolerance; refinement to likely depths is not asked.
    reason : str
        Why it stopped, for a person.
    residuals : tuple of float
        Stopping residual at each iteration.
    complexity : float
        See `smsr.shapes.problem.DepthProblem.complexity`; 0 where it was not measured.
    flicker : float
        See `smsr.shapes.low_rank.flicker`; 0 where it was not measured.
    steadiness : float
        Of the likely shapes that take part in these, see `smsr.shapes.credibility.steadiness`, as
        far as noise lets it count; 0 where it was not measured.
    rotations : ndarray of shape (T, 3, 3), optional
        The cameras, where they were adjusted with the shapes.
    """

    shapes: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
    residuals: tuple[float, ...] = ()
    complexity: float = 0.0
    flicker: float = 0.0
    steadiness: float = 0.0
    rotations: NDArray[np.float64] | None = None


def planar_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shapes (T, 3, N) of zero depth, R^+ W.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, rows u1, v1, u2, ...
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.
    """
    frames = len(rotations)
    planar: NDArray[np.float64] = rotations[:, :2].transpose(0, 2, 1) @ measurements.reshape(
        frames, 2, -1
    )
    return planar


def turned_to(
    shapes: NDArray[np.float64], others: NDArray[np.float64], rotations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return shapes (T, 3, N) so that cameras see them as they were seen by others (T, 3, 3)."""
    turned: NDArray[np.float64] = rotations.transpose(0, 2, 1) @ (others @ shapes)
    return turned


def basis_size_of(shapes: NDArray[np.float64], tolerance: float = 0.01) -> int:
    """Return how many basis shapes span shapes (T, 3, N) up to a part of their norm.

    Parameters
    ----------
    shapes : ndarray of shape (T, 3, N)
        S.
    tolerance : float
        Part of ||S#||_F that may be left out.
    """
    squares = singular_values(shapes.reshape(len(shapes), -1)) ** 2
    rest = np.cumsum(squares[::-1])[::-1]
    return max(1, int((rest > tolerance**2 * rest[0]).sum()))
