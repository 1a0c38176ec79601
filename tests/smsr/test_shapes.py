from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr import rotations as so3
from smsr.options import Options
from smsr.shapes.credibility import (
    DOUBTFUL,
    credible_depth,
    steadiness,
    with_deep_shapes,
    with_mean_depth,
)
from smsr.shapes.deformation import LikelyShapes, likely_shapes
from smsr.shapes.estimate import ShapeEstimate, basis_size_of, planar_shapes
from smsr.shapes.lengths import Lengths, chosen_points
from smsr.shapes.likely import with_likely_depth
from smsr.shapes.low_rank import flicker, low_rank_shapes, motion_scale, reweighted_shapes
from smsr.shapes.paper import published_shapes
from smsr.shapes.problem import DepthProblem
from smsr.shapes.rigid import rigid_shapes
from smsr.shapes.selection import estimate_shapes
from tests.limbs import limbs, turning
from tests.shaken import shaken

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

cp: Any = pytest.importorskip("cvxpy")


def sequence(
    frames: int = 40, points: int = 20, modes: int = 1, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Return W (2T, N) of unit spectral norm, rotations and the true shapes (T, 3, N)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.0, frames)[:, None]
    weights = 0.2 * np.sin(2 * np.pi * (time * rng.uniform(1, 3, modes) + rng.random(modes)))
    basis = rng.standard_normal((modes + 1, 3, points))
    shapes = basis[0] + np.tensordot(weights, basis[1:], axes=1)
    shapes -= shapes.mean(axis=2, keepdims=True)
    rotations = so3.exp(np.linspace(0.0, 5.0, frames)[:, None] * np.array([0.1, 1.0, 0.2]))
    W = (rotations[:, :2] @ shapes).reshape(2 * frames, points)
    scale = np.linalg.norm(W, 2)
    return W / scale, rotations, shapes / scale


def nuclear_norm(shapes: Array) -> float:
    rows = shapes.reshape(len(shapes), -1)
    return float(np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False).sum())


def relative_error(found: Array, true: Array) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


METHODS = [low_rank_shapes, reweighted_shapes, published_shapes]


@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    def test_measurements_are_reproduced(self, method: Callable[..., Any]) -> None:
        W, rotations, _ = sequence()
        found = method(W, rotations)
        assert found.converged
        assert found.iterations == len(found.residuals)
        np.testing.assert_allclose(
            (rotations[:, :2] @ found.shapes).reshape(W.shape), W, atol=1e-12
        )

    def test_shapes_are_found_from_true_cameras(self, method: Callable[..., Any]) -> None:
        W, rotations, shapes = sequence()
        assert relative_error(method(W, rotations, tolerance=1e-6).shapes, shapes) < 0.1

    def test_rigid_shape_is_found(self, method: Callable[..., Any]) -> None:
        W, rotations, shapes = sequence(modes=0)
        assert relative_error(method(W, rotations, tolerance=1e-6).shapes, shapes) < 1e-3

    def test_turning_all_points_or_mixing_them_commutes(self, method: Callable[..., Any]) -> None:
        W, rotations, _ = sequence()
        mix = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 20)))[0]
        plain, mixed = method(W, rotations).shapes, method(W @ mix, rotations).shapes
        np.testing.assert_allclose(mixed, plain @ mix, atol=1e-8)

    def test_another_object_frame_turns_the_shapes(self, method: Callable[..., Any]) -> None:
        W, rotations, _ = sequence()
        Q = so3.exp(np.array([[0.3, -1.0, 0.4]]))[0]
        plain, turned = method(W, rotations).shapes, method(W, rotations @ Q.T).shapes
        np.testing.assert_allclose(turned, Q @ plain, atol=1e-8)

    def test_it_stops_at_the_limit_and_says_so(self, method: Callable[..., Any]) -> None:
        W, rotations, _ = sequence()
        found = method(W, rotations, max_iterations=3, tolerance=1e-15)
        assert not found.converged
        assert found.iterations == 3
        assert np.isfinite(found.shapes).all()

    def test_progress_grows_to_at_most_one(self, method: Callable[..., Any]) -> None:
        W, rotations, _ = sequence()
        seen: list[float] = []
        method(W, rotations, hook=lambda fraction, *_: seen.append(fraction))
        assert seen == sorted(seen)
        assert 0.0 < seen[0] <= seen[-1] <= 1.0


