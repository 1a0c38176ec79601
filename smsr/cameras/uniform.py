"""Cameras that turn at a constant angular velocity: turntables, orbits, flights around an object.

Free cameras drift: a slow change of the estimated rotations hides in the deformation. A motion
model with three parameters cannot drift. `smsr.cameras.selection` says when it may be used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from smsr import rotations as so3
from smsr.progress import ignore
from smsr.shapes import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.progress import StageHook

_OUTLIER = 0.2  # radians; frames farther off count less in the fit
_FIT_STEPS = 8


def turning_cameras(
    velocity: NDArray[np.float64], middle: NDArray[np.float64], frames: int
) -> NDArray[np.float64]:
    """Return ``G_t = exp((t - c) omega) G_c`` (T, 3, 3), c = T // 2.

    Parameters
    ----------
    velocity : ndarray of shape (3,)
        Omega in the camera frame, radians a frame.
    middle : ndarray of shape (3, 3)
        G_c.
    frames : int
        T.
    """
    time = np.arange(frames) - frames // 2
    turning: NDArray[np.float64] = so3.exp(time[:, None] * velocity) @ middle
    return turning


def fit_uniform_turn(
    rotations: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a turn of constant velocity to cameras, little disturbed by frames that are far off.

    Gauss-Newton steps with Huber weights on a window that grows from the middle frame, so that
    the angle of a fast turn is followed beyond half a turn.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Cameras completed by the viewing direction.

    Returns
    -------
    velocity : ndarray of shape (3,)
        Omega in the camera frame, radians a frame.
    middle : ndarray of shape (3, 3)
        The fitted camera of frame T // 2.
    """
    frames = len(rotations)
    centre = frames // 2
    time = np.arange(frames) - centre
    velocity = np.median(so3.log(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)), axis=0)
    middle = _most_central(rotations, velocity)
    window = 4
    while window < frames:
        window = min(2 * window, frames)
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
    return velocity, middle


def _most_central(
    rotations: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return, of the cameras near the middle turned back to it, the one nearest to all others."""
    frames = len(rotations)
    first = max(0, frames // 2 - 4)
    near = slice(first, first + 9)
    back = turning_cameras(-velocity, np.eye(3), frames)[near] @ rotations[near]
    distances = np.linalg.norm(back[:, None] - back, axis=(2, 3)).sum(axis=1)
    central: NDArray[np.float64] = back[distances.argmin()]
    return central


def refine_uniform_turn(
    measurements: NDArray[np.float64],
    velocity: NDArray[np.float64],
    middle: NDArray[np.float64],
    *,
    motion_weight: float,
    evaluations: int = 30,
    hook: StageHook = ignore,
) -> NDArray[np.float64]:
    """Return the velocity near a first one whose best shape has least energy.

    The energy is ``||P S#||_* + lambda/2 ||D S#||_F^2``, minimised over the shapes with W = R S
    for each velocity and over the velocity by L-BFGS.

    Parameters
    ----------
    measurements : ndarray of shape (2T, N)
        W, centred, rows u1, v1, u2, ...
    velocity, middle
        As from `fit_uniform_turn`.
    motion_weight : float
        Lambda.
    evaluations : int
        Most evaluations of the energy.
    hook : callable
        See `smsr.progress.StageHook`.
    """
    frames = len(measurements) // 2
    time = np.arange(frames) - frames // 2
    problem = DepthProblem(measurements, turning_cameras(velocity, middle, frames))
    problem.start_from_least_motion()
    problem.motion_weight = motion_weight
    count = 0

    def energy(x: NDArray[np.float64], *_: object) -> tuple[float, NDArray[np.float64]]:
        nonlocal count
        now = velocity + x / frames
        problem.turn_to(turning_cameras(now, middle, frames))
        problem.minimise(60, 3e-4)
        count += 1
        hook(min(count / evaluations, 1.0), count, problem.residuals[-1])
        jacobian = so3.left_jacobian(time[:, None] * now) * time[:, None, None]
        gradient = np.einsum("tij,ti->j", jacobian, problem.camera_gradient()) / frames
        return problem.value(), gradient

    found = minimize(
        energy,
        np.zeros(3),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": evaluations, "maxfun": evaluations},
    )
    refined: NDArray[np.float64] = velocity + found.x / frames
    return refined
