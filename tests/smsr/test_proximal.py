from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from smsr.proximal import (
    eigenvalue_threshold,
    nearest_semidefinite,
    singular_value_threshold,
    singular_values,
)

cp: Any = pytest.importorskip("cvxpy")

entries = st.floats(-10, 10, allow_subnormal=False)
sizes = st.tuples(st.integers(1, 7), st.integers(1, 7))
matrices = sizes.flatmap(lambda size: arrays(np.float64, size, elements=entries))
squares = st.integers(1, 6).flatmap(lambda n: arrays(np.float64, (n, n), elements=entries))


def random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


@given(matrices, st.floats(0, 20))
def test_thresholding_shrinks_every_singular_value(Y: np.ndarray, threshold: float) -> None:
    X, values = singular_value_threshold(Y, threshold)
    U, sigma, Vt = np.linalg.svd(Y, full_matrices=False)
    shrunk = np.maximum(sigma - threshold, 0.0)
    # Values near the root of the machine precision are lost in the Gram matrix.
    tolerance = 1e-6 * max(1.0, sigma[0])
    np.testing.assert_allclose(X, (U * shrunk) @ Vt, atol=tolerance)
    np.testing.assert_allclose(values, shrunk, atol=tolerance)


@given(matrices)
def test_singular_values_are_those_of_the_svd(Y: np.ndarray) -> None:
    sigma = np.linalg.svd(Y, compute_uv=False)
    np.testing.assert_allclose(singular_values(Y), sigma, atol=1e-6 * max(1.0, sigma[0]))


@pytest.mark.parametrize("shape", [(5, 8), (8, 5)])
def test_thresholding_minimises_the_nuclear_norm_problem(shape: tuple[int, int]) -> None:
    Y = random(*shape)
    variable = cp.Variable(shape)
    objective = 1.3 * cp.normNuc(variable) + 0.5 * cp.sum_squares(variable - Y)
    cp.Problem(cp.Minimize(objective)).solve(solver=cp.SCS, eps=1e-9)
    np.testing.assert_allclose(singular_value_threshold(Y, 1.3)[0], variable.value, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_weights_that_grow_as_singular_values_fall_give_the_weighted_minimum(seed: int) -> None:
    Y = random(6, 9, seed=seed)
    weights = np.linspace(0.2, 2.5, 6)

    def cost(X: np.ndarray) -> float:
        penalty = weights @ np.linalg.svd(X, compute_uv=False)
        return float(penalty + 0.5 * ((X - Y) ** 2).sum())

    X, _ = singular_value_threshold(Y, weights)
    best = cost(X)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 1e-2, 1e-1, 1.0):
        for _ in range(50):
            assert cost(X + size * rng.standard_normal(X.shape)) >= best


@settings(max_examples=50)
@given(st.integers(0, 1000), st.floats(0.01, 3))
def test_thresholding_is_firmly_nonexpansive(seed: int, threshold: float) -> None:
    A, B = random(5, 7, seed=seed), random(5, 7, seed=seed + 1)
    X, _ = singular_value_threshold(A, threshold)
    Z, _ = singular_value_threshold(B, threshold)
    assert ((X - Z) ** 2).sum() <= ((X - Z) * (A - B)).sum() + 1e-9


def test_thresholding_does_not_change_its_input() -> None:
    Y = random(4, 6)
    before = Y.copy()
    singular_value_threshold(Y, 0.5)
    np.testing.assert_array_equal(Y, before)


@pytest.mark.parametrize("threshold", [0.0, 0.7])
def test_eigenvalue_thresholding_minimises_the_trace_problem(threshold: float) -> None:
    F = random(6, 6)
    F = F + F.T
    variable = cp.Variable((6, 6), PSD=True)
    objective = threshold * cp.trace(variable) + 0.5 * cp.sum_squares(variable - F)
    cp.Problem(cp.Minimize(objective)).solve(solver=cp.SCS, eps=1e-9)
    np.testing.assert_allclose(eigenvalue_threshold(F, threshold), variable.value, atol=1e-5)


@given(squares, st.integers(1, 6))
def test_nearest_semidefinite_keeps_the_leading_eigenvalues(A: np.ndarray, rank: int) -> None:
    F = A + A.T
    nearest = nearest_semidefinite(F, rank)
    values = np.linalg.eigvalsh(F)[::-1]
    kept = np.maximum(values[:rank], 0.0)
    tolerance = 1e-9 * max(1.0, np.abs(values).max())
    found = np.linalg.eigvalsh(nearest)[::-1]
    np.testing.assert_allclose(found[: len(kept)], kept, atol=tolerance)
    np.testing.assert_allclose(found[len(kept) :], 0.0, atol=tolerance)
    # Eckart and Young: the distance is what was left out.
    left_out = (values**2).sum() - (kept**2).sum()
    assert ((nearest - F) ** 2).sum() == pytest.approx(left_out, abs=1e-6 * (1 + left_out))