def test_planar_shapes_have_no_depth() -> None:
    W, rotations, _ = sequence()
    planar = planar_shapes(W, rotations)
    seen = rotations @ planar
    np.testing.assert_allclose(seen[:, 2], 0.0, atol=1e-14)
    np.testing.assert_allclose(seen[:, :2].reshape(W.shape), W, atol=1e-14)


class TestConvergedMinimum:
    def test_it_is_the_minimum_of_the_nuclear_norm(self) -> None:
        W, rotations, _ = sequence(frames=6, points=4, modes=2)
        found = low_rank_shapes(W, rotations, tolerance=1e-9, max_iterations=20_000)
        rows = [cp.Variable((3, 4)) for _ in range(6)]
        S = cp.vstack([cp.reshape(row, (1, 12), order="C") for row in rows])
        centred = S - np.full((6, 6), 1 / 6) @ S
        constraints = [rotations[t, :2] @ rows[t] == W[2 * t : 2 * t + 2] for t in range(len(rows))]
        oracle = cp.Problem(cp.Minimize(cp.normNuc(centred)), constraints)
        oracle.solve(solver=cp.SCS, eps=1e-8, max_iters=50_000)
        assert nuclear_norm(found.shapes) == pytest.approx(oracle.value, rel=1e-5)
        assert nuclear_norm(found.shapes) <= nuclear_norm(planar_shapes(W, rotations))

    @pytest.mark.parametrize("scale", [1e-3, 1e4])
    def test_units_do_not_matter(self, scale: float) -> None:
        W, rotations, _ = sequence()
        plain = low_rank_shapes(W, rotations)
        scaled = low_rank_shapes(scale * W, rotations)
        assert scaled.iterations == plain.iterations
        np.testing.assert_allclose(
            scaled.shapes, scale * plain.shapes, rtol=1e-9, atol=1e-9 * scale
        )


class TestPublishedSchedule:
    def test_residual_falls(self) -> None:
        W, rotations, _ = sequence()
        residuals = np.array(published_shapes(W, rotations, tolerance=1e-7).residuals)
        assert residuals[-1] < 1e-7
        # The constraint is met more and more closely once the multipliers have built up.
        late = residuals[residuals.argmax() :]
        assert late[::20][-1] < 1e-3 * late[0]

    def test_slow_growth_reaches_the_minimum(self) -> None:
        W, rotations, _ = sequence()
        best = nuclear_norm(low_rank_shapes(W, rotations, tolerance=1e-8).shapes)
        slow = nuclear_norm(published_shapes(W, rotations).shapes)
        hasty = nuclear_norm(published_shapes(W, rotations, penalty_growth=3.0).shapes)
        assert slow == pytest.approx(best, rel=1e-2)
        assert hasty > 1.05 * best


