from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import smsr.metrics
from smsr.errors import (
    AmbiguousLayout,
    GroundTruthMismatch,
    InvalidOption,
    NotFinite,
    NotNumeric,
    WrongShape,
)
from smsr.files import open_array
from smsr.metrics import as_shapes, evaluate
from smsr.result import MovingSurface
from smsr.synthetic import Example, make_low_rank

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def reconstruction(shapes: NDArray[np.float64], cameras: NDArray[np.float64]) -> MovingSurface:
    return MovingSurface(shapes.copy(), cameras.copy(), np.zeros((len(shapes), 2)))


def perfect(example: Example) -> MovingSurface:
    return reconstruction(example.ground_truth, example.cameras)


def orthogonal(seed: int, sign: float) -> NDArray[np.float64]:
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    q[0] *= sign * np.sign(np.linalg.det(q))
    return q


def turned(example: Example, q: NDArray[np.float64]) -> MovingSurface:
    """The same scene with the object frame turned by q; the images stay."""
    return reconstruction(example.ground_truth @ q.T, example.cameras @ q.T)


def in_camera_frame(example: Example) -> NDArray[np.float64]:
    return np.asarray(perfect(example).in_camera_frame())


EXAMPLE = make_low_rank(12, 20, seed=5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turned_and_mirrored_truth_scores_zero(sign: float) -> None:
    q = orthogonal(1, sign)
    offset = np.array([5.0, -2.0, 9.0])
    evaluation = evaluate(EXAMPLE.ground_truth + offset, turned(EXAMPLE, q))
    assert evaluation.frame == "object"
    assert evaluation.e3d == pytest.approx(0, abs=1e-12)
    assert evaluation.e3d_squared == pytest.approx(0, abs=1e-12)
    assert evaluation.e3d_per_frame == pytest.approx(0, abs=1e-12)
    assert evaluation.relative_rms == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(evaluation.alignment, q.T, atol=1e-9)


def test_a_case_worked_out_by_hand() -> None:
    # A cross with arms of 1, 2 and 3 on the axes: each axis has the variance 2 a^2 / 6.
    cross = np.array([[1, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 3], [0, 0, -3.0]])
    truth = np.stack([cross, 2 * cross, cross])
    shapes = truth.copy()
    # In the second frame one arm is 0.5 too long on both sides; the alignment stays the identity.
    shapes[1, 4, 2] += 0.5
    shapes[1, 5, 2] -= 0.5
    cameras = np.tile(np.eye(3)[:2], (3, 1, 1))
    evaluation = evaluate(truth, reconstruction(shapes, cameras), frame="object")

    sigma = (1 + 2 + 1) / 3 * (1 + 2 + 3) / 3 * math.sqrt(2 / 6)
    np.testing.assert_allclose(evaluation.per_frame, [0, 1 / (6 * sigma), 0], atol=1e-14)
    assert evaluation.e3d == pytest.approx(1 / (sigma * 3 * 6))
    assert evaluation.e3d_squared == pytest.approx(2 * 0.25 / (sigma * 3 * 6))
    assert evaluation.e3d_per_frame == pytest.approx(evaluation.e3d)
    norm = 2 * math.sqrt(2 * (1 + 4 + 9))
    assert evaluation.relative_rms == pytest.approx(math.sqrt(0.5) / norm / 3)
    np.testing.assert_allclose(evaluation.alignment, np.eye(3), atol=1e-14)


def test_one_alignment_charges_for_drift_and_one_for_each_frame_does_not() -> None:
    angles = np.linspace(-0.3, 0.3, 12)
    drift = np.tile(np.eye(3), (12, 1, 1))
    drift[:, 0, 0] = drift[:, 1, 1] = np.cos(angles)
    drift[:, 1, 0] = np.sin(angles)
    drift[:, 0, 1] = -drift[:, 1, 0]
    shapes = EXAMPLE.ground_truth @ drift.transpose(0, 2, 1)
    evaluation = evaluate(
        EXAMPLE.ground_truth, reconstruction(shapes, EXAMPLE.cameras), frame="object"
    )
    assert evaluation.e3d > 0.1
    assert evaluation.e3d_per_frame == pytest.approx(0, abs=1e-12)
    assert evaluation.e3d == pytest.approx(np.mean(evaluation.per_frame))


@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1e-3, 1e3),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_frames_units_and_order_of_points_do_not_matter(
    seed: int, scale: float, sign: float
) -> None:
    rng = np.random.default_rng(seed)
    shapes = EXAMPLE.ground_truth + 0.1 * rng.standard_normal(EXAMPLE.ground_truth.shape)
    before = evaluate(EXAMPLE.ground_truth, reconstruction(shapes, EXAMPLE.cameras), frame="object")
    q, order = orthogonal(seed, sign), rng.permutation(20)
    offset = rng.standard_normal((12, 1, 3))
    after = evaluate(
        scale * EXAMPLE.ground_truth[:, order],
        reconstruction(scale * (shapes @ q.T + offset)[:, order], EXAMPLE.cameras),
        frame="object",
    )
    assert after.e3d == pytest.approx(before.e3d, rel=1e-9)
    assert after.e3d_per_frame == pytest.approx(before.e3d_per_frame, rel=1e-9)
    assert after.relative_rms == pytest.approx(before.relative_rms, rel=1e-9)
    assert after.e3d_squared == pytest.approx(scale * before.e3d_squared, rel=1e-9)


