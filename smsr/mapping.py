"""The linear map from measurements to shapes, applied to blocks of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smsr.lifting import Lifting

_SINGLE_EPS = float(np.finfo(np.float32).eps)
_SINGLE_ERROR = 1e-6
_PRODUCT_ENTRIES = 512 * 1024


@dataclass(frozen=True, slots=True, eq=False)
class Operator:
    """A as one matrix or as ``outer @ inner + R^T``, in one precision.

    Attributes
    ----------
    factors : tuple of ndarray
        The matrix, or outer (3T, q) and inner (q, 2T).
    cameras : ndarray of shape (T, 2, 3) or None
        R of the term R^T.
    """

    factors: tuple[NDArray[np.floating[Any]], ...]
    cameras: NDArray[np.floating[Any]] | None

    @classmethod
    def of(cls, A: NDArray[np.float64] | Lifting) -> Operator:
        """Take the form of A with the least work for each point."""
        if isinstance(A, np.ndarray):
            return cls((A,), None)
        frames, _, inside = A.outer.shape
        # R^T on each frame is so thin a product that it takes as long as 85 terms of a fat one.
        thin = 85 * frames * (A.cameras is not None)
        if 6 * frames**2 <= 5 * frames * inside + thin:
            return cls((A.matrix(),), None)
        return cls((A.outer.reshape(3 * frames, inside), A.inner), A.cameras)

    def astype(self, dtype: np.dtype[Any]) -> Operator:
        """Return the operator in another precision."""
        cameras = None if self.cameras is None else self.cameras.astype(dtype)
        return Operator(tuple(factor.astype(dtype) for factor in self.factors), cameras)

    def squared(self) -> Operator:
        """Return the operator of squared entries: it adds up terms that are independent."""
        cameras = None if self.cameras is None else self.cameras**2
        return Operator(tuple(factor**2 for factor in self.factors), cameras)

    def __call__(
        self,
        columns: NDArray[np.floating[Any]],
        buffers: Sequence[NDArray[np.floating[Any]]] | None = None,
    ) -> NDArray[np.floating[Any]]:
        """Apply to columns (2T, n); the result (3T, n) lies in the last of the buffers."""
        result = columns
        for position, factor in enumerate(reversed(self.factors)):
            out = None if buffers is None else buffers[position][:, : columns.shape[1]]
            result = np.matmul(factor, result, out=out)
        if self.cameras is not None:
            frames = len(self.cameras)
            planar = self.cameras.transpose(0, 2, 1) @ columns.reshape(frames, 2, -1)
            result.reshape(frames, 3, -1)[...] += planar
        return result


class Workspace:
    """Buffers of one thread, and what it does with them.

    Parameters
    ----------
    operator : Operator
        A.
    size : int
        Most points in a block.
    dtype : numpy.dtype
        Precision of `shapes`.

    Attributes
    ----------
    shapes : ndarray of shape (T, size, 3)
        A place for the shapes of one block.
    """

    def __init__(self, operator: Operator, size: int, dtype: np.dtype[Any]) -> None:
        precision = operator.factors[0].dtype
        rows, columns = operator.factors[0].shape[0], operator.factors[-1].shape[1]
        self.operator = operator
        self.step = min(size, max(256, _PRODUCT_ENTRIES // (rows + columns)))
        self.centred = np.empty((columns, self.step), precision)
        self.products = [
            np.empty((len(factor), self.step), precision) for factor in reversed(operator.factors)
        ]
        self.shapes = np.empty((rows // 3, size, 3), dtype)

    def fill(
        self,
        target: NDArray[np.floating[Any]],
        block: NDArray[Any],
        means: NDArray[np.float64],
    ) -> None:
        """Put the shapes of a block (2T, n) into the target (T, n, 3)."""
        frames = len(target)
        for start in range(0, block.shape[1], self.step):
            columns = block[:, start : start + self.step]
            centred = self.centred[:, : columns.shape[1]]
            # The difference is taken in double precision whatever it is stored in.
            np.subtract(columns, means[:, None], out=centred, casting="same_kind")
            axes = self.operator(centred, self.products).reshape(frames, 3, -1).transpose(1, 0, 2)
            # Three strided copies: several times as fast as one assignment of the transpose.
            np.stack(tuple(axes), axis=-1, out=target[:, start : start + self.step])


def single_precision_serves(
    operator: Operator, rows: NDArray[np.float64], shapes: NDArray[np.float64]
) -> bool:
    """Tell whether a product in single precision keeps the shapes to 1e-6 of their norm.

    The terms of the sums may be far larger than the sums, where A undoes a direction in which W
    is weak. Rounding is about 3 eps of the root of the sum of squared terms, for up to a thousand
    terms.

    Parameters
    ----------
    operator : Operator
        A.
    rows : ndarray of shape (2T,)
        Norm of each row of the centred W.
    shapes : ndarray of shape (3T,)
        Norm of each row of S.
    """
    terms = np.sqrt(operator.squared()(rows[:, None] ** 2).sum())
    return bool(3 * _SINGLE_EPS * terms <= _SINGLE_ERROR * np.linalg.norm(shapes))