class TestReweighted:
    def test_it_lowers_the_rank_more_than_the_nuclear_norm(self) -> None:
        W, rotations, shapes = sequence(modes=2)
        plain = low_rank_shapes(W, rotations).shapes
        reweighted = reweighted_shapes(W, rotations).shapes
        assert relative_error(reweighted, shapes) < relative_error(plain, shapes)

    def test_least_motion_start_moves_less_than_any_other(self) -> None:
        W, rotations, _ = sequence()
        problem = DepthProblem(W, rotations)
        problem.start_from_least_motion()
        least = problem.motion()
        rng = np.random.default_rng(0)
        axis = rotations[:, 2][:, :, None]
        best = problem.shapes.reshape(40, 3, -1)
        for size in (1e-4, 1e-2, 1.0):
            other = best + size * axis * rng.standard_normal((40, 1, 20))
            assert (np.diff(other, axis=0) ** 2).sum() > least

    @pytest.mark.parametrize("motion_weight", [0.0, 0.5])
    def test_camera_gradient_is_that_of_the_minimum(self, motion_weight: float) -> None:
        W, rotations, _ = sequence(frames=8, points=6, modes=2)
        rng = np.random.default_rng(0)
        rotations = so3.exp(0.05 * rng.standard_normal((8, 3))) @ rotations

        def minimum(turns: Array) -> DepthProblem:
            problem = DepthProblem(W, so3.exp(turns) @ rotations)
            problem.start_from_least_motion()
            problem.motion_weight = motion_weight
            assert problem.minimise(20_000, 1e-11)
            return problem

        gradient = minimum(np.zeros((8, 3))).camera_gradient()
        for _ in range(3):
            d = rng.standard_normal((8, 3))
            slope = (minimum(1e-4 * d).value() - minimum(-1e-4 * d).value()) / 2e-4
            assert (gradient * d).sum() == pytest.approx(slope, rel=1e-3)

    def test_turning_keeps_what_each_camera_sees(self) -> None:
        W, rotations, _ = sequence()
        problem = DepthProblem(W, rotations)
        problem.start_from_least_motion()
        problem.minimise(20, 1e-9)
        before = rotations @ problem.shapes.reshape(40, 3, -1)
        turned = so3.exp(np.full((40, 3), 0.02)) @ rotations
        problem.turn_to(turned)
        np.testing.assert_allclose(turned @ problem.shapes.reshape(40, 3, -1), before, atol=1e-12)

    def test_rounds_share_the_iterations(self) -> None:
        W, rotations, _ = sequence()
        found = reweighted_shapes(W, rotations, max_iterations=150, tolerance=1e-12)
        assert found.iterations == 150

    @pytest.mark.parametrize("scale", [1e-3, 1e4])
    def test_units_do_not_matter(self, scale: float) -> None:
        W, rotations, _ = sequence()
        plain = reweighted_shapes(W, rotations).shapes
        scaled = reweighted_shapes(scale * W, rotations).shapes
        np.testing.assert_allclose(scaled, scale * plain, rtol=1e-6, atol=1e-8 * scale)

    @pytest.mark.parametrize("frames", [10, 16])
    def test_an_object_much_deeper_than_wide_is_not_left_half_flat(self, frames: int) -> None:
        rng = np.random.default_rng(0)
        time = np.linspace(0.0, 1.0, frames)
        mean = rng.standard_normal((3, 40)) * np.array([[1.0], [1.0], [8.0]])
        weights = 0.2 * np.cos(6.3 * time[:, None] + np.arange(3))
        shapes = mean + np.tensordot(weights, rng.standard_normal((3, 3, 40)), axes=1)
        shapes -= shapes.mean(axis=2, keepdims=True)
        swing = np.radians(30.0) * np.sin(6.3 * time)
        rotations = so3.exp(swing[:, None] * np.array([0.1, 1.0, 0.2]))
        W = (rotations[:, :2] @ shapes).reshape(2 * frames, -1)
        assert relative_error(reweighted_shapes(W, rotations).shapes, shapes) < 0.08

    def test_flat_tracks_of_a_still_camera_get_no_depth(self) -> None:
        W, rotations, _ = sequence()
        still = np.broadcast_to(rotations[0], rotations.shape)
        found = reweighted_shapes(W, still)
        assert found.complexity == pytest.approx(1.0)
        np.testing.assert_allclose(found.shapes, planar_shapes(W, still), atol=1e-12)


class TestMotionScale:
    def problem(self, turn: float, flicker: float = 0.0, shaking: float = 0.0) -> DepthProblem:
        """A slowly stretching shape under a camera that turns by so many radians a frame."""
        rng = np.random.default_rng(0)
        shape = rng.standard_normal((3, 20))
        time = np.arange(60)[:, None, None]
        rotations = so3.exp(turn * np.arange(60)[:, None] * np.array([0.0, 1.0, 0.0]))
        shapes = shape * (1.0 + 1e-3 * time) + shaking * rng.standard_normal((60, 3, 20))
        problem = DepthProblem((rotations @ shapes)[:, :2].reshape(120, 20), rotations)
        depths = flicker * rng.standard_normal((60, 1, 20))
        problem.shapes = (shapes + rotations[:, 2][:, :, None] * depths).reshape(60, -1)
        return problem

    def test_the_more_the_camera_turns_the_more_weight(self) -> None:
        scales = [motion_scale(self.problem(turn)) for turn in (0.0, 0.01, 0.1)]
        assert scales[0] == 0.0
        assert scales == sorted(scales)
        assert scales[2] > scales[1]

    def test_flicker_adds_to_it_where_the_image_moves_more_than_the_shape(self) -> None:
        problem = self.problem(0.06, flicker=0.02)
        assert motion_scale(problem, 1.0) > motion_scale(problem)

    def test_flicker_counts_under_cameras_that_turn_fast(self) -> None:
        assert flicker(self.problem(0.01, flicker=0.02)) == 0.0
        assert flicker(self.problem(0.06, flicker=0.02)) > 0.0

    def test_an_object_that_shakes_in_all_directions_does_not_flicker(self) -> None:
        across = flicker(self.problem(0.06, shaking=0.2))
        assert across < 0.5 * flicker(self.problem(0.06, flicker=0.2))

    def test_two_frames_have_no_haste(self) -> None:
        W, rotations, _ = sequence(frames=2)
        assert flicker(DepthProblem(W, rotations)) == 0.0


