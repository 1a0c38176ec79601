from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr.files import load_faces, open_array
from smsr.synthetic import Example, make_example, make_low_rank, write_example

if TYPE_CHECKING:
    from pathlib import Path


def projected(example: Example) -> np.ndarray[tuple[int, int, int], np.dtype[np.float64]]:
    """Centred images of the truth under the cameras, (T, 2, N)."""
    images = example.cameras @ example.ground_truth.transpose(0, 2, 1)
    centred: np.ndarray[tuple[int, int, int], np.dtype[np.float64]] = images - images.mean(
        axis=2, keepdims=True
    )
    return centred


@pytest.mark.parametrize("example", [make_example(12, 10, seed=3), make_low_rank(12, 30, seed=3)])
def test_measurements_are_the_truth_seen_by_the_cameras(example: Example) -> None:
    tracks = example.measurements.reshape(12, 2, -1)
    np.testing.assert_allclose(
        tracks - tracks.mean(axis=2, keepdims=True), projected(example), atol=1e-9
    )
    np.testing.assert_allclose(example.ground_truth.mean(axis=1), 0, atol=1e-9)
    gram = example.cameras @ example.cameras.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.tile(np.eye(2), (12, 1, 1)), atol=1e-12)


def test_equal_seeds_give_equal_examples_and_others_do_not() -> None:
    first, again, other = make_example(8, 6), make_example(8, 6), make_example(8, 6, seed=1)
    np.testing.assert_array_equal(first.measurements, again.measurements)
    assert np.abs(first.measurements - other.measurements).max() > 1


@pytest.mark.parametrize("modes", [0, 1, 3])
def test_rank_follows_from_the_modes(modes: int) -> None:
    example = make_low_rank(40, 60, modes, seed=1)
    tracks = example.measurements.reshape(40, 2, -1)
    values = np.linalg.svd((tracks - tracks.mean(axis=2, keepdims=True)).reshape(80, -1))[1]
    assert np.count_nonzero(values > 1e-9 * values[0]) == 3 * (modes + 1)


def test_noise_has_the_deviation_asked_for() -> None:
    clean, noisy = make_low_rank(30, 500), make_low_rank(30, 500, noise=0.05)
    assert np.std(noisy.measurements - clean.measurements) == pytest.approx(0.05, rel=0.02)


def test_the_example_deforms_and_its_camera_turns() -> None:
    example = make_example()
    assert example.measurements.shape == (120, 1600)
    extent = np.linalg.norm(example.ground_truth, axis=2).mean()
    motion = np.linalg.norm(example.ground_truth - example.ground_truth.mean(axis=0), axis=2)
    assert 0.01 < motion.mean() / extent < 0.2
    views = np.cross(example.cameras[:, 0], example.cameras[:, 1])
    assert np.degrees(np.arccos((views @ views.T).clip(-1, 1))).max() > 60


def test_faces_are_a_surface_that_looks_outward() -> None:
    example = make_example(5, 12)
    faces = example.faces
    assert set(faces.ravel()) == set(range(144))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert counts.max() == 2  # no edge has more than two triangles
    assert np.count_nonzero(counts == 1) == 4 * 11  # and the border is the grid's
    corners = example.ground_truth[0][faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert normals.sum(axis=0)[2] > 0


def test_written_files_hold_the_example(tmp_path: Path) -> None:
    example = write_example(tmp_path / "new" / "folder", frames=6, side=5)
    folder = tmp_path / "new" / "folder"
    np.testing.assert_array_equal(open_array(folder / "measurements.npy"), example.measurements)
    np.testing.assert_array_equal(
        open_array(folder / "ground_truth.npy", role="ground_truth"), example.ground_truth
    )
    np.testing.assert_array_equal(load_faces(folder / "faces.npy", 25), example.faces)
