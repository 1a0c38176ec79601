from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info

import smsr
from smsr import Progress, evaluate, reconstruct
from smsr import rotations as so3
from smsr.benchmark.camera_paths import errors
from smsr.benchmark.sheets import sheet_tracks
from smsr.cameras import estimate_cameras, fix_gauge
from smsr.errors import Cancelled, InvalidOption, UnknownOption
from smsr.options import Options, resolve
from smsr.progress import STAGES
from smsr.rotations import complete
from smsr.shapes.estimate import planar_shapes
from smsr.shapes.selection import estimate_shapes
from smsr.synthetic import make_example, make_low_rank
from tests.limbs import limbs, turning
from tests.shaken import shaken

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

PRESETS = ("default", "paper")


def distances(shapes: NDArray[Any]) -> NDArray[Any]:
    """Return inner products of the points of each frame: no turn or mirror changes them."""
    products: NDArray[Any] = shapes @ shapes.transpose(0, 2, 1)
    return products


def orbit(frames: int = 40, points: int = 25, seed: int = 0) -> smsr.synthetic.Example:
    """A deforming shape under a camera that turns at a constant rate."""
    example = make_low_rank(frames, points, 1, amplitude=0.1, seed=seed)
    turn = np.radians(5.0) * np.arange(frames)[:, None] * np.array([0.1, 1.0, 0.0])
    cameras = Rotation.from_rotvec(turn).as_matrix()[:, :2]
    W: Array = (cameras @ example.ground_truth.transpose(0, 2, 1)).reshape(2 * frames, points)
    return dataclasses.replace(example, measurements=W, cameras=cameras)


SEQUENCES = {"orbit": orbit(), "nodding": make_low_rank(40, 25, 1, seed=1)}


@pytest.fixture(params=SEQUENCES)
def example(request: pytest.FixtureRequest) -> smsr.synthetic.Example:
    return SEQUENCES[request.param]


def assert_valid(result: smsr.Reconstruction, W: NDArray[Any], tolerance: float = 1e-9) -> None:
    """Check what holds for every reconstruction that does not smooth the measurements."""
    frames, points = len(W) // 2, W.shape[1]
    assert result.shapes.shape == (frames, points, 3)
    assert np.isfinite(result.shapes).all()
    eye = np.broadcast_to(np.eye(2), (frames, 2, 2))
    grams = result.cameras @ result.cameras.transpose(0, 2, 1)
    np.testing.assert_allclose(grams, eye, atol=1e-12)
    seen = result.cameras @ result.shapes.transpose(0, 2, 1) + result.translations[:, :, None]
    assert np.abs(seen.reshape(W.shape) - W).max() <= tolerance * np.abs(W).max()


