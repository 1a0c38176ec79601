"""One shape for all frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr.shapes.estimate import ShapeEstimate, planar_shapes

if TYPE_CHECKING:
    from numpy.typing import NDArray


def rigid_shapes(
    measurements: NDArray[np.float64], rotations: NDArray[np.float64]
) -> ShapeEstimate:
    """Return one and the same depth for all frames: the least-squares fit of a rigid shape.

    Parameters
    ----------
    measurements, rotations
        As for `smsr.shapes.low_rank.low_rank_shapes`.

    Returns
    -------
    ShapeEstimate
        What the rigid shape does not explain of W stays in the image plane, so W = R S holds.
    """
    rigid = np.linalg.lstsq(rotations[:, :2].reshape(-1, 3), measurements, rcond=None)[0]
    axis = rotations[:, 2]
    return ShapeEstimate(
        shapes=planar_shapes(measurements, rotations) + axis[:, :, None] * (axis @ rigid)[:, None],
        iterations=0,
        converged=True,
        reason="one shape for all frames",
    )
