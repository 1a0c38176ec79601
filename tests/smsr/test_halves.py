"""How sure cameras are, and a uniform turn where they are not sure enough to speak against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr import evaluate, reconstruct
from smsr.benchmark.camera_paths import PATHS, noisy_tracks, sway
from smsr.cameras.halves import disagreement_of_halves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

FRAMES, POINTS = 120, 40


def deforming(seed: int) -> Array:
    """Shapes (T, 3, N) that change smoothly by two basis shapes."""
    rng = np.random.default_rng(seed)
    basis = rng.standard_normal((3, 3, POINTS))
    basis -= basis.mean(axis=2, keepdims=True)
    time = (np.arange(FRAMES) + 0.5) / FRAMES
    waves = [0.3 * np.cos(2.0 * np.pi * k * time + rng.uniform(0.0, 6.0)) for k in (1, 2)]
    shapes: Array = np.einsum("kt,kin->tin", [np.ones(FRAMES), *waves], basis)
    return shapes


def seen(path: str, noise: float, seed: int) -> tuple[Array, Array]:
    """Return tracks (2T, N) along a path of the family, and the true shapes."""
    rng = np.random.default_rng(seed)
    rotations = PATHS[path](np.arange(FRAMES, dtype=np.float64), rng) @ sway(np.array([20.0]), 30.0)
    shapes = deforming(seed)
    return noisy_tracks(rotations, shapes, noise, rng), shapes


def halves(measurements: Array) -> float:
    centred = measurements - measurements.mean(axis=1, keepdims=True)
    return disagreement_of_halves(centred, np.linalg.svd(centred, full_matrices=False)[2])


class TestDisagreement:
    def test_it_grows_with_the_noise(self) -> None:
        angles = [halves(seen("fast", noise, 1)[0]) for noise in (0.0, 0.02, 0.1)]
        assert angles == sorted(angles)
        assert angles[2] > 3.0 * angles[0]

    def test_order_units_and_rotation_of_the_image_do_not_matter(self) -> None:
        tracks = seen("slow pan", 0.02, 1)[0]
        turn = np.array([[0.8, -0.6], [0.6, 0.8]])
        order = np.random.default_rng(0).permutation(POINTS)
        turned = 1e3 * (turn @ tracks.reshape(FRAMES, 2, POINTS)).reshape(tracks.shape)[:, order]
        assert halves(turned) == pytest.approx(halves(tracks), rel=1e-6)

    def test_points_that_coincide_say_nothing(self) -> None:
        tracks = np.tile(np.random.default_rng(0).standard_normal((28, 1)), (1, 12))
        tracks[:, 0] += 1.0
        assert halves(tracks) == 0.0
        assert np.isfinite(reconstruct(tracks).shapes).all()


class TestUniformTurn:
    @pytest.mark.parametrize("seed", [1, 2])
    def test_it_is_taken_where_free_cameras_are_no_surer(self, seed: int) -> None:
        tracks, shapes = seen("slow pan", 0.05, seed)
        result, free = reconstruct(tracks), reconstruct(tracks, camera_model="relaxed")
        assert result.diagnostics.camera_model == "uniform"
        assert "halves of the points disagree" in result.diagnostics.camera_reason
        errors = [evaluate(shapes, each).e3d for each in (result, free)]
        assert errors[0] < 0.7 * errors[1]

    def test_it_is_not_where_shapes_would_be_more_complex(self) -> None:
        result = reconstruct(seen("smooth", 0.05, 1)[0])
        assert result.diagnostics.camera_criteria["halves_disagreement"] > 10.0
        assert result.diagnostics.camera_model == "relaxed"

    def test_few_points_are_not_halved(self) -> None:
        tracks = seen("slow pan", 0.05, 1)[0][:, :11]
        assert "halves_disagreement" not in reconstruct(tracks).diagnostics.camera_criteria

    def test_simple_shapes_are_not_doubted(self, monkeypatch: pytest.MonkeyPatch) -> None:
        tracks = seen("smooth", 0.0, 3)[0]
        result = reconstruct(tracks)
        assert result.diagnostics.camera_model == "relaxed"
        assert "halves_disagreement" not in result.diagnostics.camera_criteria
        monkeypatch.setattr("smsr.cameras.selection._UNSURE", 0.0)
        assert "halves_disagreement" in reconstruct(tracks).diagnostics.camera_criteria