class TestResult:
    @pytest.mark.parametrize("preset", PRESETS)
    def test_both_presets_run_all_stages(self, preset: str) -> None:
        example = make_example(40, 8)
        result = reconstruct(example.measurements, preset=preset)
        diagnostics = result.diagnostics
        assert tuple(stage.name for stage in diagnostics.stages) == STAGES
        assert set(diagnostics.seconds) == set(STAGES)
        assert diagnostics.converged
        assert evaluate(example.ground_truth, result).e3d < 0.1
        iterations = {stage.name: stage.iterations for stage in diagnostics.stages}
        assert iterations["cameras"] > 0
        assert iterations["shapes"] > 0
        assert (iterations["smoothing"] > 0) == (preset == "paper")
        json.dumps(diagnostics.to_dict(), allow_nan=False)

    def test_models_are_chosen_by_the_data(self) -> None:
        models = {
            name: reconstruct(example.measurements).diagnostics.camera_model
            for name, example in SEQUENCES.items()
        }
        assert models == {"orbit": "uniform", "nodding": "gimbal"}

    def test_measurements_are_reproduced(self, example: smsr.synthetic.Example) -> None:
        assert_valid(reconstruct(example.measurements), example.measurements)

    def test_weak_directions_keep_the_measurements_exact(self) -> None:
        W = make_low_rank(30, 80, 2, noise=0.02).measurements
        result = reconstruct(W, virtual_points=8, noise=0.0)
        assert_valid(result, W)

    def test_first_cameras_and_basis_size(self) -> None:
        example = orbit()
        result = reconstruct(example.measurements)
        np.testing.assert_allclose(result.cameras[20], np.eye(3)[:2], atol=1e-12)
        assert result.diagnostics.basis_size >= 2
        assert evaluate(example.ground_truth, result).e3d < 0.05

    def test_arrays_are_read_only(self, example: smsr.synthetic.Example) -> None:
        result = reconstruct(example.measurements)
        for array in (result.shapes, result.cameras, result.translations):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0.0
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.setflags(write=True)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
    def test_single_precision_stays_single(self, dtype: type) -> None:
        W: NDArray[Any] = (1000 * SEQUENCES["nodding"].measurements).astype(dtype)
        result = reconstruct(W)
        assert result.shapes.dtype == (np.float32 if dtype is np.float32 else np.float64)
        assert result.cameras.dtype == result.translations.dtype == np.float64
        assert_valid(result, W, tolerance=1e-5)

    def test_more_than_double_precision_is_taken_for_double(self) -> None:
        tracks = make_low_rank(20, 12, seed=3).measurements
        result = reconstruct(tracks.astype(np.longdouble))
        assert result.shapes.dtype == np.float64
        np.testing.assert_allclose(result.shapes, reconstruct(tracks).shapes, atol=1e-9)

    def test_deterministic(self, example: smsr.synthetic.Example) -> None:
        first, second = (reconstruct(example.measurements) for _ in range(2))
        np.testing.assert_array_equal(first.shapes, second.shapes)
        np.testing.assert_array_equal(first.cameras, second.cameras)

    def test_input_is_not_changed_and_threads_are_given_back(self) -> None:
        W = SEQUENCES["nodding"].measurements.copy()
        before = W.copy(), threadpool_info()
        reconstruct(W)
        np.testing.assert_array_equal(W, before[0])
        assert threadpool_info() == before[1]

    def test_folder(self, tmp_path: Path) -> None:
        W = SEQUENCES["orbit"].measurements
        result = reconstruct(W, out=tmp_path / "new" / "folder")
        folder = tmp_path / "new" / "folder"
        assert isinstance(result.shapes, np.memmap)
        shapes = np.load(folder / "shapes.npy")
        assert shapes.dtype == np.dtype("<f4")
        np.testing.assert_array_equal(shapes, result.shapes)
        np.testing.assert_allclose(shapes, reconstruct(W).shapes, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(np.load(folder / "cameras.npy"), result.cameras)
        np.testing.assert_array_equal(np.load(folder / "translations.npy"), result.translations)
        report = json.loads((folder / "report.json").read_text())
        assert report["camera_model"] == "uniform"
        assert report["options"]["preset"] == "default"


class TestInvariance:
    @pytest.fixture
    def plain(self, example: smsr.synthetic.Example) -> smsr.Reconstruction:
        return reconstruct(example.measurements)

    def test_order_of_points(
        self, example: smsr.synthetic.Example, plain: smsr.Reconstruction
    ) -> None:
        order = np.random.default_rng(0).permutation(25)
        shuffled = reconstruct(example.measurements[:, order])
        np.testing.assert_allclose(shuffled.shapes, plain.shapes[:, order], atol=1e-6)

    def test_translation_of_frames(
        self, example: smsr.synthetic.Example, plain: smsr.Reconstruction
    ) -> None:
        shift = 10.0 * np.random.default_rng(0).standard_normal((80, 1))
        moved = reconstruct(example.measurements + shift)
        np.testing.assert_allclose(moved.shapes, plain.shapes, atol=1e-6)
        np.testing.assert_allclose(
            moved.translations, plain.translations + shift.reshape(40, 2), atol=1e-9
        )

    @pytest.mark.parametrize("scale", [1e-6, 3.0, 1e5])
    def test_units(
        self, example: smsr.synthetic.Example, plain: smsr.Reconstruction, scale: float
    ) -> None:
        scaled = reconstruct(scale * example.measurements)
        np.testing.assert_allclose(scaled.shapes / scale, plain.shapes, atol=1e-6)
        np.testing.assert_allclose(scaled.cameras, plain.cameras, atol=1e-6)

    @pytest.mark.parametrize("degrees", [90.0, 33.0])
    def test_turned_image(
        self, example: smsr.synthetic.Example, plain: smsr.Reconstruction, degrees: float
    ) -> None:
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()[:2, :2]
        W = (turn @ example.measurements.reshape(40, 2, 25)).reshape(80, 25)
        turned = reconstruct(W)
        np.testing.assert_allclose(
            distances(turned.shapes), distances(plain.shapes), rtol=1e-5, atol=1e-5
        )

    def test_one_frame_translation_does_not_move_any_shape(self) -> None:
        W = SEQUENCES["nodding"].measurements
        far = W.copy()
        far[10:12] += 1e4
        np.testing.assert_allclose(reconstruct(far).shapes, reconstruct(W).shapes, atol=1e-6)

    def test_layouts(self, plain: smsr.Reconstruction, example: smsr.synthetic.Example) -> None:
        W = example.measurements
        stacked = np.concatenate([W[0::2], W[1::2]])
        tracks = W.reshape(40, 2, 25)
        for same in (
            reconstruct(stacked, layout="stacked"),
            reconstruct(tracks),
            reconstruct(tracks.transpose(0, 2, 1)),
        ):
            np.testing.assert_allclose(same.shapes, plain.shapes, atol=1e-9)


def test_noise_alone_is_reconstructed_too() -> None:
    for seed, frames, points in ((60, 14, 6), (206, 17, 6), (3, 20, 8)):
        W = np.random.default_rng(seed).standard_normal((2 * frames, points))
        for model in ("auto", "uniform"):
            assert_valid(reconstruct(W, camera_model=model, noise=0.0), W)
            assert np.isfinite(reconstruct(W, camera_model=model).shapes).all()


def test_on_a_grid_points_at_rest_are_found_whatever_their_order() -> None:
    """A sample in step with the rows of a grid of pixels would see one column of it."""
    side, frames = 64, 50
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, side)]))
    time = np.linspace(0.0, 1.0, frames)
    shape = np.stack([x, y, 0.8 * np.cos(1.5 * x) * np.cos(1.2 * y) + 0.3 * np.sin(4.0 * x)])
    left_part = np.clip((0.2 - x) / 0.15, 0.0, 1.0)
    twist = np.stack([0.3 * y, -0.3 * (x + 0.6), 0.5 * np.sin(2.0 * y)]) * left_part
    wave = np.stack([0.2 * np.sin(3.0 * y), 0.2 * np.cos(3.0 * x), 0.3 * np.cos(3.0 * y + x)])
    motion = np.sin(6.0 * time)[:, None, None] * 1.2 * twist
    motion = motion + np.sin(3.0 * time + 1.0)[:, None, None] * wave * left_part
    angles = [0.7 * np.sin(9 * time), 0.8 * np.sin(14 * time + 1.0), 0.6 * np.cos(11 * time)]
    turns = Rotation.from_euler("yxz", np.stack(angles, axis=1)).as_matrix()
    W = (turns[:, :2] @ (shape + motion)).reshape(2 * frames, -1)
    shuffled = W[:, np.random.default_rng(0).permutation(side**2)]
    unrest = [reconstruct(tracks).diagnostics.camera_criteria["unrest"] for tracks in (W, shuffled)]
    assert max(unrest) < 0.16


