"""Rotations and orthographic cameras as arrays.

A camera R is 2 x 3 with orthonormal rows. Completed by the cross product of its rows, the viewing
direction, it is a rotation G (3 x 3). Sequences are (T, 2, 3) and (T, 3, 3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from numpy.typing import NDArray


def complete(cameras: NDArray[np.float64]) -> NDArray[np.float64]:
    """Complete cameras (T, 2, 3) to rotations (T, 3, 3) by the viewing direction."""
    depth = np.cross(cameras[:, 0], cameras[:, 1])
    return np.concatenate([cameras, depth[:, None]], axis=1)


def depths_along(axis: NDArray[np.float64], shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depths (T, N) of shapes (T, 3, N) along directions (T, 3)."""
    depths: NDArray[np.float64] = np.matmul(axis[:, None], shapes)[:, 0]
    return depths


def nearest_cameras(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cameras (T, 2, 3) with orthonormal rows nearest to any (T, 2, 3) array.

    The polar factor of each frame; well defined by a deterministic choice even where the two rows
    are parallel or zero.
    """
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    nearest: NDArray[np.float64] = left @ right
    return nearest


def exp(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations (T, 3, 3) of rotation vectors (T, 3) in radians."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def log(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vectors (T, 3), of angle at most pi, of rotations (T, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotations, assume_valid=True).as_rotvec())


def left_jacobian(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return J (T, 3, 3) with ``exp(v + d) = exp(J d) exp(v)`` to first order in d."""
    angle = np.linalg.norm(vectors, axis=1)
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    cross -= cross.transpose(0, 2, 1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    jacobian: NDArray[np.float64] = (
        np.eye(3) + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)
    )
    return jacobian


def nearest_rotations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations (..., 3, 3) nearest to any (..., 3, 3) array."""
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    nearest: NDArray[np.float64] = left @ right
    return nearest


def mean_rotation(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the chordal mean (3, 3) of rotations (T, 3, 3): the rotation nearest to their sum."""
    return nearest_rotations(rotations.sum(axis=0))


def angles_between(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles (T,), radians, between rotations (T, 3, 3)."""
    turns = first @ second.transpose(0, 2, 1)
    return np.asarray(Rotation.from_matrix(turns, assume_valid=True).magnitude())


def mirror(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cameras that see the shape mirrored in its depth at the identity camera.

    An orthographic camera cannot tell ``R S`` from ``(R D)(D S)`` with D = diag(1, 1, -1); the
    returned rotations (T, 3, 3) complete ``R D``.
    """
    flip = np.array([1.0, 1.0, -1.0])
    return complete(rotations[:, :2] * flip)


def angle_between_paths(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the root mean square angle of two camera paths (T, 3, 3), the object frames aligned.

    Of the two mirror images of the second path the nearer one counts.
    """
    angles = []
    for other in (second, mirror(second)):
        turn = mean_rotation(first.transpose(0, 2, 1) @ other)
        angles.append(float(np.sqrt((angles_between(first @ turn, other) ** 2).mean())))
    return min(angles)


SAME_SCALE = 1e-4
"""Deviation of a camera's scale from 1 that is rounding, as in a file of few digits."""


def camera_scales(cameras: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the scales (T,) of cameras (T, 2, 3), the length of their rows.

    They are exactly 1 where no camera has another.
    """
    scales: NDArray[np.float64] = np.sqrt((cameras**2).sum(axis=(1, 2)) / 2.0)
    if np.abs(scales - 1.0).max(initial=0.0) <= SAME_SCALE:
        return np.ones(len(scales))
    return np.maximum(scales, np.finfo(float).tiny)


def part_of_rotation(mean_square: float, rotations: NDArray[np.float64]) -> float:
    """Return which part of the variance of rotations (T, 3, 3) a mean squared angle makes up."""
    spread = ((rotations - rotations.mean(axis=0)) ** 2).sum(axis=(1, 2)).mean()
    # ||G - H||_F^2 is twice the squared angle between G and H, to second order.
    return 2.0 * mean_square / max(float(spread), np.finfo(float).tiny)


def spread_of_views(rotations: NDArray[np.float64]) -> float:
    """Return about the widest angle, in radians, between viewing directions of (T, 3, 3)."""
    axes = rotations[:, 2]
    # The farthest from the farthest: nearly the widest angle, without comparing all pairs.
    far = axes[(axes @ axes[0]).argmin()]
    return float(np.arccos(np.clip((axes @ far).min(), -1.0, 1.0)))
