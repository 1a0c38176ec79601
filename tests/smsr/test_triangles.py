from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smsr import triangles
from smsr.triangles import NotUsableError, Triangle, merged, within

if TYPE_CHECKING:
    from numpy.typing import NDArray


def points(width: int, count: int, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    mixing = rng.standard_normal((width, width))
    return mixing @ rng.standard_normal((width, count)) + rng.standard_normal((width, 1))


def triangle_of(block: NDArray[np.float64], shift: NDArray[np.float64]) -> Triangle:
    """Reduce a block of points that stands alone."""
    return triangles.triangle_of(slice(0, block.shape[1]), block, shift=shift, sampled=np.arange(0))


def assert_stands_for(triangle: Triangle, X: NDArray[np.float64], tolerance: float) -> None:
    """Check count, mean and every singular value to a relative tolerance."""
    centred = X - X.mean(axis=1, keepdims=True)
    assert triangle.count == X.shape[1]
    np.testing.assert_allclose(
        triangle.mean, X.mean(axis=1), rtol=0, atol=1e-12 * float(np.abs(X).max())
    )
    k = min(triangle.rows.shape[0], *X.shape)
    np.testing.assert_allclose(
        np.linalg.svd(triangle.rows, compute_uv=False)[:k],
        np.linalg.svd(centred, compute_uv=False)[:k],
        rtol=tolerance,
        atol=1e-13 * float(np.linalg.norm(centred)),
    )
    gram = centred @ centred.T
    np.testing.assert_allclose(
        triangle.rows.T @ triangle.rows, gram, rtol=0, atol=1e-12 * float(np.linalg.norm(gram))
    )


@settings(max_examples=50, deadline=None)
@given(width=st.integers(2, 12), count=st.integers(1, 60), cuts=st.sets(st.integers(1, 59)))
def test_joined_parts_stand_for_the_whole(width: int, count: int, cuts: set[int]) -> None:
    X = points(width, count)
    inside = sorted(cut for cut in cuts if cut < count)
    shift = X[:, 0]
    parts = [triangle_of(part, shift) for part in np.split(X, inside, axis=1)]
    assert_stands_for(merged(parts), X - shift[:, None], 1e-9)


@pytest.mark.parametrize("cuts", [(), (1, 2, 40), (7, 29)])
@pytest.mark.parametrize("numbers", [[], [0, 59], [2, 3, 7, 28, 29, 30]])
def test_a_sample_is_kept_however_blocks_are_cut(cuts: tuple[int, ...], numbers: list[int]) -> None:
    X = points(4, 60)
    shift = X[:, 0]
    edges = [0, *cuts, 60]
    sampled = np.array(numbers, np.intp)
    parts = [
        triangles.triangle_of(slice(start, stop), X[:, start:stop], shift=shift, sampled=sampled)
        for start, stop in itertools.pairwise(edges)
    ]
    np.testing.assert_array_equal(merged(parts).sample, X[:, sampled] - shift[:, None])
    np.testing.assert_array_equal(within(slice(7, 29), np.array([2, 7, 28, 29])), [0, 21])


@pytest.mark.parametrize("count", [5, 12, 13, 767, 768, 50_000])
def test_a_block(count: int) -> None:
    X = points(12, count)
    triangle = triangle_of(X, np.zeros(12))
    assert len(triangle.rows) == min(count, 12)
    assert_stands_for(triangle, X, 1e-10)


def test_a_sample_that_misses_a_direction() -> None:
    # The sampled points move a millionth as much in one direction as the others do. A Gram
    # matrix on their axes would have 1e-4 of error; the block is factored the safe way instead.
    width, count = 10, 6400
    X = points(width, count, seed=1)
    direction = np.linalg.qr(np.random.default_rng(2).standard_normal((width, 1)))[0]
    along = direction @ (direction.T @ X)
    X -= along
    weak = np.zeros(count, bool)
    weak[:: count // (4 * width)] = True
    X += along * np.where(weak, 1e-9, 1.0)
    scaled = X * np.logspace(0, -6, width)[:, None]
    assert triangles._triangle_by_whitening(scaled, np.zeros(width)) is None
    assert_stands_for(triangle_of(scaled, np.zeros(width)), scaled, 1e-9)


@pytest.mark.parametrize("count", [40, 6400])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_not_finite(count: int, bad: float) -> None:
    X = points(10, count)
    X[3, 7] = bad
    with pytest.raises(NotUsableError):
        triangle_of(X, np.zeros(10))
