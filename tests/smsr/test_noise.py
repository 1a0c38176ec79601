from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr import evaluate, reconstruct
from smsr.errors import InvalidOption
from smsr.noise import (
    estimate_noise,
    marchenko_pastur_quantiles,
    smooth_in_time,
    virtual_points,
)
from smsr.synthetic import make_low_rank

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def factors(W: Array) -> tuple[Array, Array]:
    """Return left singular vectors and singular values of the centred measurements."""
    left, values, _ = np.linalg.svd(W - W.mean(axis=1, keepdims=True), full_matrices=False)
    kept = values > 1e-12 * values[0]
    return left[:, kept], values[kept]


@pytest.mark.parametrize("aspect", [0.1, 0.5, 0.9])
def test_quantiles_are_those_of_random_matrices(aspect: float) -> None:
    rng = np.random.default_rng(0)
    long, short = 800, int(800 * aspect)
    values = np.linalg.svd(rng.standard_normal((long, short)), compute_uv=False)[::-1]
    probabilities = (np.arange(short) + 0.5) / short
    quantiles = marchenko_pastur_quantiles(aspect, probabilities)
    np.testing.assert_allclose(values / np.sqrt(long), quantiles, atol=0.03)


class TestEstimate:
    @pytest.mark.parametrize(("frames", "points"), [(60, 40), (60, 400), (20, 30), (30, 2000)])
    @pytest.mark.parametrize("sigma", [0.02, 0.2])
    def test_level_is_found(self, frames: int, points: int, sigma: float) -> None:
        W = make_low_rank(frames, points, 2, noise=sigma).measurements
        _, values = factors(W)
        assert estimate_noise(values, 2 * frames, points) == pytest.approx(sigma, rel=0.25)

    def test_clean_low_rank_tracks_have_none(self) -> None:
        W = make_low_rank(60, 40, 2).measurements
        left, values = factors(W)
        assert estimate_noise(values, 120, 40) < 1e-9
        points = virtual_points(left, values, 40)
        assert points.noise == 0.0
        assert points.neglected < 1e-9

    def test_noise_that_is_left_in_is_told(self) -> None:
        W = make_low_rank(60, 40, 2, noise=0.001).measurements
        points = virtual_points(*factors(W), 40)
        assert points.noise == 0.0
        assert points.leading(5).neglected == pytest.approx(0.001, rel=0.25)
        assert virtual_points(*factors(W[:10]), 40).neglected == np.inf

    @pytest.mark.parametrize(("frames", "points"), [(5, 40), (40, 5)])
    def test_too_small_a_matrix_tells_nothing(self, frames: int, points: int) -> None:
        values = np.ones(min(2 * frames, points))
        assert estimate_noise(values, 2 * frames, points) == 0.0


class TestFilter:
    def test_slow_tracks_pass_and_noise_does_not(self) -> None:
        rng = np.random.default_rng(0)
        time = np.linspace(0.0, 1.0, 200)
        slow = np.sin(7.0 * time)[:, None, None] * rng.standard_normal((1, 2, 5))
        tracks = slow.reshape(400, 5)
        noise = 0.1 * rng.standard_normal((400, 5))
        error = smooth_in_time(tracks + noise, 0.1) - tracks
        assert np.linalg.norm(error) < 0.4 * np.linalg.norm(noise)

    def test_a_shake_above_the_noise_is_kept(self) -> None:
        shake = np.random.default_rng(0).standard_normal((400, 3))
        smooth = smooth_in_time(shake, 0.1)
        assert np.linalg.norm(smooth - shake) < 0.05 * np.linalg.norm(shake)

    def test_pure_noise_vanishes(self) -> None:
        noise = np.random.default_rng(0).standard_normal((400, 3))
        assert np.linalg.norm(smooth_in_time(noise, 1.0)) < 0.4 * np.linalg.norm(noise)


class TestVirtualPoints:
    def test_without_noise_they_are_the_factors(self) -> None:
        W = make_low_rank(40, 30, 2).measurements
        left, values = factors(W)
        points = virtual_points(left, values, 30, noise=0.0)
        centred = W - W.mean(axis=1, keepdims=True)
        rebuilt = points.left * points.values @ (points.coordinates @ centred)
        np.testing.assert_allclose(rebuilt, centred, atol=1e-10)
        np.testing.assert_allclose(points.leading(3).left, left[:, :3])

    def test_noise_is_taken_off(self) -> None:
        clean = make_low_rank(80, 60, 2).measurements
        noise = 0.1 * np.random.default_rng(0).standard_normal(clean.shape)
        noise -= noise.mean(axis=1, keepdims=True)
        W = clean + noise
        points = virtual_points(*factors(W), 60)
        assert points.noise == pytest.approx(0.1, rel=0.15)
        centred = W - W.mean(axis=1, keepdims=True)
        rebuilt = points.left * points.values @ (points.coordinates @ centred)
        truth = clean - clean.mean(axis=1, keepdims=True)
        assert np.linalg.norm(rebuilt - truth) < 0.4 * np.linalg.norm(noise)
        eye = np.eye(len(points.values))
        np.testing.assert_allclose(points.left.T @ points.left, eye, atol=1e-10)

    def test_order_of_points_and_units_do_not_matter(self) -> None:
        W = make_low_rank(40, 30, 2, noise=0.1).measurements
        order = np.random.default_rng(1).permutation(30)
        plain = virtual_points(*factors(W), 30)
        other = virtual_points(*factors(5.0 * W[:, order]), 30)
        assert other.noise == pytest.approx(5.0 * plain.noise)
        np.testing.assert_allclose(other.values, 5.0 * plain.values, rtol=1e-9)


class TestReconstruction:
    def test_less_error_than_with_the_noise_left_in(self) -> None:
        example = make_low_rank(80, 60, 1, noise=0.1, seed=3)
        found = reconstruct(example.measurements)
        kept = reconstruct(example.measurements, noise=0.0)
        errors = [evaluate(example.ground_truth, each).e3d for each in (found, kept)]
        assert errors[0] < 0.7 * errors[1]
        assert found.diagnostics.noise == pytest.approx(0.1, rel=0.15)
        assert kept.diagnostics.noise == 0.0
        assert "noisy" in [caution.code for caution in found.diagnostics.cautions]

    def test_a_level_that_is_given_is_used(self) -> None:
        example = make_low_rank(60, 40, 1, noise=0.05)
        assert reconstruct(example.measurements, noise=0.02).diagnostics.noise == 0.02

    @pytest.mark.parametrize("noise", [1.01, 1e300])
    def test_noise_is_a_part_of_the_spread(self, noise: float) -> None:
        example = make_low_rank(20, 12, 1, seed=3)
        tracks = example.measurements
        spread = (tracks - tracks.mean(axis=1, keepdims=True)).std()
        with pytest.raises(InvalidOption, match=f"below {spread:g}"):
            reconstruct(tracks, noise=noise * spread)

    def test_cameras_see_the_shapes_without_the_noise(self) -> None:
        example = make_low_rank(80, 60, 1, noise=0.1, seed=3)
        clean = make_low_rank(80, 60, 1, seed=3).measurements
        result = reconstruct(example.measurements)
        seen = result.cameras @ result.shapes.transpose(0, 2, 1)
        seen = (seen + result.translations[:, :, None]).reshape(clean.shape)
        assert np.linalg.norm(seen - clean) < 0.5 * np.linalg.norm(example.measurements - clean)