@pytest.mark.parametrize("method", ["nuclear", "reweighted", "auto"])
def test_where_points_rest_the_camera_sees_what_the_free_camera_saw(method: str) -> None:
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 1.0, 60)
    shapes = rng.standard_normal((3, 40)) + np.zeros((60, 1, 1))
    shapes[:, :, 20:] += 0.6 * np.sin(9.0 * time)[:, None, None] * rng.standard_normal((3, 20))
    angles = [0.7 * np.sin(9 * time), 0.8 * np.sin(14 * time + 1.0), 0.6 * np.cos(11 * time)]
    turns = Rotation.from_euler("yxz", np.stack(angles, axis=1)).as_matrix()
    W = (turns[:, :2] @ shapes).reshape(120, -1)
    rested = reconstruct(W, shape_method=method)
    free = reconstruct(W, shape_method=method, camera_model="relaxed")
    assert rested.diagnostics.camera_model == "relaxed"
    assert "turned to where points rest" in rested.diagnostics.camera_reason
    assert "keep to no axis" in rested.diagnostics.camera_reason
    depths = [
        np.einsum("ti,tni->tn", complete(one.cameras)[:, 2], one.shapes) for one in (rested, free)
    ]
    sign = np.sign((depths[0] * depths[1]).sum())
    np.testing.assert_allclose(depths[0], sign * depths[1], atol=1e-9 * np.abs(W).max())


