from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smsr import evaluate, reconstruct
from smsr import rotations as so3
from smsr.files import open_result
from smsr.files.npz import write_npz
from smsr.measurements import as_source
from smsr.options import Options
from smsr.reduction import Reduction
from smsr.rowspace import factorise
from smsr.scales import common_scales, growth, relaxed_scales, varying_scales
from tests.limbs import limbs, turning

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from smsr.result import Reconstruction
    from smsr.rowspace import RowSpace

    Array = NDArray[np.float64]


def approach(frames: int, factor: float = 2.0, swing: float = 0.1) -> Array:
    """Return scales (T,) of geometric mean 1: an object that comes nearer, to and fro."""
    x = np.linspace(0.0, 1.0, frames)
    logarithms = np.log(factor) * x + swing * np.sin(9.0 * x)
    scales: Array = np.exp(logarithms - logarithms.mean())
    return scales


def image(shapes: Array, rotations: Array, scales: Array | None = None) -> Array:
    """Return W (2T, N) of shapes (T, 3, N)."""
    W = rotations[:, :2] @ shapes
    if scales is not None:
        W = scales[:, None, None] * W
    seen: Array = W.reshape(2 * len(shapes), -1)
    return seen


FRAMES = 60
BODY, TURN = limbs(FRAMES), turning(FRAMES, 4.0)


class TestCommonScales:
    @given(st.integers(0, 2**16))
    @settings(max_examples=20, deadline=None)
    def test_are_those_of_most_distances(self, seed: int) -> None:
        """A third of the points moves as it likes; the rest keeps its distances but for noise."""
        rng = np.random.default_rng(seed)
        shapes = np.tile(rng.standard_normal((1, 3, 18)), (30, 1, 1))
        shapes[:, :, :5] += rng.standard_normal((30, 3, 5))
        shapes += 1e-3 * rng.standard_normal(shapes.shape)
        scales = rng.uniform(0.5, 2.0, 30)
        found = common_scales(scales[:, None, None] * shapes)
        np.testing.assert_allclose(found, scales / np.exp(np.log(scales).mean()), rtol=5e-3)

    def test_do_not_depend_on_turns_and_order(self) -> None:
        rng = np.random.default_rng(1)
        scaled = approach(FRAMES)[:, None, None] * BODY
        found = common_scales(scaled)
        turned = TURN @ scaled[:, :, rng.permutation(BODY.shape[2])]
        np.testing.assert_allclose(common_scales(turned), found, rtol=1e-9)

    def test_points_that_coincide_say_nothing(self) -> None:
        shapes = np.repeat(np.random.default_rng(2).standard_normal((1, 3, 4)), 6, axis=2)
        scales = approach(10)
        found = common_scales(scales[:, None, None] * shapes)
        np.testing.assert_allclose(found, scales, rtol=1e-9)

    def test_frames_without_extent_are_finite(self) -> None:
        shapes = np.random.default_rng(3).standard_normal((5, 3, 6))
        shapes[2] = 0.0
        assert np.isfinite(common_scales(shapes)).all()
        assert np.isfinite(common_scales(np.zeros((5, 3, 6)))).all()

    def test_growth_is_their_range(self) -> None:
        scales = approach(101, 3.0, swing=0.0)
        assert growth(scales[:, None, None] * BODY[:1]) == pytest.approx(3.0**0.9, rel=1e-6)


class TestRelaxedScales:
    def test_are_exact_for_a_rigid_object(self) -> None:
        rigid = np.repeat(BODY[:1], FRAMES, axis=0)
        scales = approach(FRAMES)
        space = factorise(as_source(image(rigid, TURN, scales)))
        found = relaxed_scales(Reduction.of(space, Options(noise=0.0)))
        np.testing.assert_allclose(found, scales, rtol=0.03)

    def test_are_near_for_one_that_moves(self) -> None:
        """Much nearer than the size of the object in the image is, where it is foreshortened."""
        scales = approach(FRAMES)
        W = image(BODY * np.array([[3.0], [1.0], [1.0]]), TURN, scales)
        size = np.linalg.norm(W.reshape(FRAMES, -1), axis=1)
        found = relaxed_scales(Reduction.of(factorise(as_source(W)), Options(noise=0.0)))
        assert np.log(found / scales).std() < 0.5 * np.log(size / scales).std()


class TestVaryingScales:
    def test_end_when_they_stay(self) -> None:
        """Given true shapes, the second round changes nothing."""
        scales = approach(FRAMES)
        space = factorise(as_source(image(BODY, TURN, scales)))
        rounds = []

        def sizes(of: RowSpace) -> Array:
            return np.asarray(np.linalg.norm(of.factor.reshape(FRAMES, -1), axis=1))

        def solve(divided: RowSpace, *_: object) -> Array:
            rounds.append(divided)
            shapes: Array = (scales * sizes(divided) / sizes(space))[:, None, None] * BODY
            return shapes

        found = varying_scales(space, Options(), solve)
        assert found.converged
        assert found.iterations == len(rounds) == len(found.residuals) == 2
        # Limbs keep their lengths exactly; what is left is the smoothing of scales in time.
        np.testing.assert_allclose(found.scales, scales, rtol=5e-3)


