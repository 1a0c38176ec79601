from __future__ import annotations

import dataclasses
from itertools import product
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smsr import rotations as so3
from smsr.benchmark.camera_paths import lissajous
from smsr.benchmark.sheets import SHEETS, sheet_tracks
from smsr.cameras.axis import fit_axis
from smsr.cameras.constraints import (
    Rows,
    frame_products,
    orthonormality_form,
    symmetric_matrix,
    symmetric_vector,
)
from smsr.cameras.estimate import CameraEstimate, scaled_motion, usable_rank
from smsr.cameras.flat import FEWEST_FRAMES, FlatViews, flat_views, smoothest_signs, steadier
from smsr.cameras.free import free_cameras
from smsr.cameras.gauge import fix_gauge
from smsr.cameras.gimbal import fit_gimbal
from smsr.cameras.paces import fit_paces
from smsr.cameras.paper import published_cameras, thresholded_factor
from smsr.cameras.relaxed import relaxed_cameras, relaxed_factor
from smsr.cameras.rest import resting_frame
from smsr.cameras.rigid import looks_rigid, rigid_cameras
from smsr.cameras.selection import part_outside_span, with_simple_path, with_uniform_path
from smsr.cameras.simplicity import complexity
from smsr.cameras.switched import choose_breaks, correlation_length, fit_switched_turn, segment
from smsr.cameras.trial import Path, Trial
from smsr.cameras.turn import refine_velocity, with_shake
from smsr.cameras.uniform import fit_uniform_turn
from tests.factored import factored
from tests.shaken import shaken

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


cp: Any = pytest.importorskip("cvxpy")


def low_rank(
    rotations: Array, points: int = 30, modes: int = 1, amplitude: float = 0.15, seed: int = 0
) -> tuple[Array, Array]:
    """Return left singular vectors and singular values of a deforming shape under cameras."""
    rng = np.random.default_rng(seed)
    frames = len(rotations)
    time = np.linspace(0.0, 1.0, frames)[:, None]
    weights = amplitude * np.sin(2 * np.pi * (time * rng.uniform(1, 4, modes) + rng.random(modes)))
    basis = rng.standard_normal((modes + 1, 3, points))
    shapes = basis[0] + np.tensordot(weights, basis[1:], axes=1)
    W = (rotations[:, :2] @ shapes).reshape(2 * frames, points)
    U, s, _ = np.linalg.svd(W - W.mean(axis=1, keepdims=True), full_matrices=False)
    kept = s > 1e-10 * s[0]
    return U[:, kept], s[kept] / s[0]


def orbit(frames: int = 60, degrees: float = 4.0) -> Array:
    """Return rotations of constant velocity about a tilted axis."""
    axis = np.array([0.2, 1.0, 0.1])
    angles = np.radians(degrees) * np.arange(frames)
    return np.asarray(
        Rotation.from_rotvec(angles[:, None] * axis / np.linalg.norm(axis)).as_matrix()
    )


def swing(frames: int = 60) -> Array:
    """Return rotations that swing to and fro about two axes."""
    time = np.linspace(0.0, 1.0, frames)
    yaw, pitch = 0.9 * np.sin(9 * time), 0.5 * np.cos(14 * time)
    return np.asarray(Rotation.from_euler("yx", np.stack([yaw, pitch], axis=1)).as_matrix())


def camera_error(found: Array, true: Array) -> float:
    """Return the largest difference of cameras after the best turn or mirror of the object."""
    errors = []
    for candidate in (found, so3.mirror(found)):
        U, _, Vt = np.linalg.svd(np.einsum("tij,tik->jk", candidate, true))
        Q = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        errors.append(float(np.abs(candidate @ Q - true).max()))
    return min(errors)


def assert_cameras(rotations: Array) -> None:
    eye = np.broadcast_to(np.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), eye, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


def random_symmetric(n: int, seed: int = 0) -> Array:
    A = np.random.default_rng(seed).standard_normal((n, n))
    return np.asarray(A + A.T)


class TestConstraints:
    def test_coordinates_of_symmetric_matrices_keep_inner_products(self) -> None:
        F, G = random_symmetric(7, 1), random_symmetric(7, 2)
        assert symmetric_vector(F) @ symmetric_vector(G) == pytest.approx((F * G).sum())
        np.testing.assert_allclose(symmetric_matrix(symmetric_vector(F)), F, atol=1e-14)

    def test_frame_products_are_the_bilinear_forms(self) -> None:
        M = np.random.default_rng(0).standard_normal((10, 6))
        F = random_symmetric(6)
        G = M @ F @ M.T
        uu, vv, uv = (product @ symmetric_vector(F) for product in frame_products(M))
        np.testing.assert_allclose(uu, np.diag(G)[0::2])
        np.testing.assert_allclose(vv, np.diag(G)[1::2])
        np.testing.assert_allclose(uv, np.diag(G, 1)[0::2])

    @pytest.mark.parametrize("frames", [4, 700])
    def test_published_form_is_the_residual_of_the_constraints(self, frames: int) -> None:
        M = np.random.default_rng(0).standard_normal((2 * frames, 6))
        F = random_symmetric(6)
        form = orthonormality_form(M, rows="published")
        direct = 0.0
        for u, v in zip(M[0::2], M[1::2], strict=True):
            direct += (u @ F @ u - v @ F @ v) ** 2 + 2 * (u @ F @ v) ** 2
        f = symmetric_vector(F)
        assert form.residual(f) == pytest.approx(direct)
        np.testing.assert_allclose(form.hessian, form.hessian.T, atol=1e-9)
        assert form.lipschitz() >= np.linalg.eigvalsh(form.hessian)[-1]

    @pytest.mark.parametrize("rows", ["unit", "equal"])
    def test_forms_do_not_depend_on_how_the_image_is_rotated(self, rows: Rows) -> None:
        M = np.random.default_rng(0).standard_normal((40, 6))
        turn = Rotation.from_euler("z", 0.7).as_matrix()[:2, :2]
        turned = (turn @ M.reshape(20, 2, 6)).reshape(40, 6)
        f = symmetric_vector(random_symmetric(6))
        first, second = (orthonormality_form(m, rows=rows) for m in (M, turned))
        assert first.residual(f) == pytest.approx(second.residual(f))

    def test_unit_form_is_the_distance_of_the_gram_matrices_from_the_identity(self) -> None:
        M = np.random.default_rng(0).standard_normal((40, 6))
        F = random_symmetric(6)
        form = orthonormality_form(M, rows="unit")
        grams = np.array([M[i : i + 2] @ F @ M[i : i + 2].T for i in range(0, 40, 2)])
        assert form.residual(symmetric_vector(F)) == pytest.approx(((grams - np.eye(2)) ** 2).sum())

    @pytest.mark.parametrize("rows", get_args(Rows))
    def test_gradient_is_half_the_derivative_of_the_residual(self, rows: Rows) -> None:
        M = np.random.default_rng(0).standard_normal((20, 5))
        form = orthonormality_form(M, rows=rows)
        f, d = symmetric_vector(random_symmetric(5)), symmetric_vector(random_symmetric(5, 1))
        h = 1e-6
        slope = (form.residual(f + h * d) - form.residual(f - h * d)) / (4 * h)
        assert form.gradient(f) @ d == pytest.approx(slope, rel=1e-6)


