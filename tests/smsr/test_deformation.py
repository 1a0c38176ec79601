from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.linalg import block_diag

from smsr import rotations as so3
from smsr.shapes.adjustment import Adjustment
from smsr.shapes.deformation import (
    Deformation,
    condition,
    extrapolated,
    first_model,
    likely_shapes,
    log_likelihood,
    turning_force,
)
from smsr.shapes.lengths import Evidence, Lengths
from smsr.shapes.low_rank import low_rank_shapes
from tests.limbs import turning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def model(points: int, correlation: float, seed: int = 0, rank: int | None = None) -> Deformation:
    """Return a process with a random mean and a covariance of full or of little rank."""
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((3 * points, rank or 3 * points))
    covariance = factor @ factor.T / factor.shape[1] + 1e-6 * np.eye(3 * points)
    return Deformation(rng.standard_normal(3 * points), covariance, correlation)


def temporal_covariance(frames: int, correlation: float) -> Array:
    times = np.arange(frames)
    return np.asarray(correlation ** np.abs(times[:, None] - times), dtype=np.float64)


def sample(deformation: Deformation, frames: int, seed: int = 1) -> Array:
    """Draw shapes (T, 3, q)."""
    rng = np.random.default_rng(seed)
    in_time = np.linalg.cholesky(temporal_covariance(frames, deformation.correlation))
    in_space = np.linalg.cholesky(deformation.covariance)
    white = rng.standard_normal((frames, len(deformation.mean)))
    return (in_time @ white @ in_space.T + deformation.mean).reshape(frames, 3, -1)


def without_depth(shapes: Array, rotations: Array) -> Array:
    axis = rotations[:, 2]
    flat: Array = shapes - axis[:, :, None] * np.matmul(axis[:, None], shapes)
    return flat


def dense_log_likelihood(deformation: Deformation, shapes: Array, rotations: Array) -> float:
    """Return that of what the cameras see of the shapes, from the covariance of all of it."""
    frames = len(shapes)
    in_time = temporal_covariance(frames, deformation.correlation)
    seen, blocks = [], []
    for rotation, shape in zip(rotations, shapes, strict=True):
        camera = np.kron(rotation[:2], np.eye(shape.shape[1]))
        blocks.append(camera)
        seen.append(camera @ (shape.ravel() - deformation.mean))
    covariance = np.block(
        [
            [
                in_time[s, t] * blocks[s] @ deformation.covariance @ blocks[t].T
                for t in range(frames)
            ]
            for s in range(frames)
        ]
    )
    y = np.concatenate(seen)
    _, determinant = np.linalg.slogdet(covariance)
    return float(-0.5 * (determinant + y @ np.linalg.solve(covariance, y)))


class TestCondition:
    @pytest.mark.parametrize(
        ("frames", "correlation"), [(2, 0.6), (3, 0.6), (4, 0.6), (5, 0.0), (5, 0.98), (8, 0.9)]
    )
    def test_it_is_the_conditional_of_the_joint_gaussian(
        self, frames: int, correlation: float
    ) -> None:
        points = 3
        deformation = model(points, correlation)
        shapes, rotations = sample(deformation, frames), turning(frames, 20.0)
        joint = np.kron(temporal_covariance(frames, correlation), deformation.covariance)
        see, look = (np.zeros((frames * k * points, frames * 3 * points)) for k in (2, 1))
        for t, rotation in enumerate(rotations):
            columns = slice(t * 3 * points, (t + 1) * 3 * points)
            eye = np.eye(points)
            see[t * 2 * points : (t + 1) * 2 * points, columns] = np.kron(rotation[:2], eye)
            look[t * points : (t + 1) * points, columns] = np.kron(rotation[2:], eye)
        mean = np.tile(deformation.mean, frames)
        gain = look @ joint @ see.T @ np.linalg.inv(see @ joint @ see.T)
        depths = look @ mean + gain @ see @ (shapes.ravel() - mean)
        covariance = look @ joint @ look.T - gain @ see @ joint @ look.T

        found = condition(deformation, without_depth(shapes, rotations), rotations[:, 2])
        np.testing.assert_allclose(found.depths.ravel(), depths, atol=1e-8)
        blocks = covariance.reshape(frames, points, frames, points)
        for t in range(frames):
            np.testing.assert_allclose(found.covariances[t], blocks[t, :, t], atol=1e-8)
        for t in range(frames - 1):
            np.testing.assert_allclose(found.next_covariances[t], blocks[t, :, t + 1], atol=1e-8)

    def test_evidence_adds_to_it(self) -> None:
        frames, points = 5, 3
        deformation, rotations = model(points, 0.8), turning(5, 20.0)
        shapes = sample(deformation, frames)
        rng = np.random.default_rng(3)
        factors = rng.standard_normal((frames, points, points))
        extra = Evidence(
            factors @ factors.transpose(0, 2, 1), rng.standard_normal((frames, points)), 1.0
        )
        planar, axis = without_depth(shapes, rotations), rotations[:, 2]
        prior = condition(deformation, planar, axis)
        joint = np.kron(temporal_covariance(frames, 0.8), deformation.covariance)
        look = np.zeros((frames * points, frames * 3 * points))
        for t, direction in enumerate(axis):
            rows, columns = slice(t * 3, t * 3 + 3), slice(t * 9, t * 9 + 9)
            look[rows, columns] = np.kron(direction, np.eye(points))
        precision = look @ np.linalg.inv(joint) @ look.T
        both = precision + block_diag(*extra.precision)
        right = precision @ prior.depths.ravel() + extra.force.ravel()
        found = condition(deformation, planar, axis, extra)
        np.testing.assert_allclose(found.depths.ravel(), np.linalg.solve(both, right), atol=1e-8)
        covariance = np.linalg.inv(both).reshape(frames, points, frames, points)
        np.testing.assert_allclose(found.covariances[2], covariance[2, :, 2], atol=1e-8)
        np.testing.assert_allclose(found.next_covariances[2], covariance[2, :, 3], atol=1e-8)

    def test_a_precision_that_is_none_has_no_negative_variance(self) -> None:
        deformation, rotations = model(3, 0.8), turning(5, 20.0)
        planar = without_depth(sample(deformation, 5), rotations)
        negative = Evidence(np.broadcast_to(-1e9 * np.eye(3), (5, 3, 3)), np.zeros((5, 3)), 0.0)
        found = condition(deformation, planar, rotations[:, 2], negative)
        assert np.isfinite(found.depths).all()
        assert np.linalg.eigvalsh(found.covariances[-1]).min() > 0.0


