from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr import rotations as so3
from smsr.benchmark.camera_paths import PATHS, errors, handheld, noisy_tracks
from smsr.benchmark.sheets import sheet_tracks
from smsr.cameras.flat import flat_views
from smsr.cameras.free import free_cameras
from smsr.cameras.likeliest import FROM_FAR, FROM_NEAR, likeliest_cameras, shaken_cameras
from smsr.errors import Cancelled
from smsr.pipeline import reconstruct
from smsr.progress import ignore
from tests.factored import factored
from tests.shaken import shaken

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.likeliest import ShakenCameras
    from smsr.progress import StageHook

    Array = NDArray[np.float64]


def tracks(frames: int = 120, seed: int = 0) -> tuple[Array, Array]:
    """Return virtual points under a camera in the hand, and the cameras."""
    W, true, _ = shaken(frames, seed=seed)
    left, values = factored(W)
    return left * values, true


def turning_by(part: float, rotations: Array) -> Array:
    """Return cameras that turn by a part of the angle only."""
    middle = rotations[len(rotations) // 2]
    turned: Array = so3.exp(part * so3.log(rotations @ middle.T)) @ middle
    return turned


class TestLikeliest:
    @pytest.mark.parametrize(("part", "seed"), [(0.3, 0), (0.3, 1), (0.5, 2), (1.25, 1)])
    def test_cameras_that_turn_too_little_or_too_much_are_mended(
        self, part: float, seed: int
    ) -> None:
        measurements, true = tracks(seed=seed)
        wrong = turning_by(part, true)
        found = likeliest_cameras(measurements, wrong, FROM_FAR)
        assert so3.angle_between_paths(found, true) < 0.5 * so3.angle_between_paths(wrong, true)
        np.testing.assert_allclose(
            found @ found.transpose(0, 2, 1), np.broadcast_to(np.eye(3), found.shape), atol=1e-9
        )

    def test_right_cameras_stay(self) -> None:
        measurements, true = tracks()
        found = likeliest_cameras(measurements, true, FROM_NEAR)
        assert so3.angle_between_paths(found, true) < math.radians(1.0)

    def test_the_size_of_the_tracks_does_not_matter(self) -> None:
        measurements, true = tracks(60)
        start, stages = turning_by(0.7, true), ((0.01, 8), (0.005, 8))
        found = likeliest_cameras(measurements, start, stages)
        other = likeliest_cameras(1e3 * measurements, start, stages)
        np.testing.assert_allclose(other, found, atol=1e-6)

    @pytest.mark.parametrize("sheet", ["paper", "cloth", "flag"])
    def test_cameras_of_a_flat_shape_come_nearer(self, sheet: str) -> None:
        """They are off by what the sheet bends."""
        W, true, _ = sheet_tracks(sheet, "lissajous", seed=0)
        left, values = factored(W)
        views = flat_views(left, values)
        assert views is not None
        start = views.nearest_to(true).rotations
        found = likeliest_cameras(left * values, start, FROM_NEAR)
        assert so3.angle_between_paths(found, true) < 0.95 * so3.angle_between_paths(start, true)

    def test_weak_virtual_points_do_not_count(self) -> None:
        W, true, _ = shaken(40)
        W += 0.01 * np.random.default_rng(0).standard_normal(W.shape)
        left, values = factored(W, 30)
        start, stages = turning_by(0.7, true), ((0.01, 8),)
        some = likeliest_cameras((left * values)[:, :18], start, stages)
        np.testing.assert_array_equal(likeliest_cameras(left * values, start, stages), some)

    def test_it_reports_and_can_be_stopped(self) -> None:
        measurements, true = tracks(40)
        reports: list[tuple[float, int]] = []

        def hook(fraction: float, iteration: int, residual: float | None) -> None:
            reports.append((fraction, iteration))
            if iteration == 9:
                raise Cancelled("enough", stage="cameras")

        with pytest.raises(Cancelled):
            likeliest_cameras(measurements, true, ((0.01, 6), (0.005, 6)), hook)
        assert reports == [(i / 12, i) for i in range(1, 10)]


def of_shaken(
    measurements: Array, first: Array, *more: Array, noise: float = 0.0, hook: StageHook = ignore
) -> ShakenCameras | None:
    return shaken_cameras(measurements, first, lambda: more, noise, hook)


def forbidden(fraction: float, iteration: int, residual: float | None) -> None:
    raise AssertionError("no camera should be turned")


class TestShaken:
    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_a_shake_tells_of_cameras_that_turn_too_little(self, seed: int) -> None:
        measurements, true = tracks(seed=seed)
        wrong = turning_by(0.3, true)
        found = of_shaken(measurements, wrong)
        assert found is not None
        assert found.steadiness > found.former_steadiness + 0.3
        assert so3.angle_between_paths(found.rotations, true) < 0.5 * so3.angle_between_paths(
            wrong, true
        )

    def test_of_two_starts_the_likelier_end_counts(self) -> None:
        measurements, true = tracks()
        rng = np.random.default_rng(0)
        astray = so3.exp(np.cumsum(0.03 * rng.standard_normal((len(true), 3)), axis=0))
        found = of_shaken(measurements, astray, turning_by(0.3, true))
        assert found is not None
        assert found.start == 1

    def test_cameras_that_go_far_around_are_no_shake(self) -> None:
        measurements, true = tracks()
        angles = np.linspace(-1.0, 1.0, len(true))[:, None] * np.array([0.0, 1.0, 0.0])
        assert of_shaken(measurements, so3.exp(0.3 * angles) @ true) is not None
        assert of_shaken(measurements, so3.exp(angles) @ true) is None

    def test_right_cameras_need_no_help(self) -> None:
        measurements, true = tracks(seed=1)
        assert of_shaken(measurements, true, hook=forbidden) is None

    def test_smooth_tracks_tell_nothing(self) -> None:
        _, _, shapes = shaken()
        slow = so3.exp(np.linspace(0.0, 0.5, len(shapes))[:, None] * np.array([0.1, 1.0, 0.0]))
        left, values = factored((slow[:, :2] @ shapes).reshape(2 * len(shapes), -1))
        assert of_shaken(left * values, turning_by(0.3, slow), hook=forbidden) is None

    def test_nor_do_those_of_a_hasty_object(self) -> None:
        W, true, shapes = shaken()
        order = np.random.default_rng(0).permutation(len(shapes))
        left, values = factored((true[:, :2] @ shapes[order]).reshape(W.shape))
        assert of_shaken(left * values, turning_by(0.3, true), hook=forbidden) is None

    def test_in_long_sequences_neighbours_are_compared_too(self) -> None:
        """Not only every n-th frame, which are less alike."""
        frames = 801
        rng = np.random.default_rng(0)
        true = handheld(np.arange(frames, dtype=np.float64), rng)
        time = 2.0 * np.pi * np.arange(frames) / 60.0
        weights = np.stack([np.ones(frames), 0.2 * np.cos(time), 0.15 * np.sin(1.5 * time)])
        shapes = np.tensordot(weights, rng.standard_normal((3, 3, 30)), axes=(0, 0))
        left, values = factored((true[:, :2] @ shapes).reshape(2 * frames, -1))
        assert of_shaken(left * values, turning_by(0.3, true)) is not None

    @pytest.mark.parametrize(("noise", "found"), [(0.4, True), (0.6, False)])
    def test_the_more_noise_the_steadier_they_must_be(self, noise: float, found: bool) -> None:
        measurements, true = tracks()
        assert (of_shaken(measurements, turning_by(0.3, true), noise=noise) is not None) == found

    def test_a_camera_that_rolls_only_does_not_shake(self) -> None:
        _, _, shapes = shaken()
        angles = np.random.default_rng(1).normal(0.0, np.radians(2.0), (len(shapes), 1))
        rolling = so3.exp(angles * np.array([0.0, 0.0, 1.0]))
        left, values = factored((rolling[:, :2] @ shapes).reshape(2 * len(shapes), -1))
        relaxed = free_cameras(left, values, relaxations_only=True).rotations
        assert of_shaken(left * values, relaxed) is None

    @pytest.mark.parametrize("sheet", [False, True])
    def test_it_tells_whether_the_mean_shape_is_flat(self, sheet: bool) -> None:
        W, true = sheet_tracks("cloth", "handheld", seed=1)[:2] if sheet else shaken()[:2]
        left, values = factored(W)
        found = of_shaken(left * values, turning_by(0.3, true))
        assert found is not None
        assert (found.flatness < 0.1) == sheet
        np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-9)