class TestRelaxed:
    @pytest.mark.parametrize("modes", [0, 1])
    def test_cameras_of_a_low_rank_shape_are_found(self, modes: int) -> None:
        true = swing()
        estimate = relaxed_cameras(*low_rank(true, modes=modes))
        assert estimate.converged
        assert_cameras(estimate.rotations)
        assert camera_error(estimate.rotations, true) < 0.05

    def test_less_trace_less_bias(self) -> None:
        true = swing()
        errors = [
            camera_error(
                relaxed_cameras(*low_rank(true, modes=0), trace_weight=weight).rotations, true
            )
            for weight in (1e-1, 1e-3, 1e-5)
        ]
        assert errors[0] > errors[1] > errors[2]
        assert errors[2] < 1e-4

    def test_factor_solves_the_convex_problem(self) -> None:
        left, values = low_rank(swing(12), points=12, modes=1)
        M = scaled_motion(left, values, 6)
        F, _ = relaxed_factor(M, trace_weight=0.05, tolerance=1e-9, max_iterations=5000)
        variable = cp.Variable((6, 6), PSD=True)
        fit = sum(
            cp.sum_squares(M[i : i + 2] @ variable @ M[i : i + 2].T - np.eye(2))
            for i in range(0, 24, 2)
        )
        problem = cp.Problem(cp.Minimize(0.5 * fit + 0.05 * 12 * cp.trace(variable)))
        problem.solve(solver=cp.SCS, eps=1e-9)
        np.testing.assert_allclose(F, variable.value, atol=1e-4)

    def test_factor_is_semidefinite_and_practically_of_rank_3(self) -> None:
        left, values = low_rank(swing(), modes=1)
        F, residuals = relaxed_factor(scaled_motion(left, values, len(values)))
        spectrum = np.linalg.eigvalsh(F)
        assert spectrum[0] >= -1e-12
        assert spectrum[-4] < 0.05 * spectrum[-3]
        assert residuals[-1] < 1e-6

    def test_it_reports_and_can_be_stopped(self) -> None:
        left, values = low_rank(swing())
        seen: list[float] = []

        def hook(fraction: float, iteration: int, residual: float | None) -> None:
            seen.append(fraction)
            if iteration == 5:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            relaxed_cameras(left, values, hook=hook)
        assert len(seen) == 5

    def test_rank_is_a_multiple_of_three_where_it_can(self) -> None:
        assert usable_rank(np.ones(14), 30) == 12
        assert usable_rank(np.ones(40), 30) == 30
        assert usable_rank(np.array([1.0, 0.5]), 30) == 2
        assert usable_rank(np.array([1.0, 0.5, 0.1, 1e-12]), 30) == 3


class TestPublished:
    @pytest.mark.parametrize("modes", [0, 1, 2])
    def test_cameras_and_basis_size_of_a_low_rank_shape_are_found(self, modes: int) -> None:
        true = swing()
        estimate = published_cameras(*low_rank(true, modes=modes))
        assert estimate.basis_size == modes + 1
        assert_cameras(estimate.rotations)
        assert camera_error(estimate.rotations, true) < 0.1

    def test_factor_has_rank_3_and_steps_do_not_raise_the_residual(self) -> None:
        left, values = low_rank(swing(), modes=2)
        M = scaled_motion(left, values, 9)
        start = np.eye(9)
        residuals = []
        for steps in (1, 5, 25, 125):
            F, residual, changes = thresholded_factor(M, start, max_iterations=steps, tolerance=0.0)
            spectrum = np.linalg.eigvalsh(F)
            assert spectrum[:-3] == pytest.approx(0.0, abs=1e-10)
            assert spectrum[-3] > -1e-12
            assert len(changes) == steps
            residuals.append(residual)
        assert residuals == sorted(residuals, reverse=True)

    def test_a_given_basis_size_is_used(self) -> None:
        estimate = published_cameras(*low_rank(swing(), modes=2), basis_size=2)
        assert estimate.basis_size == 2