class TestLikelyDepth:
    def moved(self, *, noise: float = 0.0, **changes: Any) -> float:
        """Return by how much depths change of an estimate with changes."""
        W, rotations, _ = sequence(modes=4)
        found = dataclasses.replace(reweighted_shapes(W, rotations), **changes)
        likely = with_likely_depth(found, rotations, noise)
        seen = (rotations[:, :2] @ likely.shapes).reshape(W.shape)
        np.testing.assert_allclose(seen, W, atol=1e-9)
        return float(np.linalg.norm(likely.shapes - found.shapes))

    def test_it_lowers_the_error(self) -> None:
        W, rotations, shapes = sequence(modes=4)
        found = reweighted_shapes(W, rotations)
        likely = with_likely_depth(found, rotations)
        assert relative_error(likely.shapes, shapes) < 0.9 * relative_error(found.shapes, shapes)
        assert likely.iterations > found.iterations
        assert "Gaussian" in likely.reason

    def test_it_counts_less_where_depth_is_doubtful(self) -> None:
        full = self.moved(complexity=0.5)
        assert self.moved(complexity=0.75) == pytest.approx(0.5 * full)
        assert self.moved(complexity=0.9) == 0.0

    def test_steady_shapes_remove_the_doubt(self) -> None:
        W, rotations, shapes = shaken()
        found = low_rank_shapes(W, rotations)
        doubtful = dataclasses.replace(found, complexity=0.9)
        assert with_likely_depth(doubtful, rotations) is doubtful
        likely = with_likely_depth(doubtful, rotations, doubtful=True)
        assert likely.steadiness == 1.0
        assert with_likely_depth(doubtful, rotations, 0.2, doubtful=True).steadiness == 0.0
        assert relative_error(likely.shapes, shapes) < 0.5 * relative_error(found.shapes, shapes)

    def test_it_counts_less_where_the_motion_flickered(self) -> None:
        assert self.moved(flicker=1.0) == pytest.approx(0.5 * self.moved(), rel=0.05)
        assert self.moved(flicker=2.0) < 0.05 * self.moved()

    def test_where_lengths_keep_flicker_is_no_matter(self) -> None:
        true, rotations = limbs(80), turning(80, 6.0)
        found = reweighted_shapes((rotations[:, :2] @ true).reshape(160, -1), rotations)
        likely = with_likely_depth(dataclasses.replace(found, flicker=2.0), rotations)
        assert relative_error(likely.shapes, true) < 0.2 * relative_error(found.shapes, true)
        assert "lengths that keep" in likely.reason

    def test_it_counts_less_where_there_was_noise(self) -> None:
        assert self.moved(noise=0.4) == 0.0
        assert 0.0 < self.moved(noise=0.38) < 0.2 * self.moved()

    def test_lengths_are_told_of_noise_and_flicker_and_of_some_points(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told = []

        def spy(shapes: Array, *args: Any, noise: float, weight: float) -> Lengths:
            told.append((noise, weight, shapes))
            return Lengths(shapes, *args, noise=noise, weight=weight)

        monkeypatch.setattr("smsr.shapes.likely.Lengths", spy)
        self.moved(noise=0.05)
        self.moved(flicker=1.5)
        assert [each[:2] for each in told] == [(0.05, 1.0), (0.0, 2.5)]
        W, rotations, true = sequence(points=100, modes=4)
        found = dataclasses.replace(reweighted_shapes(W, rotations), shapes=true)
        mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((100, 100)))[0]
        with_likely_depth(found, rotations, points=mixing)
        real = true @ mixing
        chosen = chosen_points((rotations[:, :2] @ real).reshape(80, -1))
        assert not np.array_equal(chosen, np.arange(len(chosen)))
        np.testing.assert_allclose(told[-1][2], real[:, :, chosen], atol=1e-12)

    def test_slow_starts_are_waited_for(self) -> None:
        W, rotations, shapes = sequence(points=60, modes=4)
        found = reweighted_shapes(W, rotations)
        likely = with_likely_depth(found, rotations)
        assert relative_error(likely.shapes, shapes) < 0.9 * relative_error(found.shapes, shapes)

    def test_with_noise_more_variance_is_allowed_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        floors = []

        def spy(*args: Any, floor: float, **rest: Any) -> LikelyShapes:
            floors.append(floor)
            return likely_shapes(*args, floor=floor, **rest)

        monkeypatch.setattr("smsr.shapes.likely.likely_shapes", spy)
        self.moved()
        self.moved(noise=0.05)
        assert floors[1] > 2.0 * floors[0]

    def test_the_covariance_is_shrunk(self, monkeypatch: pytest.MonkeyPatch) -> None:
        shrunk = self.moved()
        monkeypatch.setattr("smsr.shapes.likely._SHRINKAGE", 0.0)
        assert abs(shrunk - self.moved()) > 1e-4 * shrunk

    @pytest.mark.parametrize(("share", "refined"), [(0.1, 1), (0.5, 2), (0.9, 1), (1.0, 1)])
    def test_depths_of_little_weight_are_not_refined(self, share: float, refined: int) -> None:
        W, rotations, _ = sequence(modes=4)
        free = so3.exp(np.full((40, 3), 0.01)) @ rotations
        found = estimate_shapes(W, rotations, Options(), simpler=free, simpler_share=share)
        assert found.reason.count("Gaussian") == refined

    def test_doubtful_depths_of_two_cameras_are_found_apart(self) -> None:
        shapes = sequence(modes=2)[2]
        turn = np.linspace(0.0, 0.5, len(shapes))[:, None]
        rotations = so3.exp(turn * np.array([0.1, 1.0, 0.2]))
        free = so3.exp(0.2 * turn * np.array([1.0, 0.0, 0.0])) @ rotations
        W = (rotations[:, :2] @ shapes).reshape(2 * len(shapes), -1)
        W /= np.linalg.norm(W, 2)
        both = estimate_shapes(W, rotations, Options(), simpler=free, simpler_share=0.5)
        one, other = (estimate_shapes(W, each, Options()) for each in (rotations, free))
        assert "full depth" in one.reason
        depths = 0.5 * (rotations @ one.shapes + free @ other.shapes)[:, 2]
        np.testing.assert_allclose((rotations @ both.shapes)[:, 2], depths, atol=1e-9)

    def test_weak_directions_keep_their_depth(self) -> None:
        W, rotations, _ = sequence(points=40, modes=4)
        rng = np.random.default_rng(0)
        W = W + 1e-4 * rng.standard_normal(W.shape)
        found = reweighted_shapes(W, rotations)
        change = (with_likely_depth(found, rotations).shapes - found.shapes).reshape(-1, 40)
        assert np.linalg.matrix_rank(change, tol=1e-9 * np.linalg.norm(change)) == 24
        weak = np.linalg.svd(W)[2][24:]
        assert np.abs(change @ weak.T).max() < 1e-12

    def test_points_may_be_mixed(self) -> None:
        W, rotations, _ = sequence(modes=4)
        found = reweighted_shapes(W, rotations)
        mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 20)))[0]
        mixed = dataclasses.replace(found, shapes=found.shapes @ mixing)
        plain = with_likely_depth(found, rotations).shapes
        after = with_likely_depth(mixed, rotations, points=mixing.T).shapes
        np.testing.assert_allclose(after, plain @ mixing, atol=1e-9)

    def test_it_takes_no_more_iterations_than_are_left(self) -> None:
        W, rotations, _ = sequence(modes=4)
        found = reweighted_shapes(W, rotations)
        limits = (found.iterations, found.iterations + 3)
        counts = [
            with_likely_depth(found, rotations, max_iterations=limit).iterations for limit in limits
        ]
        assert tuple(counts) == limits

    def test_a_rigid_object_is_left_alone(self) -> None:
        W, rotations, _ = sequence(modes=0)
        found = rigid_shapes(W, rotations)
        assert with_likely_depth(found, rotations) is found


