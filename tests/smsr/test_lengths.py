from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr.shapes.deformation import likely_shapes
from smsr.shapes.lengths import MOST_POINTS, Lengths, chosen_points
from smsr.shapes.low_rank import low_rank_shapes
from tests.limbs import limbs, turning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def split(shapes: Array, rotations: Array) -> tuple[Array, Array]:
    """Return viewing directions and depths."""
    axis = rotations[:, 2]
    return axis, np.matmul(axis[:, None], shapes)[:, 0]


def lengths_of(shapes: Array, rotations: Array, **options: float) -> Lengths:
    axis, depths = split(shapes, rotations)
    return Lengths(shapes, np.eye(shapes.shape[2]), axis, depths, **options)


class TestEvidence:
    def test_its_slope_is_that_of_how_much_the_lengths_vary(self) -> None:
        rng = np.random.default_rng(1)
        rotations = turning(12, 7.0)
        true = limbs(12, count=1)[:, :, :9]
        axis, exact = split(true, rotations)
        depths = exact + 0.02 * rng.standard_normal(exact.shape)
        planar = true - axis[:, :, None] * exact[:, None]

        def squares(of_depths: Array, i: int, j: int) -> Array:
            shapes = planar + axis[:, :, None] * of_depths[:, None]
            squared: Array = ((shapes[:, :, i] - shapes[:, :, j]) ** 2).sum(axis=1)
            return squared

        size = (true**2).mean()
        weights = {}
        start = planar + axis[:, :, None] * depths[:, None]
        for i, j in combinations(range(9), 2):
            level, difference = squares(depths, i, j).mean(), start[:, :, i] - start[:, :, j]
            variance = squares(depths, i, j).var() / (4 * level)
            motion = difference.var(axis=0).sum()
            trust = max(1 - variance / (0.1**2 * size), 0) ** 2
            trust *= max(1 - variance / (0.3**2 * motion), 0) ** 2
            least = 0.005**2 * size
            weights[i, j] = 2.0 / 9 * trust / ((variance + least) * 4 * level)
        assert 3 < np.count_nonzero(list(weights.values())) < 36

        def energy(of_depths: Array) -> float:
            total = 0.0
            for (i, j), weight in weights.items():
                squared = squares(of_depths, i, j)
                total += 0.5 * weight * float(((squared - squared.mean()) ** 2).sum())
            return total

        found = Lengths(true, np.eye(9), axis, exact).evidence(depths)
        slope = np.matmul(found.precision, depths[:, :, None])[:, :, 0] - found.force
        for t, i in ((0, 0), (4, 3), (11, 8), (7, 6)):
            step = np.zeros_like(depths)
            step[t, i] = 1e-6
            numeric = (energy(depths + step) - energy(depths - step)) / 2e-6
            assert slope[t, i] == pytest.approx(numeric, rel=1e-5, abs=1e-4)

    def test_it_is_convex_and_does_not_see_a_common_depth(self) -> None:
        rotations = turning(20, 5.0)
        shapes = limbs(20)
        found = lengths_of(shapes, rotations).evidence(split(shapes, rotations)[1] + 0.01)
        np.testing.assert_array_equal(found.precision, found.precision.transpose(0, 2, 1))
        values = np.linalg.eigvalsh(found.precision)
        assert values.min() > -1e-9 * values.max()
        np.testing.assert_allclose(found.precision.sum(axis=1), 0.0, atol=1e-9 * values.max())

    def test_points_may_be_told_in_terms_of_others(self) -> None:
        rotations = turning(20, 5.0)
        shapes = limbs(20)
        axis, depths = split(shapes, rotations)
        plain = Lengths(shapes, np.eye(26), axis, depths).evidence(depths)
        basis = np.linalg.qr(np.random.default_rng(0).standard_normal((26, 26)))[0][:, :7]
        some = Lengths(shapes, basis.T, axis, depths @ basis).evidence(depths @ basis)
        scale = float(np.abs(plain.precision).max())
        np.testing.assert_allclose(
            some.precision, basis.T @ plain.precision @ basis, atol=1e-9 * scale
        )

    def test_support_is_the_part_of_points_whose_lengths_keep(self) -> None:
        rotations = turning(40, 5.0)
        shapes = limbs(40)
        depths = split(shapes, rotations)[1]
        assert lengths_of(shapes, rotations).evidence(depths).support > 0.95
        loose = np.random.default_rng(0).standard_normal(shapes.shape)
        found = lengths_of(loose, rotations).evidence(split(loose, rotations)[1])
        assert found.support == 0.0
        assert not found.precision.any()
        half = np.concatenate([shapes, loose], axis=2)
        found = lengths_of(half, rotations).evidence(split(half, rotations)[1])
        assert 0.4 < found.support < 0.6

    def test_points_that_coincide_are_no_support(self) -> None:
        rotations = turning(40, 5.0)
        loose = np.random.default_rng(0).standard_normal((40, 3, 12))
        doubled = np.concatenate([loose, loose + 1e-9], axis=2)
        found = lengths_of(doubled, rotations).evidence(split(doubled, rotations)[1])
        assert found.support == 0.0

    def test_steps_are_short_where_a_pair_lies_in_the_image_plane(self) -> None:
        rotations = turning(40, 5.0)
        limb = np.repeat(np.array([[[-1.0, 1.0], [0.2, -0.2], [0.0, 0.0]]]), 40, axis=0)
        depths = split(limb, rotations)[1]
        lengths = lengths_of(limb, rotations)
        flat = int(np.abs(np.abs(depths[:, 0] - depths[:, 1]) - 0.3).argmin())
        wrong = depths.copy()
        wrong[flat] = [1e-4, -1e-4]
        found = lengths.evidence(wrong)
        assert found.precision[flat].any()
        likeliest = np.linalg.pinv(found.precision[flat], hermitian=True) @ found.force[flat]
        step = likeliest - (wrong[flat] - wrong[flat].mean())
        assert np.abs(step).max() < 0.3

    def test_noise_makes_it_weaker(self) -> None:
        rotations = turning(20, 5.0)
        shapes = limbs(20)
        depths = split(shapes, rotations)[1]
        clean, noisy = (
            lengths_of(shapes, rotations, noise=noise).evidence(depths) for noise in (0.0, 0.05)
        )
        assert 0.0 < np.trace(noisy.precision[3]) < 0.1 * np.trace(clean.precision[3])

    @pytest.mark.parametrize("scale", [1e-6, 1e5])
    def test_units_do_not_matter(self, scale: float) -> None:
        rotations = turning(20, 5.0)
        shapes = limbs(20)
        depths = split(shapes, rotations)[1] + 0.05 * np.sin(np.arange(26))
        plain = lengths_of(shapes, rotations).evidence(depths)
        scaled = lengths_of(scale * shapes, rotations).evidence(scale * depths)
        np.testing.assert_allclose(
            scaled.precision * scale**2, plain.precision, rtol=1e-6, atol=1e-6
        )
        assert scaled.support == pytest.approx(plain.support)

    def test_points_that_coincide_or_do_not_move_are_no_trouble(self) -> None:
        rotations = turning(20, 5.0)
        shapes = np.repeat(limbs(1), 20, axis=0)
        shapes[:, :, 1] = shapes[:, :, 0]
        depths = split(shapes, rotations)[1]
        found = lengths_of(shapes, rotations).evidence(depths)
        assert np.isfinite(found.precision).all()
        np.testing.assert_allclose(
            np.matmul(found.precision, depths[:, :, None])[:, :, 0],
            found.force,
            rtol=1e-6,
            atol=1.0,
        )


