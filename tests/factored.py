"""Tracks as the cameras are found from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def factored(
    W: NDArray[np.float64], count: int = 30
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the left singular vectors of tracks that count, and their values, the largest 1."""
    left, values, _ = np.linalg.svd(W - W.mean(axis=1, keepdims=True), full_matrices=False)
    count = min(count, int((values > 1e-9 * values[0]).sum()))
    return left[:, :count], values[:count] / values[0]