class TestAdjustedCameras:
    """A turn that is two degrees too fast over the sequence, about the middle frame."""

    true, rotations = limbs(120), turning(120, 4.0)
    fields = ((np.arange(120) - 60) / 119)[None, :, None] * np.array([0.1, 1.0, 0.2])
    wrong = so3.exp(np.radians(2.0) * fields[0]) @ rotations
    W = (rotations[:, :2] @ true).reshape(240, -1)

    def error(self, cameras: Array) -> float:
        return float(np.degrees(so3.angles_between(cameras, self.rotations).max()))

    def test_they_come_nearer_and_see_the_tracks(self) -> None:
        found = reweighted_shapes(self.W, self.wrong)
        plain = with_likely_depth(found, self.wrong)
        assert plain.rotations is None
        likely = with_likely_depth(found, self.wrong, adjustable=self.fields)
        assert likely.rotations is not None
        assert self.error(likely.rotations) < 0.6 * self.error(self.wrong)
        seen = (likely.rotations[:, :2] @ likely.shapes).reshape(self.W.shape)
        np.testing.assert_allclose(seen, self.W, atol=1e-9)
        assert relative_error(likely.shapes, self.true) < relative_error(plain.shapes, self.true)

    def test_as_far_as_the_depths_count(self) -> None:
        found = reweighted_shapes(self.W, self.wrong)
        whole, half, none = (
            with_likely_depth(
                dataclasses.replace(found, complexity=value), self.wrong, adjustable=self.fields
            ).rotations
            for value in (0.5, 0.75, 0.9)
        )
        assert whole is not None
        assert half is not None
        assert none is None
        turns = so3.log(whole @ self.wrong.transpose(0, 2, 1))
        np.testing.assert_allclose(half, so3.exp(0.5 * turns) @ self.wrong, atol=1e-12)

    def test_virtual_points_give_the_same(self) -> None:
        U, values, right = np.linalg.svd(self.W / np.linalg.norm(self.W, 2), full_matrices=False)
        kept = values > 1e-12
        virtual, mixing = U[:, kept] * values[kept], right[kept]
        all_points, reduced = (
            estimate_shapes(W, self.wrong, Options(), adjustable=self.fields, points=points)
            for W, points in ((virtual @ mixing, None), (virtual, mixing))
        )
        assert all_points.rotations is not None
        assert reduced.rotations is not None
        np.testing.assert_allclose(reduced.rotations, all_points.rotations, atol=1e-8)
        np.testing.assert_allclose(reduced.shapes @ mixing, all_points.shapes, atol=1e-8)

    @pytest.mark.parametrize("share", [0.0, 0.5])
    def test_what_other_cameras_see_is_turned_to_them(self, share: float) -> None:
        found = estimate_shapes(
            self.W,
            self.wrong,
            Options(),
            adjustable=self.fields,
            simpler=self.wrong,
            simpler_share=share,
        )
        assert found.rotations is not None
        assert self.error(found.rotations) < 0.6 * self.error(self.wrong)
        seen = (found.rotations[:, :2] @ found.shapes).reshape(self.W.shape)
        np.testing.assert_allclose(seen, self.W, atol=1e-9)