def test_scale_is_charged() -> None:
    evaluation = evaluate(
        EXAMPLE.ground_truth, reconstruction(1.1 * EXAMPLE.ground_truth, EXAMPLE.cameras)
    )
    assert evaluation.relative_rms == pytest.approx(0.1)


@pytest.mark.parametrize("frame", ["object", "camera"])
def test_scale_is_free_under_cameras_of_varying_scale(frame: Literal["object", "camera"]) -> None:
    """They tell no absolute size; how sizes of frames compare does count."""
    truth = EXAMPLE.ground_truth if frame == "object" else in_camera_frame(EXAMPLE)
    scales = np.linspace(0.8, 1.2, len(truth))[:, None, None]
    smaller = reconstruction(EXAMPLE.ground_truth / 7.0, scales * EXAMPLE.cameras)
    evaluation = evaluate(truth, smaller)
    assert evaluation.frame == frame
    assert evaluation.scale == pytest.approx(7.0)
    assert evaluation.e3d == pytest.approx(0.0, abs=1e-12)
    assert evaluation.e3d_per_frame == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(evaluation.alignment @ evaluation.alignment.T, np.eye(3), atol=1e-12)
    grown = reconstruction(scales * EXAMPLE.ground_truth, scales * EXAMPLE.cameras)
    assert evaluate(truth, grown, frame=frame).e3d > 0.05
    assert evaluate(truth, perfect(EXAMPLE)).scale == 1.0


@pytest.mark.parametrize("form", ["rows", "points last", "float32", "fortran"])
def test_every_layout_of_the_truth_is_read(form: str) -> None:
    truth = EXAMPLE.ground_truth
    forms: dict[str, NDArray[Any]] = {
        "rows": truth.transpose(0, 2, 1).reshape(36, 20),
        "points last": truth.transpose(0, 2, 1),
        "float32": truth.astype(np.float32),
        "fortran": np.asfortranarray(truth.transpose(0, 2, 1).reshape(36, 20)),
    }
    assert evaluate(forms[form], perfect(EXAMPLE)).e3d < (1e-6 if form == "float32" else 1e-12)


def test_blocks_of_points_give_what_one_block_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    shapes = EXAMPLE.ground_truth + 0.1 * rng.standard_normal((12, 20, 3)) + 100.0
    whole = evaluate(EXAMPLE.ground_truth - 50.0, reconstruction(shapes, EXAMPLE.cameras))
    monkeypatch.setattr(smsr.metrics, "_BLOCK_BYTES", 24 * 12 * 7)
    parts = evaluate(EXAMPLE.ground_truth - 50.0, reconstruction(shapes, EXAMPLE.cameras))
    assert parts.e3d == pytest.approx(whole.e3d, rel=1e-12)
    np.testing.assert_allclose(parts.per_frame, whole.per_frame, rtol=1e-11)
    assert parts.relative_rms == pytest.approx(whole.relative_rms, rel=1e-12)


