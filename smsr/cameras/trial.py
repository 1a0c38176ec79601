"""Simple paths of the camera on trial: whether one may take the place of free cameras.

A path is taken where it passes four tests: it is the simplest that fits, it leaves little of the
free cameras unexplained, the shapes it gives do not move much more, and it lies in the span of the
tracks (`smsr.cameras.selection`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from smsr import rotations as so3
from smsr.cameras.axis import fit_axis
from smsr.cameras.gimbal import fit_gimbal
from smsr.cameras.paces import fit_paces, score
from smsr.cameras.rest import resting_frame
from smsr.cameras.switched import fit_switched_turn
from smsr.cameras.turn import refine_velocity, with_shake
from smsr.cameras.uniform import fit_uniform_turn
from smsr.progress import ignore
from smsr.shapes.problem import DepthProblem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.cameras.turn import Turn
    from smsr.progress import StageHook

UNEXPLAINED_LIMIT = 0.1
"""Part of the rotation variance of the free cameras that a path may leave unexplained."""

UNEXPLAINED_LITTLE = 0.035
"""Part below which the path may even make the object move somewhat more."""

MOTION_RISE_LIMIT = 0.35
"""By how much more: log of the ratio of ||D S#||^2."""

FLAT_LIMITS = (0.1, 0.5)
"""The same two limits where the cameras are those of a flat mean shape: they follow its turns, so
they drift more, and let it move less."""

NODDING_LIMITS = (0.02, 0.16)
"""The same two limits for a path with a nod, which fits much that it should not."""

LOOSE = frozenset({"gimbal", "axis"})
"""Models of paths that only correct the frame of the free cameras."""

_FREE_ANGLES = 6  # as many parameters as a turn counts that goes on in any way about one axis
_MOTION_WEIGHT = 1.5
_LEAST_MOTION = 1e-12  # by the nuclear norm, for measurements of unit size
_REST_SMOOTHING = 4.0  # frames
_SWITCH = 0.3  # change of the velocity from a frame to the next, in parts of it
_SWITCHES_PER_PARAMETER = 4  # a switch within a frame shows in two, and its level is known


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A path of few parameters.

    Attributes
    ----------
    name : str
        Of the kind of turn.
    turn : Turn
        With the shake of the cameras, where it is known.
    parameters : int
        Beyond those of a uniform turn.
    unexplained : float
        Mean squared angle, radians, by which free cameras drift from it.
    nods : bool
        Whether the camera nods meanwhile.
    """

    name: str
    turn: Turn
    parameters: int = 0
    unexplained: float = 0.0
    nods: bool = False

    @property
    def score(self) -> float:
        """See `score`."""
        return score(self.unexplained, self.parameters)

    @property
    def model(self) -> str:
        """Name of the camera model that it makes."""
        return "gimbal" if self.nods else self.name

    @property
    def is_certain(self) -> bool:
        """Whether it is so special that hardly anything else looks like it."""
        return self.model in {"uniform", "switched"}

    @property
    def is_loose(self) -> bool:
        """Whether it only corrects the frame: depths are those that the free cameras see."""
        return self.model in LOOSE

    def __str__(self) -> str:
        turn = {
            "axis": "a turn about one axis",
            "accelerated": "an accelerated turn",
            "eased": "a turn that eases in or out",
            "swinging": "a swing",
        }.get(self.name, f"a {self.name} turn")
        return f"{turn} with a nod" if self.nods else turn


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What became of a path.

    Attributes
    ----------
    unexplained : float
        Part of the rotation variance of the free cameras.
    reason : str
        For a person.
    motion_rise : float, optional
        Log of the ratio of ||D S#||^2 to that with the free cameras, where it was measured.
    motion_weight : float, optional
        Weight of motion in the energy that the path minimises; None where it was refused.
    simplicity : float
        Nuclear norm of the shapes with the free cameras over that on the path.
    """

    unexplained: float
    reason: str
    motion_rise: float | None = None
    motion_weight: float | None = None
    simplicity: float = 1.0


def _as_seen(path: Path, steady: NDArray[np.float64], nod: NDArray[np.float64] | None) -> Path:
    """Add to a path the shake of the cameras, how far they are from it, and their nod (T, 3)."""
    turn, drift = with_shake(path.turn, steady)
    if nod is not None:
        turn = dataclasses.replace(turn, shake=so3.log(so3.exp(nod) @ so3.exp(turn.shake)))
    return dataclasses.replace(
        path,
        turn=turn,
        unexplained=float((drift**2).sum(axis=1).mean()),
        nods=nod is not None,
    )