@pytest.mark.parametrize("correlation", [0.0, 0.7])
@pytest.mark.parametrize("frames", [2, 5])
def test_the_likelihood_is_that_of_the_joint_gaussian(frames: int, correlation: float) -> None:
    deformation, rotations = model(3, correlation), turning(frames, 20.0)
    values = []
    for seed in (1, 2):
        shapes = sample(deformation, frames, seed)
        found = log_likelihood(deformation, without_depth(shapes, rotations), rotations[:, 2])
        values.append((found, dense_log_likelihood(deformation, shapes, rotations)))
    for found, dense in values:
        assert found * 2 * frames * 3 == pytest.approx(dense, rel=1e-8)


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_turning_force_is_the_gradient_of_the_likelihood(correlation: float) -> None:
    deformation, rotations = model(3, correlation), turning(5, 20.0)
    shapes = sample(deformation, 5)
    planar = without_depth(shapes, rotations)
    posterior = condition(deformation, planar, rotations[:, 2])
    force = turning_force(deformation, planar, rotations, posterior)
    expected = np.zeros_like(force)
    step = 1e-5
    for t, axis in np.ndindex(5, 3):
        turn = np.zeros((5, 3))
        turn[t, axis] = step
        there, back = (so3.exp(sign * turn) @ rotations for sign in (1.0, -1.0))
        # What the cameras see stays: they see it of other shapes.
        values = [
            dense_log_likelihood(deformation, R.transpose(0, 2, 1) @ (rotations @ shapes), R)
            for R in (there, back)
        ]
        expected[t, axis] = (values[0] - values[1]) / (2.0 * step)
    np.testing.assert_allclose(force, expected, atol=1e-6 * np.abs(expected).max())


class Spy(Lengths):
    """Lengths that say nothing, and how often they were asked."""

    def __init__(self) -> None:
        self.asked = 0

    def evidence(self, depths: Array) -> Evidence:
        self.asked += 1
        frames, points = depths.shape
        return Evidence(np.zeros((frames, points, points)), np.zeros((frames, points)), 0.25)


@pytest.mark.parametrize(
    ("rounds", "tolerance", "taken", "with_lengths"),
    [(60, 1.0, 12, 3), (60, 0.0, 60, 24), (10, 0.0, 10, 4), (2, 0.0, 2, 0), (1, 0.0, 1, 0)],
)
def test_lengths_join_when_depths_have_settled(
    rounds: int, tolerance: float, taken: int, with_lengths: int
) -> None:
    true, rotations = sample(model(6, 0.9, rank=3), 30), turning(30, 6.0)
    spy = Spy()
    found = likely_shapes(
        true, rotations, floor=0.01, max_iterations=rounds, tolerance=tolerance, lengths=spy
    )
    assert (found.iterations, spy.asked) == (taken, with_lengths)
    assert found.support == (0.25 if with_lengths else 0.0)