def test_shapes_of_a_dask_array_are_computed_by_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    dask_array = pytest.importorskip("dask.array", reason="dask is not installed")
    monkeypatch.setattr(smsr.metrics, "_BLOCK_BYTES", 24 * 12 * 7)
    seen = []

    def count(block: NDArray[np.float64]) -> NDArray[np.float64]:
        seen.append(block.shape[1])
        return block

    shapes = dask_array.from_array(EXAMPLE.ground_truth, chunks=(12, 7, 3))
    shapes = shapes.map_blocks(count, dtype=np.float64, meta=np.empty((0, 0, 0)))
    result = MovingSurface(shapes, EXAMPLE.cameras, np.zeros((12, 2)))
    assert evaluate(EXAMPLE.ground_truth, result).e3d == pytest.approx(0, abs=1e-12)
    assert sorted(seen) == [6, 6, 7, 7, 7, 7]  # two passes, and each block once in each


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("where", ["camera", "object"])
@pytest.mark.parametrize("seed", range(4))
def test_the_frame_of_the_truth_is_found(
    where: Literal["camera", "object"], noise: float, seed: int
) -> None:
    example = make_low_rank(40, 60, seed=seed)
    rng = np.random.default_rng(seed)
    truth = in_camera_frame(example) if where == "camera" else example.ground_truth
    shapes = example.ground_truth + noise * rng.standard_normal((40, 60, 3))
    evaluation = evaluate(truth, reconstruction(shapes, example.cameras))
    assert evaluation.frame == where
    assert (evaluation.e3d < 1e-9) == (noise == 0.0)
    told = evaluate(truth, reconstruction(shapes, example.cameras), frame=where)
    assert told.to_dict() == evaluation.to_dict()


def test_truth_of_a_camera_with_other_axes_and_units_is_in_the_camera_frame() -> None:
    """Image rows may be the truth's y and z, point downwards, or be measured in pixels."""
    truth = in_camera_frame(EXAMPLE)
    for other in (truth[:, :, [2, 0, 1]], truth * [1, -1, -1], 640 * truth):
        assert evaluate(other, perfect(EXAMPLE)).frame == "camera"
    assert evaluate(truth[:, :, [2, 0, 1]], perfect(EXAMPLE)).e3d == pytest.approx(0, abs=1e-12)


def test_the_frame_is_found_when_the_cameras_are_wrong() -> None:
    """Only the images R S count, and any turn within each frame leaves them as they are."""
    rng = np.random.default_rng(2)
    turns = np.linalg.qr(rng.standard_normal((12, 3, 3)))[0]
    wrong = reconstruction(
        EXAMPLE.ground_truth @ turns.transpose(0, 2, 1),
        EXAMPLE.cameras @ turns.transpose(0, 2, 1),
    )
    assert evaluate(EXAMPLE.ground_truth, wrong).frame == "object"
    in_camera = evaluate(in_camera_frame(EXAMPLE), wrong)
    assert in_camera.frame == "camera"


def test_a_depth_sign_that_is_wrong_throughout_costs_nothing() -> None:
    mirror = np.diag([1.0, 1.0, -1.0])
    truth = in_camera_frame(EXAMPLE) @ mirror
    assert evaluate(truth, perfect(EXAMPLE)).e3d == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("points", [4, 5, 6])
def test_few_points_do_not_hide_a_turning_camera(points: int) -> None:
    example = make_low_rank(30, points, seed=1)
    assert evaluate(example.ground_truth, perfect(example)).frame == "object"
    assert evaluate(in_camera_frame(example), perfect(example)).frame == "camera"