class TestSteadiness:
    def test_shapes_that_explain_a_shake_are_sure(self) -> None:
        _, rotations, shapes = shaken()
        assert steadiness(shapes, rotations) == 1.0

    def test_flat_shapes_shake_as_the_tracks_do(self) -> None:
        W, rotations, _ = shaken()
        still = np.broadcast_to(np.eye(3), rotations.shape)
        for scale in (1.0, 1e-6, 1e9):
            flat = planar_shapes(scale * W, still)
            assert steadiness(flat, still) == pytest.approx(0.0, abs=1e-9)

    def test_a_roll_of_the_camera_says_nothing_of_depth(self) -> None:
        _, _, shapes = shaken()
        angles = np.radians(2.0) * np.random.default_rng(1).standard_normal((len(shapes), 1))
        rolling = so3.exp(angles * np.array([0.0, 0.0, 1.0]))
        flat = shapes * np.array([1.0, 1.0, 0.0])[:, None]
        assert steadiness(flat, rolling) == pytest.approx(0.0, abs=1e-9)
        assert steadiness(shapes, rolling) < 0.01

    def test_cameras_that_turn_for_nothing_do_not_make_shapes_sure(self) -> None:
        """Flat shapes would then be restless, but the tracks are not."""
        _, _, shapes = shaken()
        W = shapes[:, :2].reshape(-1, shapes.shape[2])
        turns = so3.exp(np.radians(30.0) * np.arange(len(shapes))[:, None] * np.eye(3)[:1])
        assert steadiness(planar_shapes(W, turns), turns) <= 0.0

    def test_depth_that_moves_on_its_own_speaks_against_itself(self) -> None:
        _, rotations, shapes = shaken()
        depths = np.random.default_rng(0).standard_normal(shapes[:, :1].shape)
        restless = shapes + rotations[:, 2][:, :, None] * depths
        assert steadiness(restless, rotations) == -1.0

    @pytest.mark.parametrize("frames", [2, 3])
    def test_of_few_frames_it_is_a_number(self, frames: int) -> None:
        _, rotations, shapes = shaken(frames)
        assert -1.0 <= steadiness(shapes, rotations) <= 1.0
        assert steadiness(np.zeros_like(shapes), rotations) == 0.0


