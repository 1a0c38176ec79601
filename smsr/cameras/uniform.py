"""Cameras that turn at a constant angular velocity: turntables, orbits, flights around an object.

Free cameras drift: a slow change of the estimated rotations hides in the deformation. A motion
model with three parameters cannot drift. `smsr.cameras.selection` says when it may be used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smsr import rotations as so3
from smsr.cameras.turn import Turn, steady_turn

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OUTLIER = 0.2  # radians; frames farther off count less in the fit
_FIT_STEPS = 8
_FIRST_WINDOW = 8  # frames


def fit_uniform_turn(rotations: NDArray[np.float64]) -> Turn:
    """Fit a turn of constant velocity to cameras, little disturbed by frames that are far off.

    Gauss-Newton steps with Huber weights on a window that grows from the middle frame, so that
    the angle of a fast turn is followed beyond half a turn.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    Turn
        Its angle is zero at frame T // 2.
    """
    frames = len(rotations)
    centre = frames // 2
    time = np.arange(frames) - centre
    velocity = np.median(so3.log(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)), axis=0)
    middle = _most_central(rotations, velocity)
    window = min(_FIRST_WINDOW, frames)
    while True:
        first = min(max(0, centre - window // 2), frames - window)
        part = slice(first, first + window)
        for _ in range(_FIT_STEPS):
            turned = time[part, None] * velocity
            model = so3.exp(turned)
            error = so3.log(rotations[part] @ (model @ middle).transpose(0, 2, 1))
            by_velocity = so3.left_jacobian(turned) * time[part, None, None]
            jacobian = np.concatenate([by_velocity, model], axis=2)
            weight = 1.0 / np.maximum(1.0, np.linalg.norm(error, axis=1) / _OUTLIER)
            step = np.linalg.lstsq(
                (jacobian * weight[:, None, None]).reshape(-1, 6),
                (error * weight[:, None]).ravel(),
                rcond=None,
            )[0]
            velocity = velocity + step[:3]
            middle = so3.exp(step[None, 3:])[0] @ middle
        if window == frames:
            break
        window = min(2 * window, frames)
    return steady_turn(time.astype(np.float64), velocity, middle)


def _most_central(
    rotations: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return, of the cameras near the middle turned back to it, the one nearest to all others."""
    frames = len(rotations)
    first = max(0, frames // 2 - 4)
    near = slice(first, first + 9)
    time = np.arange(frames)[near, None] - frames // 2
    back = so3.exp(-time * velocity) @ rotations[near]
    distances = np.linalg.norm(back[:, None] - back, axis=(2, 3)).sum(axis=1)
    central: NDArray[np.float64] = back[distances.argmin()]
    return central