@pytest.mark.parametrize(
    ("truth", "error"),
    [
        (np.zeros((36, 19)), GroundTruthMismatch),
        (np.zeros((33, 20)), GroundTruthMismatch),
        (np.zeros((20, 36)), GroundTruthMismatch),
        (np.zeros((12, 19, 3)), GroundTruthMismatch),
        (np.zeros((12, 3, 3)), AmbiguousLayout),
        (np.zeros(720), WrongShape),
        (np.zeros((12, 20, 3)), GroundTruthMismatch),  # all points coincide
        (np.zeros((12, 20, 3), complex), NotNumeric),
        (np.full((12, 20, 3), "x"), NotNumeric),
        (np.full((12, 20, 3), None), NotNumeric),
        ([[1.0, 2.0], [3.0]], WrongShape),
        (np.full((12, 20, 3), 1e200) * np.arange(20)[:, None], NotFinite),
    ],
)
def test_truth_that_does_not_fit_is_refused(truth: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        evaluate(truth, perfect(EXAMPLE))


def test_masked_truth_is_not_taken_for_values() -> None:
    truth = np.ma.array(EXAMPLE.ground_truth, mask=False)
    assert evaluate(truth, perfect(EXAMPLE)).e3d < 1e-9
    truth[3, 19, 1] = np.ma.masked
    with pytest.raises(NotFinite, match="frame 3, point 19, axis y"):
        evaluate(truth, perfect(EXAMPLE))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_place_of_a_value_that_is_not_finite_is_named(
    value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smsr.metrics, "_BLOCK_BYTES", 24 * 12 * 7)
    truth = EXAMPLE.ground_truth.copy()
    truth[3, 19, 1] = value
    with pytest.raises(NotFinite, match="frame 3, point 19, axis y") as caught:
        evaluate(truth, perfect(EXAMPLE))
    assert caught.value.context == {"frame": 3, "point": 19, "axis": "y"}


def test_frames_without_extent_do_not_make_the_relative_error_infinite() -> None:
    truth = EXAMPLE.ground_truth.copy()
    truth[0] = 1.0
    evaluation = evaluate(truth, perfect(EXAMPLE), frame="object")
    assert 0 < evaluation.e3d < 1
    assert evaluation.relative_rms == pytest.approx(0, abs=1e-12)


def test_unknown_frame_is_refused() -> None:
    with pytest.raises(InvalidOption, match="world"):
        evaluate(EXAMPLE.ground_truth, perfect(EXAMPLE), frame="world")  # type: ignore[arg-type]


def test_evaluation_becomes_json_and_cannot_be_changed() -> None:
    evaluation = evaluate(EXAMPLE.ground_truth, perfect(EXAMPLE))
    document = json.loads(json.dumps(evaluation.to_dict()))
    assert document["frame"] == "object"
    assert len(document["per_frame"]) == 12
    assert np.shape(document["alignment"]) == (3, 3)
    with pytest.raises(ValueError, match="read-only"):
        evaluation.alignment[0, 0] = 2.0


def test_as_shapes_makes_no_copy() -> None:
    rows = np.zeros((36, 20), np.float32)
    view = as_shapes(rows, 12, 20)
    assert view.shape == (12, 20, 3)
    assert np.shares_memory(view, rows)


@pytest.mark.data
@pytest.mark.parametrize("name", ["drink", "pickup", "stretch", "yoga"])
def test_published_sets_with_their_true_cameras_score_zero(
    name: str, evaluation_data: Path
) -> None:
    path = evaluation_data / "sparse" / f"{name}.mat"
    truth = open_array(path, role="ground_truth")
    cameras = np.asarray(open_array(path, key="Rs")).reshape(-1, 2, 3)
    shapes = as_shapes(truth, len(cameras), truth.shape[1])
    evaluation = evaluate(truth, reconstruction(shapes, cameras))
    assert evaluation.frame == "object"
    assert evaluation.e3d < 1e-12


@pytest.mark.data
def test_dance_is_in_the_camera_frame(evaluation_data: Path) -> None:
    path = evaluation_data / "sparse" / "dance.mat"
    truth = as_shapes(open_array(path, role="ground_truth"), 264, 75)
    measurements = open_array(path).reshape(264, 2, 75)
    # The image rows are the truth's y and z: the camera that sees them is one for all frames.
    camera = np.tile(np.eye(3)[1:], (264, 1, 1))
    np.testing.assert_allclose(
        camera @ (truth - truth.mean(axis=1, keepdims=True)).transpose(0, 2, 1),
        measurements - measurements.mean(axis=2, keepdims=True),
        atol=1e-9,
    )
    turns = np.linalg.qr(np.random.default_rng(0).standard_normal((264, 3, 3)))[0]
    evaluation = evaluate(
        truth, reconstruction(truth @ turns.transpose(0, 2, 1), camera @ turns.transpose(0, 2, 1))
    )
    assert evaluation.frame == "camera"


@pytest.mark.data
def test_dinosaur_is_in_the_object_frame(evaluation_data: Path) -> None:
    path = evaluation_data / "sparse" / "dinosaur.mat"
    truth = open_array(path, role="ground_truth")
    measurements = open_array(path).reshape(231, 2, 49)
    centred = measurements - measurements.mean(axis=2, keepdims=True)
    flat = np.concatenate([centred, np.zeros((231, 1, 49))], axis=1).transpose(0, 2, 1)
    cameras = np.tile(np.eye(3)[:2], (231, 1, 1))
    assert evaluate(truth, reconstruction(flat, cameras)).frame == "object"


@pytest.mark.data
@pytest.mark.parametrize("name", ["facecap", "samba"])
def test_dense_sets_are_told_apart_by_their_frame(name: str, evaluation_data: Path) -> None:
    path = evaluation_data / "dense" / f"{name}.npz"
    cameras = np.asarray(open_array(path, key="R"), np.float64)
    cameras = cameras.reshape(-1, 2, 3)
    world = open_array(path, key="S_world")
    shapes = np.asarray(as_shapes(world, len(cameras), world.shape[1]))
    result = reconstruction(shapes, cameras)
    for key, frame in (("S_world", "object"), ("S", "camera")):
        evaluation = evaluate(open_array(path, key=key), result)
        assert evaluation.frame == frame
        assert evaluation.e3d < 1e-4