class TestAdjustment:
    def test_a_turn_that_is_a_little_too_fast_is_slowed_down(self) -> None:
        true = sample(model(10, 0.9, rank=4), 150)
        rotations = turning(150, 3.0)
        # By three degrees over the sequence, about the middle frame.
        parts = (np.arange(150) - 75) / 149
        fields = (parts[:, None] * np.array([0.1, 1.0, 0.2]))[None]
        wrong = so3.exp(math.radians(3.0) * fields[0]) @ rotations
        start = wrong.transpose(0, 2, 1) @ (rotations @ true)
        adjustment = Adjustment(wrong, fields)
        found = likely_shapes(
            start, wrong, floor=0.001, max_iterations=40, tolerance=0.0, adjustment=adjustment
        )
        assert math.degrees(adjustment.change[0]) == pytest.approx(-3.0, abs=0.5)
        cameras = adjustment.rotations()
        np.testing.assert_allclose(cameras[75], rotations[75], atol=1e-12)
        np.testing.assert_allclose(
            cameras[:, :2] @ found.shapes, rotations[:, :2] @ true, atol=1e-9
        )

    @pytest.mark.parametrize(("length", "steps"), [(1.0, 7), (0.0, 4)])
    def test_lengths_wait_for_it_and_then_it_rests(self, length: float, steps: int) -> None:
        true, rotations = sample(model(6, 0.9, rank=3), 30), turning(30, 6.0)
        spy, asked = Spy(), []

        class Steady(Adjustment):
            def step(self, force: Array) -> float:
                asked.append(spy.asked)
                return length

        likely_shapes(
            true,
            rotations,
            floor=0.01,
            max_iterations=20,
            tolerance=1.0,
            lengths=spy,
            adjustment=Steady(rotations, np.ones((1, 30, 3))),
        )
        # From the sixth round on, to the twelfth of twenty at most, or until all has settled.
        assert asked == [0] * steps
        assert spy.asked == 3


class TestShrinkage:
    @staticmethod
    def part(shapes: Array, shrinkage: float) -> float:
        """Return that of the simpler model, beside one of the plain covariance."""
        frames, _, points = shapes.shape
        axis = turning(frames, 4.0)[:, 2]
        plain, mixed = (
            first_model(shapes, axis, 1e-12, each).covariance for each in (0.0, shrinkage)
        )
        blocks = plain.reshape(3, points, 3, points)
        of_axes = sum(blocks[:, i, :, i] for i in range(points))
        of_points = sum(blocks[k, :, k] for k in range(3))
        simpler = np.kron(of_axes, of_points) / np.trace(plain)
        both = np.stack([plain.ravel(), simpler.ravel()], axis=1)
        (rest, part), *_ = np.linalg.lstsq(both, mixed.ravel(), rcond=None)
        np.testing.assert_allclose(mixed, rest * plain + part * simpler, atol=1e-9)
        assert rest + part == pytest.approx(1.0)
        return float(part / rest)

    @pytest.mark.parametrize("frames", [10, 100])
    def test_frames_that_are_alike_count_less(self, frames: int) -> None:
        """Beside one shape, T (1 - a^2) / (1 + a^2) of them, here with a of 0.9."""
        independent = 1.0 + frames * 0.19 / 1.81
        found = self.part(sample(model(3, 0.9), frames), 0.005)
        assert found == pytest.approx(0.005 / independent, rel=1e-4)

    def test_shapes_that_are_simple_are_left_alone(self) -> None:
        many, few = (sample(model(6, 0.9, rank=rank), 60) for rank in (18, 4))
        assert self.part(many, 0.2) > 0.01
        assert self.part(few, 0.2) < 1e-4

    def test_shapes_at_rest_stay_so(self) -> None:
        still = np.zeros((20, 3, 4))
        found = first_model(still, turning(20, 4.0)[:, 2], 1e-9, 0.07)
        np.testing.assert_array_equal(found.covariance, 1e-9 * np.eye(12))

    def test_the_frame_of_the_object_does_not_matter(self) -> None:
        shapes, rotations = sample(model(4, 0.9), 20), turning(20, 4.0)
        turn = so3.exp(np.array([0.3, -0.5, 0.8]))
        plain, turned = (
            first_model(each, cameras[:, 2], 1e-9, 0.5)
            for each, cameras in ((shapes, rotations), (turn @ shapes, rotations @ turn.T))
        )
        mixing = np.kron(turn, np.eye(4))
        np.testing.assert_allclose(
            turned.covariance, mixing @ plain.covariance @ mixing.T, atol=1e-12
        )

    def test_of_few_shapes_that_are_not_so_simple_less_is_wrong(self) -> None:
        errors = []
        for seed in range(3):
            rng = np.random.default_rng(seed)
            factor = rng.standard_normal((36, 36)) / np.arange(1, 37)
            covariance = factor @ factor.T + 1e-6 * np.eye(36)
            true = sample(Deformation(rng.standard_normal(36), covariance, 0.99), 100, seed)
            rotations = turning(100, 4.0)
            start = low_rank_shapes((rotations[:, :2] @ true).reshape(200, 12), rotations).shapes
            found = (
                likely_shapes(
                    start,
                    rotations,
                    floor=0.001,
                    max_iterations=60,
                    tolerance=0.0,
                    shrinkage=shrinkage,
                ).shapes
                for shrinkage in (0.0, 0.07)
            )
            errors.append([float(np.linalg.norm(S - true)) for S in found])
        without, shrunk = np.exp(np.log(errors).mean(axis=0))
        assert shrunk < 0.95 * without


