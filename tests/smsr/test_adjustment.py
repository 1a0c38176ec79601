from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr import rotations as so3
from smsr.shapes.adjustment import SETTLED, Adjustment
from tests.limbs import turning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

FRAMES = 40
ROTATIONS = turning(FRAMES, 3.0)
FIELDS = np.random.default_rng(0).standard_normal((2, FRAMES, 3)) / math.sqrt(3 * FRAMES)


def force(change: Array, goal: Array, curvature: Array) -> Array:
    """Return that of a log-likelihood whose maximum is at the goal, `curvature` a frame."""
    wanted = -FRAMES * curvature * (change - goal)
    flat = FIELDS.reshape(2, -1)
    return (np.linalg.pinv(flat) @ wanted).reshape(FRAMES, 3)


def settled(goal: Array, curvature: Array) -> tuple[Array, int]:
    """Return where steps end, and how many there were."""
    adjustment = Adjustment(ROTATIONS, FIELDS)
    for count in range(1, 60):  # noqa: B007
        if adjustment.step(force(adjustment.change, goal, curvature)) <= SETTLED / 10:
            break
    return adjustment.change, count


@pytest.mark.parametrize(
    "per_degree", [(0.03, 0.03), (0.1, 0.1), (1.0, 1.0), (20.0, 20.0), (60.0, 60.0), (0.3, 3.0)]
)
def test_steps_end_between_the_goal_and_the_start(per_degree: tuple[float, float]) -> None:
    goal = np.radians([2.0, -1.0])
    curvature = np.array(per_degree) * math.degrees(1.0) ** 2
    change, count = settled(goal, curvature)
    # A normal prior of a degree, against as many frames of likelihood.
    prior = 1.0 / math.radians(1.0) ** 2
    expected = goal * FRAMES * curvature / (FRAMES * curvature + prior)
    np.testing.assert_allclose(change, expected, atol=SETTLED)
    assert count < 40


def test_where_the_model_changes_more_than_the_cameras_steps_stay_short() -> None:
    adjustment = Adjustment(ROTATIONS, FIELDS)
    curvature = np.full(2, 300.0)
    for _ in range(20):
        adjustment.step(force(adjustment.change, np.radians([2.0, -1.0]), curvature))
    before = adjustment.change
    # The goal moves on by a tenth of a degree, and the gradient with it, against the last step.
    for goal in ([2.1, -1.0], [2.0, -1.0], [2.1, -1.0], [2.0, -1.0]):
        adjustment.step(force(adjustment.change, np.radians(goal), curvature))
        assert np.degrees(np.linalg.norm(adjustment.change - before)) < 0.25


def test_cameras_do_not_go_far_and_not_all_at_once() -> None:
    adjustment = Adjustment(ROTATIONS, FIELDS)
    goal = np.radians([90.0, 0.0])
    curvature = np.full(2, 3000.0)
    first = adjustment.step(force(adjustment.change, goal, curvature))
    assert first == pytest.approx(math.radians(1.0))
    for _ in range(50):
        adjustment.step(force(adjustment.change, goal, curvature))
    assert np.abs(adjustment.change).max() <= math.radians(6.0)


def test_a_part_of_the_change_turns_cameras_by_the_fields() -> None:
    adjustment = Adjustment(ROTATIONS, FIELDS)
    np.testing.assert_array_equal(adjustment.rotations(), ROTATIONS)
    adjustment.step(force(adjustment.change, np.radians([2.0, -1.0]), np.full(2, 300.0)))
    turns = np.tensordot(0.5 * adjustment.change, FIELDS, axes=1)
    np.testing.assert_allclose(adjustment.rotations(0.5), so3.exp(turns) @ ROTATIONS, atol=1e-14)