class TestTwoSolutions:
    def estimates(self, complexity: float) -> tuple[Array, Array, ShapeEstimate, ShapeEstimate]:
        """Return W, cameras, a solution and one with half of its depth and a complexity."""
        W, rotations, _ = sequence(modes=2)
        found = low_rank_shapes(W, rotations)
        less = planar_shapes(W, rotations) + 0.5 * (found.shapes - planar_shapes(W, rotations))
        return (
            W,
            rotations,
            found,
            dataclasses.replace(found, shapes=less, complexity=complexity),
        )

    @pytest.mark.parametrize("complexity", [0.5, 0.775, 0.9])
    def test_deep_shapes_count_as_far_as_they_are_simple(self, complexity: float) -> None:
        W, rotations, found, deep = self.estimates(complexity)
        blend = with_deep_shapes(found, deep, rotations)
        np.testing.assert_allclose((rotations[:, :2] @ blend.shapes).reshape(W.shape), W, atol=1e-9)
        moved = np.linalg.norm(blend.shapes - found.shapes)
        part = moved / np.linalg.norm(deep.shapes - found.shapes)
        assert part == pytest.approx({0.5: 1.0, 0.775: 0.5, 0.9: 0.0}[complexity], abs=1e-6)

    def test_deep_shapes_are_little_deeper_than_the_object_is_wide(self) -> None:
        W, rotations, found, deep = self.estimates(0.5)
        planar = planar_shapes(W, rotations)
        far = dataclasses.replace(deep, shapes=planar + 1e3 * (deep.shapes - planar))
        flat = dataclasses.replace(found, shapes=planar)
        seen = rotations @ with_deep_shapes(flat, far, rotations).shapes
        width = np.linalg.norm(seen[:, :2].transpose(1, 0, 2).reshape(2, -1), 2)
        assert np.linalg.norm(seen[:, 2]) == pytest.approx(1.25 * width)

    def test_steady_deep_shapes_count_however_complex(self) -> None:
        _, rotations, found, deep = self.estimates(0.9)
        steady = dataclasses.replace(deep, steadiness=1.0)
        blend = with_deep_shapes(found, steady, rotations)
        np.testing.assert_allclose(blend.shapes, deep.shapes, atol=1e-12)
        assert blend.steadiness == 1.0

    @pytest.mark.parametrize(("degrees", "kept"), [(20.0, 0.5), (37.5, 0.75), (60.0, 1.0)])
    def test_depth_that_moves_more_than_the_tracks_is_taken_back(
        self, degrees: float, kept: float
    ) -> None:
        """Half of it at a steadiness of -1/2, unless the camera turns."""
        _, rotations, found, deep = self.estimates(0.9)
        angles = np.linspace(0.0, np.radians(degrees), len(rotations))
        few = so3.exp(angles[:, None] * np.array([0.0, 1.0, 0.0]))
        seen = few @ found.shapes
        doubt = dataclasses.replace(deep, steadiness=-0.5)
        blend = few @ with_deep_shapes(found, doubt, few).shapes
        np.testing.assert_allclose(blend[:, :2], seen[:, :2], atol=1e-12)
        np.testing.assert_allclose(blend[:, 2], kept * seen[:, 2], atol=1e-12)

    def test_of_very_noisy_tracks_deep_shapes_say_nothing(self) -> None:
        _, rotations, found, deep = self.estimates(0.5)
        assert with_deep_shapes(found, deep, rotations, 0.2) is found
        little = with_deep_shapes(found, deep, rotations, 0.01).shapes
        none = with_deep_shapes(found, deep, rotations).shapes
        assert 0.9 < relative_error(little, found.shapes) / relative_error(none, found.shapes) < 1.0

    def test_mean_depth_of_the_same_cameras_in_another_frame(self) -> None:
        W, rotations, _ = sequence(modes=2)
        others = rotations @ so3.exp(np.array([[0.3, -0.2, 0.9]]))
        found, other = low_rank_shapes(W, rotations), low_rank_shapes(W, others)
        mean = with_mean_depth(found, rotations, other, others)
        assert relative_error(mean.shapes, found.shapes) < 1e-3

    def test_mean_depth_lies_between_and_keeps_the_tracks(self) -> None:
        W, rotations, _ = sequence(modes=2)
        others = rotations @ so3.exp(np.linspace(0.0, 0.3, len(rotations))[:, None] * np.eye(3)[:1])
        found, other = low_rank_shapes(W, rotations), low_rank_shapes(W, others)
        seen = others @ other.shapes
        for share in (0.3, 1.0):
            mean = rotations @ with_mean_depth(found, rotations, other, others, share).shapes
            np.testing.assert_allclose(mean[:, :2].reshape(W.shape), W, atol=1e-9)
            depths = (1.0 - share) * (rotations @ found.shapes)[:, 2] + share * seen[:, 2]
            np.testing.assert_allclose(mean[:, 2], depths, atol=1e-9)

    def test_of_two_cameras_those_of_more_weight_tell_how_sure_depth_is(self) -> None:
        W, rotations, _ = shaken(60)
        W = W / np.linalg.norm(W, 2)
        alone = estimate_shapes(W, rotations, Options())
        found = estimate_shapes(W, rotations, Options(), simpler=rotations, simpler_share=0.9)
        assert alone.steadiness > 0.5
        assert alone.complexity > DOUBTFUL
        assert found.steadiness >= 0.9 * alone.steadiness
        assert found.complexity == pytest.approx(alone.complexity, abs=0.05)


