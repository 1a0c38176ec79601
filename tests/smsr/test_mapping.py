from __future__ import annotations

import numpy as np
import pytest

from smsr.lifting import Lifting
from smsr.mapping import Operator, Workspace, single_precision_serves


def lifting(frames: int, inside: int, *, cameras: bool = True) -> Lifting:
    rng = np.random.default_rng(0)
    return Lifting(
        outer=rng.standard_normal((frames, 3, inside)),
        inner=rng.standard_normal((inside, 2 * frames)),
        cameras=rng.standard_normal((frames, 2, 3)) if cameras else None,
    )


@pytest.mark.parametrize(("frames", "inside", "factors"), [(5, 9, 1), (80, 9, 2), (80, 160, 1)])
@pytest.mark.parametrize("cameras", [True, False])
def test_the_cheaper_form_is_taken(frames: int, inside: int, factors: int, cameras: bool) -> None:
    A = lifting(frames, inside, cameras=cameras)
    operator = Operator.of(A)
    assert len(operator.factors) == factors
    X = np.random.default_rng(1).standard_normal((2 * frames, 7))
    np.testing.assert_allclose(operator(X), A.matrix() @ X, atol=1e-10)


@pytest.mark.parametrize("frames", [5, 80])
def test_blocks_wider_than_the_buffers(frames: int) -> None:
    A = lifting(frames, 4)
    rng = np.random.default_rng(1)
    W, means = rng.standard_normal((2 * frames, 30_000)), rng.standard_normal(2 * frames)
    space = Workspace(Operator.of(A), 30_000, np.dtype(np.float64))
    assert space.step < 30_000
    space.fill(space.shapes, W, means)
    expected = (A.matrix() @ (W - means[:, None])).reshape(frames, 3, -1).transpose(0, 2, 1)
    np.testing.assert_allclose(space.shapes, expected, atol=1e-10)


@pytest.mark.parametrize("frames", [5, 50, 400])
@pytest.mark.parametrize("gain", [1.0, 10.0, 1e3])
def test_single_precision_is_taken_where_it_serves(frames: int, gain: float) -> None:
    # Strong directions that A turns to nothing, beside a weak one that it amplifies.
    rng = np.random.default_rng(2)
    U = np.linalg.qr(rng.standard_normal((2 * frames, 2 * frames)))[0]
    X = U @ (
        np.r_[np.ones(9), np.full(2 * frames - 9, 1 / gain)][:, None]
        * rng.standard_normal((2 * frames, 2000))
    )
    A = (
        rng.standard_normal((3 * frames, 2 * frames))
        * np.r_[np.full(9, 1 / gain), np.ones(2 * frames - 9)]
        @ U.T
    )
    S = A @ X
    error = np.linalg.norm(A.astype(np.float32) @ X.astype(np.float32) - S) / np.linalg.norm(S)
    serves = single_precision_serves(
        Operator.of(A), np.linalg.norm(X, axis=1), np.linalg.norm(S, axis=1)
    )
    assert serves or gain > 1
    assert not serves or gain < 1e3
    assert not serves or error < 1e-6