class TestReconstruction:
    @pytest.mark.parametrize("factor", [1.0, 2.0, 4.0])
    def test_is_that_of_an_object_which_stays(self, factor: float) -> None:
        scales = approach(FRAMES, factor)
        W = image(BODY, TURN, scales)
        still = evaluate(BODY, reconstruct(image(BODY, TURN)), frame="object")
        result = reconstruct(W, camera_scale="varying")
        error = evaluate(BODY, result, frame="object")
        assert error.e3d < 1.3 * still.e3d + 0.01
        np.testing.assert_allclose(result.scales, scales, rtol=0.03)
        assert error.scale == pytest.approx(1.0, abs=0.03)
        assert "size-changes" not in codes(result)

    @pytest.mark.parametrize("noise", [0.0, 0.05])
    def test_projects_to_the_tracks(self, noise: float) -> None:
        rng = np.random.default_rng(0)
        W = image(BODY, TURN, approach(FRAMES)) + rng.normal(0.0, noise, (2 * FRAMES, 26))
        W += rng.normal(0.0, 10.0, (2 * FRAMES, 1))
        result = reconstruct(W, camera_scale="varying")
        seen = result.cameras @ result.shapes.transpose(0, 2, 1) + result.translations[:, :, None]
        difference = seen.reshape(W.shape) - W
        if noise == 0.0:
            assert np.abs(difference).max() < 1e-9
        else:
            assert difference.std() < 1.2 * noise
        identity = np.broadcast_to(np.eye(3), (FRAMES, 3, 3))
        R = result.rotations
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), identity, atol=1e-12)
        np.testing.assert_allclose(
            result.cameras, result.scales[:, None, None] * R[:, :2], atol=1e-12
        )

    def test_does_not_depend_on_a_steady_approach(self) -> None:
        """The smoothing of scales keeps what grows at a constant rate as it is."""
        W = image(BODY, TURN)
        scales = approach(FRAMES, 3.0, swing=0.0)
        some = reconstruct(W, camera_scale="varying")
        other = reconstruct(np.repeat(scales, 2)[:, None] * W, camera_scale="varying")
        np.testing.assert_allclose(other.shapes, some.shapes, atol=1e-6 * np.abs(some.shapes).max())
        np.testing.assert_allclose(other.scales, scales * some.scales, rtol=1e-6)

    def test_does_not_depend_on_how_the_image_is_rotated(self) -> None:
        W = image(BODY, TURN, approach(FRAMES))
        turn = np.array([[0.8, -0.6], [0.6, 0.8]])
        some = reconstruct(W, camera_scale="varying")
        other = reconstruct(
            (turn @ W.reshape(FRAMES, 2, -1)).reshape(W.shape), camera_scale="varying"
        )
        np.testing.assert_allclose(other.scales, some.scales, rtol=1e-6)

    def test_does_not_depend_on_the_order_of_the_points(self) -> None:
        W = image(BODY, TURN, approach(FRAMES))
        order = np.random.default_rng(0).permutation(W.shape[1])
        some = reconstruct(W, camera_scale="varying")
        other = reconstruct(W[:, order], camera_scale="varying")
        np.testing.assert_allclose(other.shapes, some.shapes[:, order], atol=1e-4)

    def test_scales_that_jump_stay(self) -> None:
        scales = np.exp(np.random.default_rng(0).normal(0.0, 0.2, FRAMES))
        scales /= np.exp(np.log(scales).mean())
        result = reconstruct(image(BODY, TURN, scales), camera_scale="varying")
        np.testing.assert_allclose(result.scales, scales, rtol=0.03)

    def test_a_single_jump_stays(self) -> None:
        """However long the sequence is, and beside scales that change smoothly."""
        frames = 200
        scales = approach(frames) * np.where(np.arange(frames) < 120, 1.0, 1.5)
        scales /= np.exp(np.log(scales).mean())
        W = image(limbs(frames), turning(frames, 3.0), scales)
        result = reconstruct(W, camera_scale="varying")
        np.testing.assert_allclose(result.scales, scales, rtol=0.03)

    def test_noise_that_is_given_is_that_of_the_tracks(self) -> None:
        scales = approach(FRAMES, 8.0)
        noise = 0.02
        W = image(BODY, TURN, scales)
        W += noise * np.random.default_rng(0).standard_normal(W.shape)
        told = reconstruct(W, camera_scale="varying", noise=noise)
        assert told.diagnostics.noise == pytest.approx(noise)
        estimated = reconstruct(W, camera_scale="varying")
        assert estimated.diagnostics.noise == pytest.approx(noise, rel=0.4)
        errors = [evaluate(BODY, one, frame="object").e3d for one in (told, estimated)]
        assert max(errors) < 1.2 * min(errors)

    def test_a_rigid_object_is_exact(self) -> None:
        rigid = np.repeat(BODY[:1], FRAMES, axis=0)
        result = reconstruct(image(rigid, TURN, approach(FRAMES)), camera_scale="varying")
        assert result.diagnostics.camera_model == "rigid"
        assert evaluate(rigid, result, frame="object").e3d < 0.01

    def test_from_files_to_files(self, tmp_path: Path) -> None:
        W = image(BODY, TURN, approach(FRAMES))
        np.save(tmp_path / "W.npy", W)
        inside = reconstruct(W, camera_scale="varying")
        written = reconstruct(tmp_path / "W.npy", out=tmp_path / "out", camera_scale="varying")
        np.testing.assert_allclose(written.shapes, inside.shapes, atol=1e-5)
        np.testing.assert_allclose(np.load(tmp_path / "out" / "cameras.npy"), inside.cameras)
        single = {"cameras": written.cameras.astype(np.float32)}
        arrays = {"shapes": written.shapes, "translations": written.translations}
        write_npz(tmp_path / "result.npz", arrays | single)
        np.testing.assert_allclose(
            open_result(tmp_path / "result.npz").scales, inside.scales, rtol=1e-6
        )

    def test_with_gaps(self) -> None:
        rng = np.random.default_rng(0)
        W = image(BODY, TURN, approach(FRAMES))
        seen = rng.random((FRAMES, W.shape[1])) > 0.1
        result = reconstruct(W, visibility=seen, camera_scale="varying")
        np.testing.assert_allclose(result.scales, approach(FRAMES), rtol=0.05)

    @pytest.mark.parametrize(
        "options", [{"preset": "paper"}, {"smoothing": True}, {"camera_model": "relaxed"}]
    )
    def test_goes_with_other_options(self, options: dict[str, Any]) -> None:
        result = reconstruct(image(BODY, TURN, approach(FRAMES)), camera_scale="varying", **options)
        assert np.log(result.scales / approach(FRAMES)).std() < 0.1

    def test_reports_what_it_did(self) -> None:
        W = image(BODY, TURN, approach(FRAMES))
        stage = reconstruct(W, camera_scale="varying").diagnostics.stages[2]
        assert stage.name == "scales"
        assert stage.converged
        assert stage.iterations >= 1
        assert stage.reason.startswith("scale of the camera between 0.")
        assert reconstruct(W).diagnostics.stages[2].iterations == 0