class TestFree:
    def test_wrong_cameras_make_shapes_complex(self) -> None:
        true = swing()
        left, values = low_rank(true)
        right = complexity(left * values, true)
        assert right < 0.6
        assert complexity(left * values, Rotation.random(60, random_state=0).as_matrix()) > right
        assert complexity(left * values, true[::-1]) > right

    def test_it_is_never_worse_than_the_first_relaxation(self) -> None:
        for seed in range(3):
            left, values = low_rank(swing(), modes=3, amplitude=0.4, seed=seed)
            chosen = free_cameras(left, values)
            first = relaxed_cameras(left, values)
            assert chosen.criteria["complexity"] <= complexity(left * values, first.rotations)
            assert chosen.criteria["disagreement"] >= 0.0
            assert_cameras(chosen.rotations)

    @pytest.mark.parametrize(
        ("noise", "weights"),
        [
            (0.0, [2.5e-4, 7.5e-5, 2.5e-5, 7.5e-6]),
            (0.015, [5.625e-4, 1.6875e-4, 5.625e-5, 1.6875e-5]),
            (0.5, [1e-3]),
        ],
    )
    def test_the_less_noise_the_less_weight_of_the_trace(
        self, noise: float, weights: list[float]
    ) -> None:
        left, values = low_rank(swing(), modes=1)
        weight = self.weight(free_cameras(left, values, noise=noise))
        assert any(weight == pytest.approx(each, rel=1e-4) for each in weights)

    @staticmethod
    def weight(found: CameraEstimate) -> float:
        return float(found.reason.partition("trace weight ")[2].partition(":")[0])

    @pytest.mark.parametrize("seed", range(6))
    def test_a_lighter_trace_lets_cameras_turn_that_turn_little(self, seed: int) -> None:
        """Also where the second weight leaves them as still as the first."""
        W, true, _ = shaken(seed=seed)
        left, values, _ = np.linalg.svd(W, full_matrices=False)
        left, values = left[:, :9], values[:9] / values[0]
        first = relaxed_cameras(left, values, basis_size=3, trace_weight=2.5e-4)
        found = free_cameras(left, values)
        assert so3.spread_of_views(first.rotations) < 0.01 < 0.1 < so3.spread_of_views(true)
        assert so3.spread_of_views(found.rotations) > 0.1
        assert self.weight(found) < 1e-4
        assert found.criteria["complexity"] < complexity(left * values, first.rotations)

    def test_of_very_noisy_tracks_no_lighter_trace_is_tried(self) -> None:
        W, _, _ = shaken()
        left, values, _ = np.linalg.svd(W, full_matrices=False)
        found = free_cameras(left[:, :9], values[:9] / values[0], noise=0.1)
        assert self.weight(found) >= 1e-3

    def test_a_given_basis_size_leaves_no_choice(self) -> None:
        left, values = low_rank(swing(), modes=2)
        chosen = free_cameras(left, values, basis_size=2)
        expected = relaxed_cameras(left, values, basis_size=2)
        np.testing.assert_array_equal(chosen.rotations, expected.rotations)
        assert chosen.criteria["disagreement"] == pytest.approx(0.0, abs=1e-4)

    def test_angle_between_paths_knows_neither_object_frame_nor_mirror(self) -> None:
        G = swing()
        turn = Rotation.random(random_state=1).as_matrix()
        for same in (G @ turn, so3.mirror(G) @ turn):
            assert so3.angle_between_paths(G, same) == pytest.approx(0.0, abs=1e-6)
        trembling = so3.exp(0.1 * np.random.default_rng(0).standard_normal((60, 3))) @ G
        assert so3.angle_between_paths(G, trembling) == pytest.approx(0.1 * np.sqrt(3.0), rel=0.2)