class Trial:
    """The free cameras that paths are judged against.

    Parameters
    ----------
    measurements : ndarray of shape (2T', q)
        Virtual points in every n-th frame.
    rotations : ndarray of shape (T, 3, 3)
        Free cameras of all frames.
    step : int
        n.
    flat : bool
        Whether they are those of a flat mean shape.
    """

    def __init__(
        self,
        measurements: NDArray[np.float64],
        rotations: NDArray[np.float64],
        step: int,
        *,
        flat: bool = False,
    ) -> None:
        self.measurements = measurements
        self.rotations = rotations
        self.step = step
        self.flat = flat
        self._free = self._solve(rotations[::step])
        self._free_nuclear, self._free_motion = _nuclear_and_motion(self._free)

    def come_to_rest(self, points: NDArray[np.float64]) -> tuple[float, float]:
        """Turn the free cameras to the frame in which points rest, as far as some do.

        Parameters
        ----------
        points : ndarray of shape (q, s)
            Real points as combinations of the virtual ones.

        Returns
        -------
        unrest, trust : float
            See `smsr.cameras.rest.Rest`.
        """
        rest = resting_frame(self._free.shapes.reshape(self._free.frames, 3, -1) @ points)
        if rest.trust > 0.0:
            # Drift is slow. What changes fast are errors, which would be taken for a shake.
            turns = so3.log(so3.mean_rotation(rest.turns).T @ rest.turns)
            turns = gaussian_filter1d(turns, _REST_SMOOTHING / self.step, axis=0, mode="nearest")
            frames = np.arange(len(self.rotations))
            every = np.stack([np.interp(frames, frames[:: self.step], x) for x in turns.T], axis=1)
            self.rotations = self.rotations @ so3.exp(-rest.trust * every)
        return rest.unrest, rest.trust

    def uniform(self) -> Path:
        """Return the uniform turn nearest to the free cameras, without any shake."""
        turn = fit_uniform_turn(self.rotations)
        drift = so3.angles_between(turn.rotations, self.rotations)
        return Path("uniform", turn, unexplained=float((drift**2).mean()))

    def paths(self) -> list[Path]:
        """Return the most likely path, and as the next one any turn about the same axis.

        There is none where the cameras do not keep to an axis. Where they nod meanwhile, the turn
        has to be one that can be named: the two together could be much.
        """
        axis, nod = fit_axis(self.rotations), None
        steady = self.rotations
        if not axis.is_followed():
            gimbal = fit_gimbal(self.rotations, axis)
            axis, nod = gimbal.axis, gimbal.nod
            steady = so3.exp(-nod) @ self.rotations
            if not axis.is_followed():
                return []
        found = [Path("uniform", fit_uniform_turn(steady))]
        switched = fit_switched_turn(steady)
        if switched is not None:
            changes = int((np.abs(np.diff(switched.angles, 2)) > _SWITCH).sum())
            found.append(Path("switched", switched, 1 + changes // _SWITCHES_PER_PARAMETER))
        found += [
            Path(pace.name, axis.turn(pace.angles), pace.parameters)
            for pace in fit_paces(axis.angles)
        ]
        *found, anyhow = (
            _as_seen(path, steady, nod)
            for path in [*found, Path("axis", axis.turn(), _FREE_ANGLES)]
        )
        best = min(found, key=lambda path: path.score)
        if nod is not None:
            return [best]
        return [best, anyhow] if best.score < anyhow.score else [anyhow]

    def _unexplained(self, path: Path) -> float:
        """Return which part of the rotation variance of the free cameras a path leaves."""
        return so3.part_of_rotation(path.unexplained, self.rotations)

    def judge(self, path: Path) -> Verdict:
        """Put a path to the tests."""
        unexplained = self._unexplained(path)
        most = NODDING_LIMITS[0] if path.nods else UNEXPLAINED_LIMIT
        if unexplained > most:
            return Verdict(unexplained, f"leaves {unexplained:.1%} of the rotation unexplained")
        verdict = self.measure(path)
        little, rise = FLAT_LIMITS if self.flat else (UNEXPLAINED_LITTLE, MOTION_RISE_LIMIT)
        if path.nods:
            little, rise = NODDING_LIMITS
        if (verdict.motion_rise or 0.0) <= (rise if unexplained <= little else 0.0):
            return verdict
        return dataclasses.replace(verdict, motion_weight=None)

    def measure(self, path: Path) -> Verdict:
        """Compare the shapes that a path gives with those of the free cameras, and accept it."""
        unexplained = self._unexplained(path)
        tiny = np.finfo(float).tiny
        problem = self._solve(path.turn.every(self.step).rotations)
        nuclear, motion = _nuclear_and_motion(problem)
        gain = max(0.0, math.log(max(problem.image_motion(), tiny) / motion))
        rise = math.log(motion / self._free_motion)
        return Verdict(
            unexplained,
            f"leaves {unexplained:.1%} of the rotation unexplained and changes the motion of the "
            f"object by {math.expm1(rise):+.0%}",
            rise,
            _MOTION_WEIGHT * gain * nuclear / motion,
            self._free_nuclear / max(nuclear, tiny),
        )

    def refine(
        self, path: Path, verdict: Verdict, hook: StageHook = ignore
    ) -> tuple[Turn, Verdict]:
        """Return the turn with the velocity that gives the best shapes, and how simple they are.

        On other than certain paths the speed stays: a swing may be wider for shapes that are
        flatter, and flatter ones are simpler. How simple they are is told for the speed that was
        found.
        """
        some, gain = refine_velocity(
            path.turn.every(self.step),
            self.measurements,
            motion_weight=verdict.motion_weight or 0.0,
            hook=hook,
        )
        velocity = some.velocity
        if not path.is_certain:
            speed = float(np.linalg.norm(path.turn.velocity))
            velocity = velocity * (
                speed / max(float(np.linalg.norm(velocity)), np.finfo(float).tiny)
            )
        turn = dataclasses.replace(path.turn, velocity=velocity)
        return turn, dataclasses.replace(verdict, simplicity=gain * verdict.simplicity)

    def _solve(self, rotations: NDArray[np.float64]) -> DepthProblem:
        """Return the best shapes for some cameras."""
        problem = DepthProblem(self.measurements, rotations)
        problem.start_from_least_motion()
        problem.minimise(120, 1e-4)
        return problem


def _nuclear_and_motion(problem: DepthProblem) -> tuple[float, float]:
    """Return the nuclear norm of shapes and their motion, above what is rounding."""
    nuclear = float(problem.spectrum().sum())
    return nuclear, max(problem.motion(), _LEAST_MOTION * nuclear, np.finfo(float).tiny)