class TestDegenerate:
    @pytest.mark.parametrize(("frames", "points"), [(3, 4), (4, 4), (5, 4), (12, 5), (3, 50)])
    def test_few_frames_or_points(self, frames: int, points: int) -> None:
        W = np.random.default_rng(0).standard_normal((2 * frames, points))
        result = reconstruct(W, camera_scale="varying")
        assert np.isfinite(result.shapes).all()
        assert np.isfinite(result.cameras).all()
        assert (result.scales > 0.0).all()

    @pytest.mark.parametrize("still", ["camera", "object", "both"])
    def test_what_stands_still(self, still: str) -> None:
        turn = TURN if still == "object" else so3.exp(np.zeros((FRAMES, 3)))
        body = BODY if still == "camera" else np.repeat(BODY[:1], FRAMES, axis=0)
        result = reconstruct(image(body, turn, approach(FRAMES)), camera_scale="varying")
        assert np.isfinite(result.shapes).all()
        np.testing.assert_allclose(result.scales, approach(FRAMES), rtol=0.15)

    @pytest.mark.parametrize("frames", [(10, 12), (0, 31), (12, 57)])
    def test_frames_in_which_all_points_coincide(self, frames: tuple[int, int]) -> None:
        """Their scales are those of their neighbours; the others are as they would be."""
        W = image(BODY, TURN, approach(FRAMES))
        W[2 * frames[0] : 2 * frames[1]] = 7.0
        result = reconstruct(W, camera_scale="varying")
        assert np.isfinite(result.shapes).all()
        assert np.isfinite(result.cameras).all()
        seen = np.ones(FRAMES, dtype=bool)
        seen[slice(*frames)] = False
        ratios = np.log(result.scales / approach(FRAMES))[seen]
        assert np.ptp(ratios) < 0.5


def codes(result: Reconstruction) -> set[str]:
    """Return the codes of the cautions."""
    return {caution.code for caution in result.diagnostics.cautions}


def test_an_object_that_grows_is_cautioned() -> None:
    grown = reconstruct(image(BODY, TURN, approach(FRAMES)))
    assert "size-changes" in codes(grown)
    (caution,) = (one for one in grown.diagnostics.cautions if one.code == "size-changes")
    assert "camera_scale='varying'" in caution.message
    assert "size-changes" not in codes(reconstruct(image(BODY, TURN)))