def test_the_velocity_of_a_turn_is_adjusted_with_the_depths() -> None:
    rotations = turning(120, 4.0)
    W = (rotations[:, :2] @ limbs(120)).reshape(240, -1)
    speeds = []
    for method in ("auto", "reweighted"):
        result = reconstruct(W, shape_method=method)
        assert result.diagnostics.camera_model == "uniform"
        assert ("adjusted" in result.diagnostics.camera_reason) == (method == "auto")
        cameras = complete(result.cameras)
        speeds.append(so3.angles_between(cameras[1:], cameras[:-1]).mean())
    assert abs(speeds[0] - speeds[1]) > 1e-7


@pytest.mark.parametrize("preset", PRESETS)
def test_reduction_equals_the_run_on_all_points(preset: str) -> None:
    W = make_low_rank(12, 60, 2, noise=0.01).measurements
    reduced = reconstruct(W, preset=preset, smoothing=False, noise=0.0)
    options = resolve(Options(preset=preset), points=60)  # type: ignore[arg-type]
    centred = W - W.mean(axis=1, keepdims=True)
    left, values, right = np.linalg.svd(centred, full_matrices=False)
    estimate = fix_gauge(estimate_cameras(left, values / values[0], options, points=right))
    rotations = estimate.rotations
    shapes = estimate_shapes(
        centred / values[0],
        rotations,
        options,
        camera_model=estimate.model,
        coherent=estimate.coherent,
        simpler=estimate.simpler,
        simpler_share=estimate.simpler_share,
    ).shapes
    np.testing.assert_allclose(reduced.cameras, rotations[:, :2], atol=1e-8)
    expected = values[0] * shapes.transpose(0, 2, 1)
    np.testing.assert_allclose(reduced.shapes, expected, atol=1e-8 * np.abs(expected).max())


class TestProgress:
    @pytest.mark.parametrize("preset", PRESETS)
    def test_it_only_grows_and_passes_through_the_stages(self, preset: str) -> None:
        seen: list[Progress] = []
        reconstruct(make_example(30, 8).measurements, preset=preset, progress=seen.append)
        fractions = [report.fraction for report in seen]
        assert fractions == sorted(fractions)
        assert fractions[0] == 0.0
        assert fractions[-1] == pytest.approx(1.0)
        order = list(dict.fromkeys(report.stage for report in seen))
        assert tuple(order) == STAGES
        assert len({report.iteration for report in seen if report.stage == "shapes"}) > 10
        assert all(r.residual is None or np.isfinite(r.residual) for r in seen)

    @pytest.mark.parametrize("stage", STAGES)
    def test_returning_false_cancels_in_every_stage(self, stage: str, tmp_path: Path) -> None:
        def refuse(report: Progress) -> bool:
            return report.stage != stage

        with pytest.raises(Cancelled) as caught:
            reconstruct(SEQUENCES["orbit"].measurements, progress=refuse, out=tmp_path)
        assert caught.value.context == {"stage": stage}
        assert not (tmp_path / "report.json").exists()

    @pytest.mark.parametrize("value", [None, 0, True, ""])
    def test_other_return_values_do_not_cancel(self, value: object) -> None:
        def answer(_: Progress) -> object:
            return value

        reconstruct(SEQUENCES["nodding"].measurements[:12], progress=answer)

    def test_errors_of_the_callback_pass_through(self) -> None:
        def fail(_: Progress) -> None:
            raise LookupError("disk")

        with pytest.raises(LookupError, match="disk"):
            reconstruct(SEQUENCES["nodding"].measurements, progress=fail)


