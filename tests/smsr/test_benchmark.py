from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import smsr
from smsr.benchmark import (
    DATASETS,
    METHODS,
    PUBLISHED,
    BenchmarkFailed,
    Dataset,
    Measurement,
    best_published,
    environment,
    load,
    run,
    select,
)
from smsr.errors import ArrayNotFound, InvalidOption
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from pathlib import Path

    from smsr.metrics import Frame

MEBIBYTE = 1 << 20


@pytest.fixture(scope="module")
def own_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of the form of the dense sets: ground truth in the camera's frame and in its own."""
    example = make_example(frames=30, side=8)
    depth = np.cross(example.cameras[:, 0], example.cameras[:, 1])
    rotations = np.concatenate([example.cameras, depth[:, None]], axis=1)
    in_camera_frame = rotations @ example.ground_truth.transpose(0, 2, 1)
    path = tmp_path_factory.mktemp("sets") / "mask.npz"
    np.savez(
        path,
        W=example.measurements,
        S=in_camera_frame.reshape(-1, 64),
        S_world=example.ground_truth.transpose(0, 2, 1).reshape(-1, 64),
        faces=example.faces,
    )
    return path


@pytest.fixture(scope="module")
def measured(own_set: Path) -> Measurement:
    ballast = np.ones(400 * MEBIBYTE, dtype=np.int8)  # must not count as the child's memory
    (dataset,) = select([str(own_set)])
    result = run(dataset, own_set.parent, threads=1)
    assert ballast.all()
    return result


def test_the_best_published_figure_of_each_set_is_the_smallest() -> None:
    assert best_published("drink") == ("CSF1", 0.0223)
    assert best_published("dinosaur") == ("SMSR (paper)", 0.4678)
    assert best_published("samba") is None


def test_every_published_row_has_a_source_and_the_six_sets() -> None:
    sparse = {dataset.name for dataset in DATASETS if dataset.file.startswith("sparse")}
    assert len(sparse) == 6
    assert set(PUBLISHED) == set(METHODS)
    for row in PUBLISHED.values():
        assert set(row) == sparse


def test_a_set_in_a_file_of_ones_own_is_measured_in_both_frames(
    measured: Measurement, own_set: Path
) -> None:
    assert (measured.name, measured.frames, measured.points) == ("mask", 30, 64)
    assert list(measured.e3d) == ["camera", "object"]
    with np.load(own_set) as arrays:
        result = smsr.reconstruct(arrays["W"])
        truths: dict[Frame, str] = {"camera": "S", "object": "S_world"}
        for frame, key in truths.items():
            expected = smsr.evaluate(arrays[key], result, frame=frame)
            assert measured.e3d[frame] == pytest.approx(expected.e3d, rel=1e-3)
            assert measured.e3d_per_frame[frame] <= measured.e3d[frame]


def test_peak_memory_is_that_of_the_set_alone(measured: Measurement) -> None:
    assert 0 < measured.start_bytes <= measured.peak_bytes
    assert measured.peak_bytes < 300 * MEBIBYTE, "the parent's memory was counted"


def test_options_reach_the_process(own_set: Path) -> None:
    (dataset,) = select([str(own_set)])
    paper = run(dataset, own_set.parent, options={"camera_model": "paper"})
    assert paper.camera_model == "paper"


def test_mistakes_are_found_before_a_process_starts(own_set: Path) -> None:
    with pytest.raises(ArrayNotFound, match="drink"):
        select(["drunk"])
    with pytest.raises(InvalidOption):
        run(select([str(own_set)])[0], own_set.parent, options={"preset": "fast"})


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkFailed, match=r"lost: .*nowhere\.npz"):
        run(Dataset("lost", "nowhere.npz", {"object": "S"}), tmp_path)


def test_the_environment_is_stated() -> None:
    where = environment(3)
    assert where.smsr == smsr.__version__
    assert where.numpy == np.__version__
    assert where.blas_threads == 3
    assert where.processors >= 1


@pytest.mark.data
@pytest.mark.parametrize("dataset", DATASETS, ids=lambda dataset: dataset.name)
def test_every_set_loads_with_the_truth_it_names(dataset: Dataset, evaluation_data: Path) -> None:
    measurements, truths = load(dataset, evaluation_data)
    rows, points = measurements.shape
    for truth in truths.values():
        assert truth.shape == (rows // 2 * 3, points)