class TestFreeCamerasThatShake:
    @pytest.mark.parametrize("seed", [1, 2, 5])
    def test_a_little_noise_leads_them_astray_no_more(self, seed: int) -> None:
        W, rotations, shapes = shaken(seed=seed)
        W += 0.005 * np.abs(W).max() * np.random.default_rng(seed).standard_normal(W.shape)
        result, relaxed = (reconstruct(W, camera_model=model) for model in ("auto", "relaxed"))
        found, without = (
            errors(each.cameras, each.shapes.transpose(0, 2, 1), rotations, shapes).camera
            for each in (result, relaxed)
        )
        assert found < 0.3 < 0.5 < without
        diagnostics = result.diagnostics
        assert diagnostics.camera_model == "shaken"
        assert "held in the hand" in diagnostics.camera_reason
        criteria = diagnostics.camera_criteria
        assert criteria["steadiness"] > 0.5 > criteria["relaxed_steadiness"]
        assert not {"weak-depth", "reversals"} & {caution.code for caution in diagnostics.cautions}

    @pytest.mark.parametrize(("sheet", "seed"), [("cloth", 1), ("paper", 0), ("paper", 10)])
    def test_those_of_sheets_are_found_too(self, sheet: str, seed: int) -> None:
        W, true, _ = sheet_tracks(sheet, "handheld", seed=seed)
        found = free_cameras(*factored(W))
        assert found.model == "shaken"
        assert so3.angle_between_paths(found.rotations, true) < math.radians(8.0)

    def test_progress_never_goes_back(self) -> None:
        W, _, _ = sheet_tracks("torn", "handheld", noise=0.01, seed=0)
        fractions: list[float] = []
        free_cameras(*factored(W), noise=0.03, hook=lambda part, *_: fractions.append(part))
        assert len(fractions) > 100
        assert fractions == sorted(fractions)
        assert fractions[-1] <= 1.0