class TestOptions:
    def test_an_object_that_is_no_options_is_refused(self) -> None:
        with pytest.raises(InvalidOption, match="by name"):
            reconstruct(make_low_rank(6, 8, 1).measurements, options={"preset": "paper"})  # type: ignore[arg-type]

    def test_values_override_the_object(self) -> None:
        W = SEQUENCES["nodding"].measurements
        result = reconstruct(W, options=Options(camera_model="relaxed"), shape_iterations=7)
        assert result.diagnostics.options.camera_model == "relaxed"
        assert result.diagnostics.options.shape_iterations == 7
        shapes = result.diagnostics.stages[STAGES.index("shapes")]
        assert shapes.iterations == 7
        assert not shapes.converged
        assert not result.diagnostics.converged
        assert [c.code for c in result.diagnostics.cautions] == ["not-converged"]

    def test_mistakes_are_refused_before_any_work(self) -> None:
        W = SEQUENCES["nodding"].measurements
        with pytest.raises(UnknownOption, match="virtual_points"):
            reconstruct(W, virtual_point=3)
        with pytest.raises(InvalidOption, match="between"):
            reconstruct(W, options=Options(virtual_points=1))

    @pytest.mark.parametrize(
        ("values", "points", "expected"),
        [
            ({}, 10, (False, "auto", "auto")),
            ({"smoothing": True}, 10, (True, "auto", "auto")),
            ({"preset": "paper"}, 1000, (True, "paper", "paper")),
            ({"preset": "paper"}, 1001, (False, "paper", "paper")),
            ({"preset": "paper", "shape_method": "nuclear"}, 9, (True, "paper", "nuclear")),
        ],
    )
    def test_presets(
        self, values: dict[str, Any], points: int, expected: tuple[bool, str, str]
    ) -> None:
        options = resolve(Options(**values), points=points)
        assert (options.smoothing, options.camera_model, options.shape_method) == expected

    @pytest.mark.parametrize("camera_model", ["relaxed", "uniform", "paper"])
    @pytest.mark.parametrize("shape_method", ["nuclear", "reweighted", "paper"])
    def test_every_combination_runs(self, camera_model: str, shape_method: str) -> None:
        W = SEQUENCES["orbit"].measurements
        result = reconstruct(W, camera_model=camera_model, shape_method=shape_method)
        assert result.diagnostics.camera_model == camera_model
        assert_valid(result, W)
        assert evaluate(SEQUENCES["orbit"].ground_truth, result).e3d < 0.2

    def test_smoothing_takes_noise_away(self) -> None:
        example = make_low_rank(60, 40, 1, noise=0.1, seed=3)
        errors = [
            evaluate(
                example.ground_truth,
                reconstruct(example.measurements, smoothing=smoothing, basis_size=2, noise=0.0),
            ).e3d
            for smoothing in (False, True)
        ]
        assert errors[1] < errors[0]


def rigid(frames: int, points: int, degrees: float, flat: bool = False) -> Array:
    rng = np.random.default_rng(0)
    shape = rng.standard_normal((3, points))
    if flat:
        shape[2] = 0.0
    turn = np.radians(degrees) * np.arange(frames)[:, None] * np.array([0.3, 1.0, 0.0])
    cameras = Rotation.from_rotvec(turn).as_matrix()[:, :2]
    return np.asarray((cameras @ shape).reshape(2 * frames, points))


def degenerate() -> dict[str, Array]:
    """Return inputs with little to go by."""
    rng = np.random.default_rng(1)
    plain = SEQUENCES["nodding"].measurements
    collapsed = plain.copy()
    collapsed[20:22] = 1.0
    no_v = plain.copy()
    no_v[1::2] = 0.0
    lone = np.zeros((20, 9))
    lone[:, 0] = np.arange(20)
    return {
        "rigid": rigid(20, 12, 6.0),
        "flat": rigid(20, 12, 6.0, flat=True),
        "still": rigid(20, 12, 0.0),
        "line": np.outer(np.cos(np.arange(20.0)), np.arange(9.0)),
        "smallest": rng.standard_normal((6, 4)),
        "smallest rigid": rigid(3, 4, 20.0),
        "smallest still": rigid(3, 4, 0.0),
        "many frames, 4 points": make_low_rank(150, 4, 1).measurements,
        "4 frames, many points": make_low_rank(4, 300, 1).measurements,
        "repeated frames": plain.reshape(40, 2, 25)[np.repeat(np.arange(10), 4)].reshape(80, 25),
        "one collapsed frame": collapsed,
        "no vertical": no_v,
        "one point moves": lone,
        "noise": rng.standard_normal((40, 30)),
        "tiny": 1e-140 * plain,
        "far": plain + 1e7 * rng.standard_normal((80, 1)),
    }