@pytest.mark.parametrize("seed", [0, 2])
def test_limbs_are_found_better_by_their_lengths(seed: int) -> None:
    true = limbs(80, seed=seed)
    rotations = turning(80, 6.0)
    start = low_rank_shapes((rotations[:, :2] @ true).reshape(160, -1), rotations).shapes
    plain, with_lengths = (
        likely_shapes(
            start, rotations, floor=0.001, max_iterations=60, tolerance=0.0, lengths=lengths
        )
        for lengths in (None, lengths_of(start, rotations))
    )
    before, after = (np.linalg.norm(found.shapes - true) for found in (plain, with_lengths))
    assert after < 0.2 * before
    assert plain.support == 0.0
    assert with_lengths.support > 0.9


class TestChosenPoints:
    def test_few_are_all_taken(self) -> None:
        trajectories = np.random.default_rng(0).standard_normal((20, MOST_POINTS))
        np.testing.assert_array_equal(chosen_points(trajectories), np.arange(MOST_POINTS))

    def test_their_order_does_not_matter(self) -> None:
        rng = np.random.default_rng(0)
        trajectories = rng.standard_normal((20, 300)) * rng.uniform(0.5, 3.0, 300)
        order = rng.permutation(300)
        chosen = chosen_points(trajectories)
        assert len(set(chosen)) == MOST_POINTS
        assert set(order[chosen_points(trajectories[:, order])]) == set(chosen)

    def test_near_and_far_ones_are_among_them(self) -> None:
        trajectories = np.ones((4, 1)) * np.arange(1.0, 1001.0)
        chosen = chosen_points(trajectories)
        assert chosen[0] == 0
        assert chosen[-1] == 999
        assert np.diff(chosen).max() < 20

    def test_long_sequences_have_fewer(self) -> None:
        chosen = chosen_points(np.random.default_rng(0).standard_normal((10_000, 50)))
        assert 15 < len(chosen) < 25
