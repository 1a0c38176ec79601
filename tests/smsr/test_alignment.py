from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smsr.alignment import orthogonal_factor, procrustes, procrustes_sequence

if TYPE_CHECKING:
    from numpy.typing import NDArray


def random_orthogonal(rng: np.random.Generator, *, reflection: bool) -> NDArray[np.float64]:
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    if (np.linalg.det(q) < 0) != reflection:
        q[0] *= -1
    return q


@given(seed=st.integers(0, 2**32 - 1), reflection=st.booleans())
def test_a_turned_sequence_is_turned_back_exactly(seed: int, reflection: bool) -> None:
    rng = np.random.default_rng(seed)
    shapes = rng.standard_normal((5, 9, 3))
    q = random_orthogonal(rng, reflection=reflection)
    found = procrustes_sequence(shapes, shapes @ q.T)
    np.testing.assert_allclose(found, q, atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)


def test_each_frame_has_its_own_alignment() -> None:
    rng = np.random.default_rng(3)
    shapes = rng.standard_normal((4, 8, 3))
    turns = np.stack([random_orthogonal(rng, reflection=bool(t % 2)) for t in range(4)])
    found = procrustes(shapes, shapes @ turns.transpose(0, 2, 1))
    np.testing.assert_allclose(found, turns, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), [1, -1, 1, -1])


@given(seed=st.integers(0, 2**32 - 1))
def test_no_other_orthogonal_matrix_fits_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.standard_normal((2, 3, 7, 3))
    best = procrustes_sequence(source, target)
    other = random_orthogonal(rng, reflection=bool(seed % 2))
    residual = np.linalg.norm(target - source @ best.T)
    assert residual <= np.linalg.norm(target - source @ other.T) + 1e-12


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_flat_and_coinciding_points_still_give_an_orthogonal_matrix(rank: int) -> None:
    rng = np.random.default_rng(rank)
    points = rng.standard_normal((6, rank)) @ rng.standard_normal((rank, 3))
    q = procrustes(points, points)
    np.testing.assert_allclose(q @ q.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(points @ q.T, points, atol=1e-12)


def test_single_precision_stays_single() -> None:
    assert orthogonal_factor(np.eye(3, dtype=np.float32)).dtype == np.float32