class TestRigid:
    def test_rigid_shape_is_exact(self) -> None:
        W, rotations, shapes = sequence(modes=0)
        np.testing.assert_allclose(rigid_shapes(W, rotations).shapes, shapes, atol=1e-12)

    def test_measurements_are_reproduced_and_depth_is_shared(self) -> None:
        W, rotations, _ = sequence(modes=2)
        seen = rotations @ rigid_shapes(W, rotations).shapes
        np.testing.assert_allclose(seen[:, :2].reshape(W.shape), W, atol=1e-12)
        # Depths in all frames are views of one shape.
        assert np.linalg.matrix_rank(seen[:, 2], tol=1e-10) == 3


class TestCredibleDepth:
    @pytest.mark.parametrize(("complexity", "kept"), [(0.3, 1.0), (0.9, 0.5), (1.0, 0.0)])
    def test_depth_is_faded_out_as_it_stops_to_simplify(
        self, complexity: float, kept: float
    ) -> None:
        W, rotations, _ = sequence()
        found = dataclasses.replace(low_rank_shapes(W, rotations), complexity=complexity)
        before, after = (
            rotations @ each.shapes for each in (found, credible_depth(found, rotations))
        )
        np.testing.assert_allclose(after[:, :2], before[:, :2], atol=1e-12)
        np.testing.assert_allclose(after[:, 2], kept * before[:, 2], atol=1e-12)

    def test_depth_is_bounded(self) -> None:
        W, rotations, _ = sequence()
        found = low_rank_shapes(W, rotations)
        deep = rotations.transpose(0, 2, 1) @ (
            np.array([1.0, 1.0, 1e3])[:, None] * (rotations @ found.shapes)
        )
        kept = credible_depth(dataclasses.replace(found, shapes=deep), rotations)
        seen = rotations @ kept.shapes
        assert np.sqrt((seen[:, 2] ** 2).mean() / (seen[:, :2] ** 2).mean()) == pytest.approx(2.0)


@pytest.mark.parametrize("modes", [0, 1, 3])
def test_basis_size_counts_the_basis_shapes(modes: int) -> None:
    _, _, shapes = sequence(modes=modes)
    assert basis_size_of(shapes) == modes + 1