def board(rotations: Array, bend: float = 0.0, seed: int = 0) -> Array:
    """Return the tracks (2T, N) of a board that bends to and fro."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (2, 40)) * np.array([[1.0], [0.7]])
    time = np.linspace(0.0, 1.0, len(rotations))[:, None]
    shapes = np.zeros((len(rotations), 3, points.shape[1]))
    shapes[:, :2] = points
    shapes[:, 2] = bend * np.sin(13.0 * time) * np.cos(2.0 * points[0] + points[1])
    shapes = np.linalg.qr(rng.standard_normal((3, 3)))[0] @ shapes
    shapes -= shapes.mean(axis=2, keepdims=True)
    return np.asarray((rotations[:, :2] @ shapes).reshape(2 * len(rotations), -1))


def rocking(least: float, most: float, frames: int = 100) -> Array:
    """Return rotations (T, 3, 3) to and fro between two angles, in degrees, about one axis."""
    middle, swing = (most + least) / 2.0, (most - least) / 2.0
    angles = middle + swing * np.sin(np.linspace(0.0, 9.0, frames))
    return so3.exp(np.radians(angles)[:, None] * np.array([0.0, 1.0, 0.0]))


def tilted(frames: int = 80, degrees: float = 4.0) -> FlatViews:
    """Return the views of a board that turns about an axis in it, seen twice from the front."""
    rotations = orbit(frames, degrees) @ Rotation.from_euler("y", 60.0, degrees=True).as_matrix()
    return FlatViews(rotations[:, :2, :2], rotations[:, :2, 2])


class TestFlat:
    @pytest.mark.parametrize("bend", [0.0, 0.05, 0.2])
    def test_a_board_shows_its_cameras_however_it_bends(self, bend: float) -> None:
        true = lissajous(np.arange(120.0), np.random.default_rng(0))
        left, values = factored(board(true, bend))
        views = flat_views(left, values)
        assert views is not None
        assert_cameras(views.rotations)
        assert so3.angle_between_paths(views.rotations, true) < 0.001 + 0.6 * bend
        # A rigid or relaxed upgrade takes the bending for depth.
        assert so3.angle_between_paths(relaxed_cameras(left, values).rotations, true) > 0.4

    @pytest.mark.parametrize("turn", [orbit(90, 3.0), swing(90)])
    def test_whoever_turns_the_image_or_mirrors_it_gets_the_same(self, turn: Array) -> None:
        W = board(turn, 0.1)
        about = Rotation.from_euler("z", 0.7).as_matrix()[:2, :2] @ np.diag([1.0, -1.0])
        other = (about @ W.reshape(len(turn), 2, -1)).reshape(W.shape)
        one, two = (flat_views(*factored(tracks)) for tracks in (W, other))
        assert one is not None
        assert two is not None
        np.testing.assert_allclose(
            np.linalg.norm(one.tilts, axis=1), np.linalg.norm(two.tilts, axis=1), atol=1e-4
        )

    def test_what_is_not_seen_as_a_plane_is_refused(self) -> None:
        lone = np.outer(np.cos(np.arange(80.0)), np.arange(9.0))
        rng = np.random.default_rng(0)
        anyhow = rng.standard_normal((80, 2)) @ rng.standard_normal((2, 9))
        for W in (lone, anyhow, board(orbit(FEWEST_FRAMES - 1, 9.0))):
            assert flat_views(*factored(W)) is None

    def test_signs_are_those_of_the_smoothest_path(self) -> None:
        rng = np.random.default_rng(0)
        for frames in (2, 3, 4, 9):
            vectors = rng.standard_normal((frames, 2))
            costs = {
                signs: float((np.diff(np.array(signs)[:, None] * vectors, 2, axis=0) ** 2).sum())
                for signs in product((1.0, -1.0), repeat=frames)
                if signs[0] == 1.0
            }
            found = tuple(smoothest_signs(vectors).tolist())
            assert costs[found] == pytest.approx(min(costs.values()), abs=1e-12)

    def test_reversals_are_taken_back_where_the_camera_keeps_turning(self) -> None:
        views = tilted()
        frontal = views.frontal_frames()
        assert len(frontal) >= 2
        spoilt = views.reversed_from(frontal[0]).reversed_from(frontal[1])
        assert np.abs(spoilt.tilts - views.tilts).max() > 0.5
        mended = steadier(spoilt)
        assert so3.angle_between_paths(mended.rotations, views.rotations) == pytest.approx(
            0.0, abs=1e-6
        )

    def test_a_view_from_the_front_counts_once_however_long_it_lasts(self) -> None:
        views = tilted()
        (first, *_) = frontal = sorted(views.frontal_frames())
        times = np.ones(len(views.tilts), dtype=int)
        times[first] = 20
        held = FlatViews(views.rows.repeat(times, axis=0), views.tilts.repeat(times, axis=0))
        assert len(held.frontal_frames()) == len(frontal)
        spoilt = held.reversed_from(sorted(held.frontal_frames())[0])
        assert so3.angle_between_paths(spoilt.rotations, held.rotations) > 0.5
        shaken = views.tilts + 0.01 * np.random.default_rng(0).standard_normal(views.tilts.shape)
        assert len(FlatViews(views.rows, shaken).frontal_frames(0.5)) == len(frontal)

    def test_whether_the_width_is_told(self) -> None:
        """About one axis in the plane, any board is as good as one seen from the front once."""
        for turn, told in ((rocking(38.0, 66.0), False), (swing(100), True)):
            flat_in_image = np.concatenate([np.eye(3)[:2], np.zeros((1, 3))])
            points = flat_in_image @ np.random.default_rng(0).uniform(-1.0, 1.0, (3, 40))
            points -= points.mean(axis=1, keepdims=True)
            views = flat_views(*factored((turn[:, :2] @ points).reshape(2 * len(turn), -1)))
            assert views is not None
            assert views.determined is told

    def test_what_swings_is_not_made_to_turn(self) -> None:
        rotations = swing(60)
        views = FlatViews(rotations[:, :2, :2], rotations[:, :2, 2])
        np.testing.assert_array_equal(steadier(views).tilts, views.tilts)

    def test_reversals_nearest_to_other_cameras(self) -> None:
        views = tilted()
        signs = np.random.default_rng(1).choice([1.0, -1.0], len(views.tilts))
        signs[:12] = 1.0
        anyhow = FlatViews(views.rows, signs[:, None] * views.tilts)
        near = anyhow.nearest_to(views.rotations)
        np.testing.assert_allclose(near.rotations, views.rotations, atol=1e-9)

    @pytest.mark.parametrize("sheet", list(SHEETS))
    def test_sheets_are_taken_for_flat(self, sheet: str) -> None:
        W, true, _ = sheet_tracks(sheet, "fast", seed=0)
        left, values = factored(W)
        found = free_cameras(left, values)
        assert (found.model, found.flat) == ("flat", True)
        assert "the mean shape is flat" in found.reason
        assert found.criteria["complexity"] < 0.8 * found.criteria["relaxed_complexity"]
        relaxed = free_cameras(left, values, relaxations_only=True)
        assert (relaxed.model, relaxed.flat) == ("relaxed", False)
        off = so3.angle_between_paths(relaxed.rotations, true)
        assert so3.angle_between_paths(found.rotations, true) < 0.8 * off

    def test_other_shapes_are_not(self) -> None:
        W, _, _ = shaken()
        others = [low_rank(swing(), modes=3, amplitude=0.4, seed=seed) for seed in range(4)]
        for left, values in [*others, factored(W)]:
            found = free_cameras(left, values)
            assert (found.model, found.flat) == ("relaxed", False)

    def test_a_path_is_found_for_flat_cameras_too(self) -> None:
        turn = orbit(120, 3.0)
        left, values = factored(board(turn, 0.2))
        found = with_simple_path(free_cameras(left, values), left * values)
        assert (found.model, found.flat) == ("uniform", True)
        assert camera_error(found.rotations, turn) < 0.02


class TestRigid:
    def test_a_flat_object_that_bends_has_three_directions_but_is_not_rigid(self) -> None:
        left, values = factored(board(orbit(60, 5.0), 0.1))
        assert looks_rigid(values)
        assert rigid_cameras(left, values) is None

    @pytest.mark.parametrize("noise", [1e-3, 5e-3])
    def test_noise_does_not_make_a_rigid_object_another(self, noise: float) -> None:
        rng = np.random.default_rng(0)
        shape = rng.standard_normal((3, 50))
        turn = orbit(60, 0.3)
        W = (turn[:, :2] @ shape).reshape(120, 50) + noise * rng.standard_normal((120, 50))
        found = rigid_cameras(*factored(W))
        assert found is not None
        assert camera_error(found.rotations, turn) < 40.0 * noise

    def test_cameras_are_exact_however_little_the_object_turns(self) -> None:
        true = orbit(20, degrees=0.5)
        estimate = rigid_cameras(*low_rank(true, modes=0))
        assert estimate is not None
        assert camera_error(estimate.rotations, true) < 1e-8

    def test_flat_objects_and_still_cameras_are_refused(self) -> None:
        left, values = low_rank(orbit(20), points=12, modes=0)
        assert rigid_cameras(left[:, :2], values[:2]) is None
        assert rigid_cameras(*low_rank(orbit(20, degrees=0.0), modes=0)) is None


def reversing(frames: int = 120, degrees: float = 3.0) -> Array:
    """Return rotations that turn to and fro once."""
    half = frames // 2
    angles = np.radians(degrees) * (half - np.abs(np.arange(frames) - half))
    axis = np.array([0.1, 1.0, 0.2])
    return np.asarray(Rotation.from_rotvec(angles[:, None] * axis / 1.025).as_matrix())


class TestTurn:
    def test_shake_is_told_from_drift(self) -> None:
        turn = fit_uniform_turn(orbit(200))
        rng = np.random.default_rng(0)
        shake = np.radians(2.0) * rng.standard_normal((200, 3))
        time = np.linspace(0.0, 1.0, 200)[:, None]
        drift = np.radians(8.0) * np.cos(np.pi * 2 * time) * np.array([1.0, 0.0, 0.5])
        seen = so3.exp(shake + drift) @ turn.steady
        found, rest = with_shake(turn, seen)
        assert np.linalg.norm(found.shake - shake) < 0.4 * np.linalg.norm(shake)
        assert np.linalg.norm(rest - drift) < 0.4 * np.linalg.norm(drift)
        np.testing.assert_allclose(found.every(3).rotations, found.rotations[::3], atol=1e-12)

    def test_fields_of_the_velocity_are_its_derivative_about_the_middle(self) -> None:
        turn = fit_uniform_turn(orbit(60))
        shake = np.radians(1.0) * np.random.default_rng(0).standard_normal((60, 3))
        turn = dataclasses.replace(turn, angles=2.0 * turn.angles + 7.0, shake=shake)
        fields = turn.by_velocity(turn.angles[30]) / turn.span
        assert not fields[:, 30].any()
        change = 1e-6 * np.array([0.4, -0.7, 0.2])
        span = turn.angles[-1] - turn.angles[0]
        other = dataclasses.replace(turn, velocity=turn.velocity + change / span).rotations
        # The same object frame: that in which the middle camera is the identity.
        aligned = other @ other[30].T @ turn.rotations[30]
        moved = so3.log(aligned @ turn.rotations.transpose(0, 2, 1))
        np.testing.assert_allclose(moved, np.tensordot(change, fields, axes=1), atol=1e-11)

    def test_refinement_brings_the_velocity_nearer(self) -> None:
        true = orbit(60)
        left, values = low_rank(true, modes=2)
        turn = fit_uniform_turn(true)
        shake = np.radians(1.0) * np.random.default_rng(0).standard_normal((60, 3))
        for each in (np.zeros((60, 3)), shake):
            exact = dataclasses.replace(turn, shake=each)
            left, values = low_rank(exact.rotations, modes=2)
            off = dataclasses.replace(
                exact, velocity=turn.velocity + np.radians([0.05, 0.1, -0.05])
            )
            refined, gain = refine_velocity(off, left * values, motion_weight=0.1)
            error = np.linalg.norm(refined.velocity - turn.velocity)
            assert error < 0.3 * np.linalg.norm(off.velocity - turn.velocity)
            assert gain > 1.05
            _, no_gain = refine_velocity(refined, left * values, motion_weight=0.1)
            assert no_gain == pytest.approx(1.0, abs=0.01)


class TestUniform:
    @pytest.mark.parametrize("degrees", [0.5, 5.0, 40.0])
    def test_fit_recovers_a_uniform_turn(self, degrees: float) -> None:
        true = orbit(101, degrees)
        np.testing.assert_allclose(fit_uniform_turn(true).rotations, true, atol=1e-7)

    @pytest.mark.parametrize("frames", [2, 3, 4, 5])
    def test_fit_to_few_frames_is_a_fit(self, frames: int) -> None:
        true = orbit(frames, 20.0)
        errors = 0.05 * np.random.default_rng(0).standard_normal((frames, 3))
        noisy = so3.exp(errors) @ true
        turn = fit_uniform_turn(noisy)
        rest = np.linalg.norm(so3.log(turn.rotations @ noisy.transpose(0, 2, 1)))
        for axis in np.concatenate([np.eye(3), -np.eye(3)]):
            near = dataclasses.replace(turn, velocity=turn.velocity + 0.01 * axis)
            assert np.linalg.norm(so3.log(near.rotations @ noisy.transpose(0, 2, 1))) > rest

    def test_fit_is_little_disturbed_by_outliers(self) -> None:
        true = orbit(100)
        spoilt = true.copy()
        spoilt[::10] = Rotation.random(10, random_state=0).as_matrix()
        assert np.abs(fit_uniform_turn(spoilt).rotations - true).max() < 0.1


class TestSwitched:
    def test_switching_times_and_velocity_are_found(self) -> None:
        true = reversing()
        rng = np.random.default_rng(0)
        turn = fit_switched_turn(so3.exp(0.003 * rng.standard_normal((120, 3))) @ true)
        assert turn is not None
        assert np.degrees(np.linalg.norm(turn.velocity)) == pytest.approx(3.0, rel=0.05)
        assert np.abs(turn.steady - true).max() < 0.06

    def test_a_stop_is_found(self) -> None:
        angles = np.radians(4.0) * np.clip(np.arange(100), 0, 60)
        true = so3.exp(angles[:, None] * np.array([0.0, 1.0, 0.0]))
        turn = fit_switched_turn(true)
        assert turn is not None
        assert np.ptp(turn.angles[70:]) == pytest.approx(0.0)
        assert np.abs(turn.steady - true).max() < 0.05

    def test_other_motions_are_refused(self) -> None:
        rng = np.random.default_rng(1)
        walk = np.cumsum(np.radians(0.8) * rng.standard_normal((150, 3)), axis=0)
        for path in (orbit(100), swing(100), so3.exp(walk), np.tile(np.eye(3), (50, 1, 1))):
            assert fit_switched_turn(path) is None

    def test_segments_are_optimal(self) -> None:
        values = np.concatenate([np.zeros(10), np.ones(7), np.full(9, -2.0)])[:, None]
        found = segment(values, 4, 3)
        assert found[2][0] == pytest.approx(0.0)
        assert found[2][1] == [10, 17]
        errors = [error for error, _ in found]
        assert errors == sorted(errors, reverse=True)
        assert all(np.diff([0, *breaks, 26]).min() >= 3 for _, breaks in found)

    def test_noise_is_not_cut(self) -> None:
        noise = np.random.default_rng(0).standard_normal((80, 3))
        assert choose_breaks(noise) is None
        assert correlation_length(noise) < 3.0
        assert correlation_length(np.repeat(noise, 5, axis=0)) > 3.0


def about_one_axis(angles: Array) -> Array:
    """Return rotations by angles (T,), radians, about a tilted axis."""
    axis = np.array([0.2, 1.0, 0.1])
    vectors = angles[:, None] * axis / np.linalg.norm(axis)
    start = so3.exp(np.array([[0.4, -0.3, 0.2]]))
    return so3.exp(vectors) @ start


def accelerating(frames: int) -> Array:
    return about_one_axis(np.radians(np.cumsum(np.linspace(1.0, 6.0, frames))))


def easing(frames: int) -> Array:
    time = np.linspace(0.0, 1.0, frames)
    return about_one_axis(6.0 * (time - 0.8) ** 3 - 2.0 * time)


def tumbling(frames: int) -> Array:
    time = np.linspace(0.0, 1.0, frames)
    angles = [0.7 * np.sin(9 * time), 0.8 * np.sin(14 * time + 1.0), 0.6 * np.cos(11 * time)]
    return np.asarray(Rotation.from_euler("yxz", np.stack(angles, axis=1)).as_matrix())


def nodding(frames: int) -> Array:
    time = np.linspace(0.0, 1.0, frames)
    return so3.exp(0.3 * np.sin(7.0 * time)[:, None] * np.eye(3)[:1]) @ about_one_axis(4.0 * time)


def starting_and_stopping(frames: int) -> Array:
    steps = np.abs(np.sin(np.linspace(0.0, 9.0, frames))) ** 3
    steps *= np.random.default_rng(3).choice([-1.0, 1.0, 2.0], frames // 10 + 1).repeat(10)[:frames]
    return about_one_axis(0.15 * np.cumsum(steps))


def pendulum(frames: int) -> Array:
    return about_one_axis(0.9 * np.sin(np.linspace(0.5, 13.0, frames)))


class TestAxis:
    def test_any_turn_about_an_axis_is_found(self) -> None:
        angles = np.cumsum(np.random.default_rng(0).uniform(-0.1, 0.3, 200))
        true = about_one_axis(angles)
        fit = fit_axis(true)
        assert np.linalg.norm(fit.tilt, axis=1).max() < 1e-7
        np.testing.assert_allclose(fit.turn().rotations, true, atol=1e-7)
        np.testing.assert_allclose(np.abs(np.diff(fit.angles)), np.abs(np.diff(angles)), atol=1e-7)
        assert fit.is_followed()

    def test_frames_that_are_far_off_count_little(self) -> None:
        true = about_one_axis(np.linspace(0.0, 5.0, 100))
        found = true.copy()
        found[::10] = Rotation.random(10, random_state=0).as_matrix()
        turned = fit_axis(found).turn().rotations
        assert so3.angles_between(turned, true)[1::10].max() < 0.05

    def test_it_tells_what_the_object_does_from_what_the_camera_does(self) -> None:
        turning = about_one_axis(np.linspace(0.0, 12.0, 200))
        rocking = np.zeros((200, 3))
        rocking[:, 0] = 0.15 * np.sin(np.linspace(0.0, 9.0, 200))
        assert fit_axis(turning @ so3.exp(rocking)).is_followed()
        assert not fit_axis(so3.exp(rocking) @ turning).is_followed()

    def test_what_hardly_turns_or_turns_anyhow_follows_no_axis(self) -> None:
        assert not fit_axis(about_one_axis(np.radians(np.linspace(0.0, 10.0, 50)))).is_followed()
        assert not fit_axis(swing(80)).is_followed()


class TestGimbal:
    @pytest.mark.parametrize(
        "nod",
        [lambda t: 0.6 * t, lambda t: 0.3 * np.sin(8.0 * t), lambda t: 0.3 * np.sin(6.0 * t) + t],
    )
    def test_a_turn_with_a_nod_is_taken_apart(self, nod: Callable[[Array], Array]) -> None:
        time = np.linspace(0.0, 1.0, 150)
        across = nod(time)[:, None] * np.array([1.0, 0.0, 0.0])
        true = so3.exp(across) @ about_one_axis(5.0 * time)
        fit = fit_gimbal(true, fit_axis(true))
        assert fit.axis.is_followed()
        assert np.linalg.norm(fit.axis.tilt, axis=1).max() < 0.015
        found = so3.exp(fit.nod) @ fit.axis.rotations
        assert so3.angles_between(found, true).max() < 0.015

    def test_what_does_not_nod_is_not_made_to(self) -> None:
        true = about_one_axis(np.linspace(0.0, 5.0, 100))
        assert np.linalg.norm(fit_gimbal(true, fit_axis(true)).nod, axis=1).max() < 1e-6


class TestPaces:
    @pytest.mark.parametrize(
        ("index", "name", "function"),
        [
            (0, "accelerated", lambda t: 2.0 + t + 0.7 * t**2),
            (1, "eased", lambda t: t**2 * (3.0 - 2.0 * t)),
            (2, "swinging", lambda t: 0.5 + 0.8 * np.sin(11.0 * t + 0.3)),
            (3, "swinging", lambda t: 3.0 * t + 0.4 * np.cos(8.0 * t)),
        ],
    )
    @pytest.mark.parametrize("frames", [60, 1000])
    def test_each_finds_its_own_function(
        self, index: int, name: str, function: Callable[[Array], Array], frames: int
    ) -> None:
        angles = function(np.linspace(0.0, 1.0, frames))
        spoilt = angles.copy()
        spoilt[np.random.default_rng(0).choice(frames, frames // 30, replace=False)] += 1.0
        pace = fit_paces(spoilt)[index]
        assert pace.name == name
        assert pace.parameters == (1, 2, 2, 3)[index]
        np.testing.assert_allclose(pace.angles, angles, atol=0.02)


class TestRest:
    @staticmethod
    def drifting(resting: int) -> tuple[Array, Array]:
        """Return shapes (T, 3, N) that drift, some of their points at rest, and how to undo it."""
        rng = np.random.default_rng(0)
        shape = rng.standard_normal((3, 40))
        phases = np.linspace(0.0, 9.0, 50)[:, None, None] + rng.uniform(0.0, 6.0, (1, 3, 40))
        moves = 0.6 * np.sin(phases)
        moves[:, :, :resting] = 0.0
        shapes = shape + moves
        shapes -= shapes.mean(axis=2, keepdims=True)
        drift = so3.exp(
            0.2 * np.sin(np.linspace(0.0, 4.0, 50))[:, None] * np.array([1.0, 0.5, 0.2])
        )
        return drift @ shapes, drift.transpose(0, 2, 1)

    def test_points_that_rest_show_the_drift(self) -> None:
        shapes, undone = self.drifting(resting=15)
        rest = resting_frame(shapes)
        assert rest.trust == 1.0
        assert camera_error(rest.turns.transpose(0, 2, 1), undone.transpose(0, 2, 1)) < 0.03

    def test_where_all_points_move_they_show_nothing(self) -> None:
        rest = resting_frame(self.drifting(resting=0)[0])
        assert rest.unrest > 0.3
        assert rest.trust == 0.0

    def test_points_on_a_line_show_nothing(self) -> None:
        line = np.array([1.0, 2.0, 3.0])[:, None] * np.linspace(-1.0, 1.0, 20)
        stretching = (1.0 + 0.3 * np.sin(np.arange(30.0)))[:, None, None] * line
        stretching += 1e-9 * np.random.default_rng(0).standard_normal(stretching.shape)
        assert resting_frame(stretching).trust == 0.0

    def test_what_does_not_move_at_all(self) -> None:
        still = np.broadcast_to(np.random.default_rng(0).standard_normal((3, 9)), (5, 3, 9))
        for shapes in (still, np.zeros((5, 3, 9))):
            turns = resting_frame(shapes).turns
            np.testing.assert_allclose(turns, np.broadcast_to(turns[0], turns.shape), atol=1e-9)


REASONS = {
    "uniform": "a uniform turn, ",
    "switched": "a switched turn, ",
    "accelerated": "an accelerated turn, ",
    "eased": "a turn that eases in or out, ",
    "swinging": "a swing, ",
    "gimbal": "a uniform turn with a nod, ",
    "axis": "a turn about one axis, ",
}


class TestSelection:
    @pytest.mark.parametrize(
        ("path", "model"),
        [
            (orbit, "uniform"),
            (reversing, "switched"),
            (accelerating, "accelerated"),
            (easing, "eased"),
            (pendulum, "swinging"),
            (nodding, "gimbal"),
            (starting_and_stopping, "axis"),
        ],
    )
    def test_a_simple_path_is_recognised(self, path: Callable[[int], Array], model: str) -> None:
        true = path(120)
        left, values = low_rank(true, modes=2)
        free = relaxed_cameras(left, values)
        estimate = with_simple_path(free, left * values)
        assert estimate.model == model
        assert estimate.reason.startswith(REASONS[model])
        (unexplained,) = (n for name, n in estimate.criteria.items() if "unexplained" in name)
        assert unexplained < 0.1
        assert camera_error(estimate.rotations, true) < 0.06
        loose = model in {"gimbal", "axis"}
        assert (estimate.adjustable is None) == loose

    @pytest.mark.parametrize("amplitude", [0.1, 0.3])
    @pytest.mark.parametrize("seed", [0, 1])
    def test_another_motion_is_left_alone(self, amplitude: float, seed: int) -> None:
        left, values = low_rank(tumbling(80), modes=2, amplitude=amplitude, seed=seed)
        free = relaxed_cameras(left, values)
        estimate = with_simple_path(free, left * values)
        assert estimate.model == "relaxed"
        np.testing.assert_array_equal(estimate.rotations, free.rotations)

    def test_shapes_on_a_path_are_as_simple_as_the_refined_one_makes_them(self) -> None:
        true = orbit(60)
        left, values = low_rank(true, modes=1)
        turn = fit_uniform_turn(true)
        velocity = turn.velocity + np.radians([0.05, 0.1, -0.05])
        off = Path("uniform", dataclasses.replace(turn, velocity=velocity))
        trial = Trial(left * values, true, 1)
        found = trial.measure(off)
        _, refined = trial.refine(off, found)
        assert found.simplicity < 0.8
        assert refined.simplicity > 0.93

    @pytest.mark.parametrize("frames", [80, 900])
    def test_points_at_rest_take_the_drift_of_free_cameras_away(self, frames: int) -> None:
        true = tumbling(frames)
        shapes = TestRest.drifting(resting=15)[0][:1] + np.zeros((frames, 1, 1))
        shapes[:, :, 15:] += 0.5 * np.sin(np.linspace(0.0, 9.0, frames))[:, None, None]
        shapes -= shapes.mean(axis=2, keepdims=True)
        W = (true[:, :2] @ shapes).reshape(2 * frames, -1)
        U, s, Vt = np.linalg.svd(W, full_matrices=False)
        kept = s > 1e-10 * s[0]
        left, values = U[:, kept], s[kept] / s[0]
        sway = 0.15 * np.sin(np.linspace(0.0, 5.0, frames))
        drift = so3.exp(sway[:, None] * np.array([0.6, 0.8, 0.0]))
        free = CameraEstimate(true @ drift, "relaxed", 2, 1, True, "drifting on purpose")
        estimate = with_simple_path(free, left * values, points=Vt[kept])
        assert estimate.model == "relaxed"
        assert estimate.criteria["unrest"] < 0.16
        assert estimate.simpler is free.rotations
        assert estimate.simpler_share == 1.0
        assert so3.angle_between_paths(estimate.rotations, true) < 0.4 * so3.angle_between_paths(
            free.rotations, true
        )

    def test_it_can_be_forced(self) -> None:
        left, values = low_rank(swing(20))
        free = relaxed_cameras(left, values)
        estimate = with_uniform_path(free, left * values)
        assert estimate.model == "uniform"
        steps = so3.log(estimate.rotations[1:] @ estimate.rotations[:-1].transpose(0, 2, 1))
        np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-9)

    def test_true_cameras_lie_in_the_span_of_the_measurements(self) -> None:
        left, values = low_rank(swing(), modes=2)
        assert part_outside_span(left * values, swing()) < 1e-10
        assert part_outside_span(left * values, orbit()) > 0.2


class TestGauge:
    @staticmethod
    def fixed(rotations: Array) -> Array:
        return fix_gauge(CameraEstimate(rotations, "relaxed", 1, 1, True, "")).rotations

    def test_middle_camera_becomes_the_identity_and_motion_stays(self) -> None:
        G = swing(21)
        fixed = self.fixed(G)
        np.testing.assert_allclose(fixed[10], np.eye(3), atol=1e-12)
        assert camera_error(fixed, G) < 1e-12

    def test_object_frame_and_mirror_image_do_not_matter(self) -> None:
        G = swing(30)
        turn = Rotation.random(random_state=3).as_matrix()
        for same in (G @ turn, so3.mirror(G), so3.mirror(G) @ turn):
            np.testing.assert_allclose(self.fixed(same), self.fixed(G), atol=1e-12)

    def test_other_cameras_of_the_estimate_keep_their_place(self) -> None:
        G, others = swing(21), swing(21) @ so3.exp(np.full((21, 3), 0.2))
        for same, simpler in ((G, others), (so3.mirror(G), so3.mirror(others))):
            estimate = CameraEstimate(same, "relaxed", 1, 1, True, "", simpler=simpler)
            fixed = fix_gauge(estimate)
            assert fixed.simpler is not None
            relative = fixed.rotations.transpose(0, 2, 1) @ fixed.simpler
            angles = so3.angles_between(relative, np.broadcast_to(np.eye(3), (21, 3, 3)))
            np.testing.assert_allclose(angles, 0.2 * np.sqrt(3.0), atol=1e-12)

    def test_cameras_can_be_adjusted_before_or_after(self) -> None:
        turn = fit_uniform_turn(orbit(21))
        velocity = turn.by_velocity(turn.angles[10]) / turn.span
        turns = np.tensordot([0.1, 0.05, -0.2], velocity, axes=1)
        adjusted = self.fixed(so3.exp(turns) @ turn.rotations)
        for mirrored in (False, True):
            fields, G = velocity, turn.rotations
            if mirrored:
                fields, G = fields * [-1.0, -1.0, 1.0], so3.mirror(G)
            fixed = fix_gauge(CameraEstimate(G, "uniform", 1, 1, True, "", adjustable=fields))
            assert fixed.adjustable is not None
            turns = np.tensordot([0.1, 0.05, -0.2], fixed.adjustable, axes=1)
            np.testing.assert_allclose(so3.exp(turns) @ fixed.rotations, adjusted, atol=1e-12)

    def test_still_camera(self) -> None:
        still = np.broadcast_to(np.eye(3), (5, 3, 3))
        np.testing.assert_allclose(self.fixed(still), still)
