"""Bars for the error on real sequences. One setting serves them all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.io

from smsr import evaluate, reconstruct
from smsr.benchmark.camera_paths import PATHS, errors, noisy_tracks, sway, true_shapes

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

pytestmark = pytest.mark.data

SPARSE = {
    "drink": 0.0055,
    "pickup": 0.02,
    "stretch": 0.032,
    "yoga": 0.018,
    "dance": 0.08,
    "dinosaur": 0.235,
}
DENSE = {"facecap": 0.015, "samba": 0.10}


def sparse_set(folder: Path, name: str) -> tuple[Array, Array]:
    """Return W (2T, N) and the true shapes (T, N, 3)."""
    content = scipy.io.loadmat(folder / "sparse" / f"{name}.mat")
    truth = content["GT"][0, 0]["shape3D"] if name == "dinosaur" else content["S"]
    W = np.asarray(content["W"], dtype=np.float64)
    shapes = np.asarray(truth, dtype=np.float64).reshape(len(W) // 2, 3, -1)
    return W, shapes.transpose(0, 2, 1)


@pytest.mark.parametrize(("name", "bar"), SPARSE.items())
def test_sparse_sets(evaluation_data: Path, name: str, bar: float) -> None:
    W, truth = sparse_set(evaluation_data, name)
    result = reconstruct(W)
    assert result.diagnostics.converged
    frame = "camera" if name == "dance" else "object"
    assert evaluate(truth, result, frame=frame).e3d <= bar  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "bar"), DENSE.items())
def test_dense_sets(evaluation_data: Path, name: str, bar: float) -> None:
    with np.load(evaluation_data / "dense" / f"{name}.npz") as content:
        W, S = content["W"], content["S"]
    truth = S.reshape(len(W) // 2, 3, -1).transpose(0, 2, 1)
    result = reconstruct(W)
    assert result.diagnostics.converged
    assert evaluate(truth, result, frame="camera").e3d <= bar


@pytest.mark.parametrize("name", ["pickup", "dance"])
def test_noise_passes_on_in_part_only(evaluation_data: Path, name: str) -> None:
    W, truth = sparse_set(evaluation_data, name)
    sigma = 0.02 * np.abs(W - W.mean(axis=1, keepdims=True)).max()
    W = W + sigma * np.random.default_rng(0).standard_normal(W.shape)
    frame = "camera" if name == "dance" else "object"
    default, kept = (
        evaluate(truth, reconstruct(W, noise=noise), frame=frame).e3d  # type: ignore[arg-type]
        for noise in (None, 0.0)
    )
    assert default < 0.9 * kept


@pytest.mark.parametrize(("name", "bar"), [("drink", 0.12), ("yoga", 0.16), ("dance", 0.25)])
def test_published_method(evaluation_data: Path, name: str, bar: float) -> None:
    W, truth = sparse_set(evaluation_data, name)
    frame = "camera" if name == "dance" else "object"
    result = reconstruct(W, preset="paper")
    assert evaluate(truth, result, frame=frame).e3d <= bar  # type: ignore[arg-type]


@pytest.mark.parametrize(("path", "noise"), [("slow", 0.005), ("eased", 0.02)])
def test_a_slab_is_not_taken_for_a_sheet(evaluation_data: Path, path: str, noise: float) -> None:
    """The dinosaur is three times as wide as deep."""
    true = true_shapes(evaluation_data, "dinosaur")
    rng = np.random.default_rng(1)
    time = 1.5 * np.arange(len(true), dtype=np.float64)
    rotations = PATHS[path](time, rng) @ sway(np.array([-20.0]), 10.0)
    result = reconstruct(noisy_tracks(rotations, true, noise, rng))
    assert result.diagnostics.camera_model != "flat"
    found = errors(result.cameras, result.shapes.transpose(0, 2, 1), rotations, true)
    assert found.camera < 0.2