class TestLikelyShapes:
    def test_a_sample_of_the_process_is_found_better_than_by_the_nuclear_norm(self) -> None:
        true = sample(model(12, 0.95, rank=4), 150)
        rotations = turning(150, 4.0)
        W = (rotations[:, :2] @ true).reshape(300, 12)
        start = low_rank_shapes(W, rotations).shapes
        found = likely_shapes(start, rotations, floor=0.001, max_iterations=60, tolerance=0.0)
        before, after = (float(np.linalg.norm(S - true)) for S in (start, found.shapes))
        assert after < 0.5 * before

    def test_the_correlation_is_learnt(self) -> None:
        rotations = turning(150, 4.0)
        learnt = []
        for correlation in (0.3, 0.7, 0.98):
            true = sample(model(6, correlation, rank=5), 150)
            found = likely_shapes(true, rotations, floor=0.001, max_iterations=10, tolerance=0.0)
            learnt.append(found.deformation.correlation)
        np.testing.assert_allclose(learnt, [0.3, 0.7, 0.98], atol=0.15)

    def test_the_least_variance_bounds_what_is_believed(self) -> None:
        true, rotations = sample(model(6, 0.9, rank=3), 60), turning(60, 6.0)
        for floor in (0.01, 0.3):
            found = likely_shapes(true, rotations, floor=floor, max_iterations=3, tolerance=0.0)
            least = np.linalg.eigvalsh(found.deformation.covariance)[0]
            assert least >= (1.0 - 1e-9) * floor**2 * (true**2).sum() / 180

    def test_the_tracks_become_likelier_and_stay_as_they_are(self) -> None:
        true = sample(model(5, 0.8, rank=3), 60)
        rotations = turning(60, 10.0)
        W = (rotations[:, :2] @ true).reshape(120, 5)
        start = low_rank_shapes(W, rotations).shapes
        values = []
        for rounds in (1, 40):
            found = likely_shapes(
                start, rotations, floor=0.001, max_iterations=rounds, tolerance=0.0
            )
            assert found.iterations == rounds
            np.testing.assert_allclose(
                (rotations[:, :2] @ found.shapes).reshape(W.shape), W, atol=1e-9
            )
            values.append(dense_log_likelihood(found.deformation, found.shapes, rotations))
        assert values[1] > values[0] + 5.0

    @pytest.mark.parametrize("scale", [1e-4, 1e3])
    def test_units_do_not_matter(self, scale: float) -> None:
        true, rotations = sample(model(6, 0.9, rank=3), 30), turning(30, 6.0)
        start = without_depth(true, rotations) + 0.5 * (true - without_depth(true, rotations))
        plain, scaled = (
            likely_shapes(k * start, rotations, floor=0.01, max_iterations=5, tolerance=0.0)
            for k in (1.0, scale)
        )
        np.testing.assert_allclose(scaled.shapes, scale * plain.shapes, atol=1e-7 * scale)
        assert scaled.change == pytest.approx(plain.change, rel=1e-6)

    def test_it_stops_where_little_changes_and_reports(self) -> None:
        true, rotations = sample(model(6, 0.9, rank=3), 30), turning(30, 6.0)
        seen: list[tuple[float, int]] = []
        found = likely_shapes(
            true,
            rotations,
            floor=0.01,
            max_iterations=50,
            tolerance=0.5,
            hook=lambda fraction, iteration, _: seen.append((fraction, iteration)),
        )
        assert found.iterations == 9
        assert found.change < 0.5
        assert seen == [(count / 50, count) for count in range(1, 10)]


def test_a_geometric_series_is_extrapolated_to_its_limit() -> None:
    limit, start = np.array([3.0, -1.0]), np.array([1.0, 2.0])
    series = [limit + 0.8**k * start for k in range(3)]
    np.testing.assert_allclose(extrapolated(*series), limit, atol=1e-12)
    slow = [limit + 0.999**k * start for k in range(3)]
    moved = np.linalg.norm(extrapolated(*slow) - slow[0]) / np.linalg.norm(slow[1] - slow[0])
    assert 8.0 < moved < 16.1
