from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smsr import rotations as so3


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix()


def test_completed_cameras_are_rotations() -> None:
    G = random_rotations(20)
    np.testing.assert_allclose(so3.complete(G[:, :2]), G, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.1])
def test_log_inverts_exp(angle: float) -> None:
    axis = np.array([[1.0, -2.0, 0.5]])
    vector = angle * axis / np.linalg.norm(axis)
    np.testing.assert_allclose(so3.log(so3.exp(vector)), vector, atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 2.0, 5.0])
def test_left_jacobian_is_the_derivative_of_exp(size: float) -> None:
    v = size * np.array([[0.6, -0.48, 0.64]])
    J = so3.left_jacobian(v)[0]
    h = 1e-6
    for axis in range(3):
        d = np.zeros((1, 3))
        d[0, axis] = h
        turn = so3.log(so3.exp(v + d) @ so3.exp(v - d).transpose(0, 2, 1))[0] / (2 * h)
        np.testing.assert_allclose(J[:, axis], turn, atol=1e-8)


def test_nearest_cameras_have_orthonormal_rows_and_are_nearest() -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((30, 2, 3))
    nearest = so3.nearest_cameras(rows)
    np.testing.assert_allclose(
        nearest @ nearest.transpose(0, 2, 1), np.broadcast_to(np.eye(2), (30, 2, 2)), atol=1e-12
    )
    distance = ((nearest - rows) ** 2).sum(axis=(1, 2))
    for seed in range(20):
        other = random_rotations(30, seed)[:, :2]
        assert (((other - rows) ** 2).sum(axis=(1, 2)) >= distance - 1e-12).all()


@pytest.mark.parametrize("rows", [np.zeros((1, 2, 3)), np.ones((1, 2, 3))])
def test_degenerate_rows_still_give_a_camera(rows: np.ndarray) -> None:
    R = so3.nearest_cameras(rows)[0]
    np.testing.assert_allclose(R @ R.T, np.eye(2), atol=1e-12)


def test_a_mirrored_camera_sees_the_mirrored_shape_the_same() -> None:
    G = random_rotations(10)
    S = np.random.default_rng(1).standard_normal((10, 3, 6))
    mirrored = so3.mirror(G)
    np.testing.assert_allclose(np.linalg.det(mirrored), 1.0)
    seen = mirrored[:, :2] @ (S * np.array([1.0, 1.0, -1.0])[:, None])
    np.testing.assert_allclose(seen, G[:, :2] @ S, atol=1e-14)
    np.testing.assert_allclose(so3.mirror(mirrored), G, atol=1e-14)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 180.0])
def test_spread_of_views_is_the_widest_angle(degrees: float) -> None:
    angles = np.radians(degrees) * np.array([0.3, 0.0, 0.9, 1.0, 0.5])
    rotations = so3.exp(angles[:, None] * np.array([0.0, 1.0, 0.0])) @ random_rotations(1)
    assert so3.spread_of_views(rotations) == pytest.approx(np.radians(degrees), abs=1e-7)


def test_scales_are_the_lengths_of_rows() -> None:
    cameras = random_rotations(5)[:, :2]
    scales = np.array([0.5, 1.0, 1.5, 2.0, 0.0])
    found = so3.camera_scales(scales[:, None, None] * cameras)
    np.testing.assert_allclose(found, scales, atol=1e-12)
    assert (found > 0.0).all()  # so that they can be divided by


def test_scales_of_rounded_cameras_are_one() -> None:
    np.testing.assert_array_equal(
        so3.camera_scales(random_rotations(5)[:, :2].round(5)), np.ones(5)
    )