class TestFreeCamerasOfNoisyTracks:
    @staticmethod
    def noisy(path: str, seed: int, noise: float = 0.05) -> tuple[Array, Array, Array]:
        """Return W (2T, N), the cameras and the shapes."""
        shapes = shaken(seed=seed)[2]
        rng = np.random.default_rng(seed)
        rotations = PATHS[path](np.arange(len(shapes), dtype=np.float64), rng)
        return noisy_tracks(rotations, shapes, noise, rng), rotations, shapes

    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_they_are_turned_to_where_the_tracks_are_likeliest(self, seed: int) -> None:
        W, rotations, shapes = self.noisy("lissajous", seed)
        result, relaxed = (reconstruct(W, camera_model=model) for model in ("auto", "relaxed"))
        found, without = (
            errors(each.cameras, each.shapes.transpose(0, 2, 1), rotations, shapes).object
            for each in (result, relaxed)
        )
        assert found < 0.95 * without
        diagnostics = result.diagnostics
        assert diagnostics.camera_model == "relaxed"
        assert "tracks likeliest" in diagnostics.camera_reason
        assert "tracks likeliest" not in relaxed.diagnostics.camera_reason
        before = relaxed.diagnostics.camera_criteria["complexity"]
        assert diagnostics.camera_criteria["complexity"] < before

    @pytest.mark.parametrize(("path", "noise"), [("fast", 0.05), ("lissajous", 0.01)])
    def test_those_on_a_path_or_with_less_noise_are_not(self, path: str, noise: float) -> None:
        diagnostics = reconstruct(self.noisy(path, 1, noise)[0]).diagnostics
        assert diagnostics.camera_model == ("uniform" if path == "fast" else "relaxed")
        assert "tracks likeliest" not in diagnostics.camera_reason