class TestDegenerateInput:
    @pytest.mark.parametrize("preset", PRESETS)
    @pytest.mark.parametrize("name", list(degenerate()))
    def test_result_is_finite_and_explains_the_measurements(self, name: str, preset: str) -> None:
        W = degenerate()[name]
        result = reconstruct(W, preset=preset, smoothing=False, noise=0.0, camera_iterations=200)
        assert_valid(result, W, tolerance=1e-8)
        json.dumps(result.diagnostics.to_dict(), allow_nan=False)

    @pytest.mark.parametrize("name", list(degenerate()))
    def test_smoothing_survives_it(self, name: str) -> None:
        result = reconstruct(degenerate()[name], smoothing=True, shape_iterations=50)
        assert np.isfinite(result.shapes).all()

    @pytest.mark.parametrize(
        ("name", "code"),
        [
            ("rigid", "rigid"),
            ("still", "near-planar"),
            ("still", "little-rotation"),
            ("smallest still", "near-planar"),
        ],
    )
    def test_user_is_cautioned(self, name: str, code: str) -> None:
        cautions = reconstruct(degenerate()[name]).diagnostics.cautions
        assert code in [caution.code for caution in cautions]

    def test_a_sheet_is_seen_to_be_flat_and_warned_of_reversals(self) -> None:
        W, cameras, shapes = sheet_tracks("paper", "lissajous", seed=0)
        result = reconstruct(W)
        assert result.diagnostics.camera_model == "flat"
        assert_valid(result, W, tolerance=1e-8)
        found = errors(result.cameras, result.shapes.transpose(0, 2, 1), cameras, shapes)
        assert found.camera < 0.05
        (caution,) = result.diagnostics.cautions
        assert caution.code == "reversals"
        assert result.diagnostics.camera_criteria["frontal_views"] == 1.0
        assert "seen from the front once" in caution.message

    def test_a_board_that_does_not_deform(self) -> None:
        """Seen from the front once, its depth is no guess, and no caution says so."""
        result = reconstruct(degenerate()["flat"])
        assert result.diagnostics.camera_criteria["complexity"] < 0.02
        assert "near-planar" not in {caution.code for caution in result.diagnostics.cautions}
        thickness = np.linalg.svd(result.shapes[0] - result.shapes[0].mean(axis=0))[1]
        assert thickness[2] < 0.02 * thickness[1]

    def test_noise_alone_leaves_an_object_at_rest(self) -> None:
        digits = (
            "62201631 61130224 43061451 21213456 65152431 65653505 25036114 35324136 "
            "30044126 00556320 23304032 35442246 30621400 54230363 34206402 20554402 "
            "36531233 03021000 05200564 64530034 42255422 03653250 32663141 05626534"
        )
        tracks = np.array([[int(digit) - 3.0 for digit in row] for row in digits.split()])
        result = reconstruct(tracks, camera_model="uniform", camera_scale="varying")
        assert np.isfinite(result.shapes).all()

    def test_who_asks_for_relaxed_cameras_gets_them(self) -> None:
        W, _, _ = sheet_tracks("paper", "lissajous", seed=0)
        result = reconstruct(W, camera_model="relaxed")
        assert result.diagnostics.camera_model == "relaxed"
        assert "relaxed_complexity" not in result.diagnostics.camera_criteria

    def test_a_guess_of_the_width_is_told(self) -> None:
        """A board that rocks about one axis and is never seen from the front."""
        angles = np.radians(52.0 + 14.0 * np.sin(np.linspace(0.0, 9.0, 100)))
        points = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 40)) * [[1.0], [0.7], [0.0]]
        turn = so3.exp(angles[:, None] * np.array([0.0, 1.0, 0.0]))
        result = reconstruct((turn[:, :2] @ points).reshape(200, 40))
        assert "assumed-width" in {caution.code for caution in result.diagnostics.cautions}

    def test_a_path_of_the_camera_leaves_no_reversals(self) -> None:
        W, cameras, shapes = sheet_tracks("paper", "fast", seed=0)
        result = reconstruct(W)
        found = errors(result.cameras, result.shapes.transpose(0, 2, 1), cameras, shapes)
        assert found.object < 0.05
        assert (result.diagnostics.camera_model, result.diagnostics.cautions) == ("uniform", ())

    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_a_camera_held_in_the_hand_shows_depth(self, seed: int) -> None:
        """By its shake alone: cameras that stand still explain the tracks about as well."""
        W, cameras, shapes = shaken(seed=seed)
        result = reconstruct(W)
        found = errors(result.cameras, result.shapes.transpose(0, 2, 1), cameras, shapes)
        flat = errors(cameras[:, :2], planar_shapes(W, cameras), cameras, shapes)
        assert found.camera < 0.15 < 0.6 < flat.camera
        assert "weak-depth" not in {caution.code for caution in result.diagnostics.cautions}

    @pytest.mark.parametrize("degrees", [0.0, 2.0])
    def test_a_camera_that_does_not_turn_shows_none(self, degrees: float) -> None:
        """Nor does one that rolls about its viewing direction."""
        _, _, shapes = shaken()
        angles = np.random.default_rng(1).normal(0.0, np.radians(degrees), (len(shapes), 1))
        rolling = so3.exp(angles * np.array([0.0, 0.0, 1.0]))
        W = (rolling[:, :2] @ shapes).reshape(len(shapes) * 2, -1)
        result = reconstruct(W)
        depth = np.linalg.norm(result.shapes[..., 2]) / np.linalg.norm(result.shapes[..., :2])
        assert depth < 1e-3
        assert "weak-depth" in {caution.code for caution in result.diagnostics.cautions}

    def test_good_input_is_not_cautioned(self, example: smsr.synthetic.Example) -> None:
        assert reconstruct(example.measurements).diagnostics.cautions == ()

    def test_truncation_is_cautioned(self) -> None:
        W = np.random.default_rng(0).standard_normal((60, 50))
        cautions = reconstruct(W, virtual_points=10, noise=0.0).diagnostics.cautions
        assert "truncated" in [caution.code for caution in cautions]

    def test_rigid_object_is_exact_up_to_the_trace_bias(self) -> None:
        W = rigid(30, 20, 5.0)
        result = reconstruct(W)
        shape = result.shapes[15].astype(float)
        for other in result.shapes:
            np.testing.assert_allclose(other, shape, atol=2e-2)
        assert result.diagnostics.basis_size == 1

    @pytest.mark.parametrize(
        ("frames", "points", "noise", "degrees"), [(60, 30, 0.0028, 0.3), (6, 200, 0.01, 5.0)]
    )
    def test_noise_that_is_left_in_is_no_deformation(
        self, frames: int, points: int, noise: float, degrees: float
    ) -> None:
        """Too little to be taken off, or too few frames to tell."""
        rng = np.random.default_rng(0)
        shape = rng.standard_normal((3, points))
        shape -= shape.mean(axis=1, keepdims=True)
        shapes = np.repeat(shape[None], frames, axis=0)
        W = (turning(frames, degrees)[:, :2] @ shapes).reshape(2 * frames, points)
        W += noise * W.std() * rng.standard_normal(W.shape)
        result = reconstruct(W)
        assert result.diagnostics.camera_model == "rigid"
        assert evaluate(shapes, result, frame="object").e3d < 0.04

    def test_an_object_that_hardly_deforms_does_deform(self) -> None:
        """One shape for all frames leaves half a percent here."""
        rng = np.random.default_rng(0)
        mean, change = rng.standard_normal((2, 3, 30))
        shapes = mean + 0.01 * np.sin(0.2 * np.arange(60))[:, None, None] * change
        shapes -= shapes.mean(axis=2, keepdims=True)
        W = (turning(60, 4.0)[:, :2] @ shapes).reshape(120, 30)
        result = reconstruct(W)
        assert result.diagnostics.camera_model != "rigid"
        assert evaluate(shapes, result, frame="object").e3d < 0.002

    def test_low_rank_measurements_smaller_than_the_basis(self) -> None:
        W = SEQUENCES["nodding"].measurements
        assert_valid(reconstruct(W, basis_size=30), W)
