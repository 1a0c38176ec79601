"""How a run reports: a stage, a fraction, an iteration and a residual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

STAGES = ("reading", "factorising", "scales", "cameras", "smoothing", "shapes", "writing")
"""Names of the stages of a run, in order."""


@dataclass(frozen=True, slots=True)
class Progress:
    """One report of a running reconstruction.

    Attributes
    ----------
    stage : str
        Name of the stage, one of `STAGES`.
    fraction : float
        Part of the whole run that is done, 0 to 1, never decreasing within a run.
    iteration : int
        Iteration within the stage, 0 where the stage has none.
    residual : float or None
        The stage's own stopping residual, None where it has none yet.
    """

    stage: str
    fraction: float
    iteration: int = 0
    residual: float | None = None


ProgressCallback: TypeAlias = Callable[[Progress], object]
"""Called with each report. Returning exactly ``False`` cancels the run (`smsr.errors.Cancelled` is
raised by the solver); an exception it raises passes through unchanged."""


StageHook: TypeAlias = Callable[[float, int, float | None], None]
"""Called by a stage with the done part of the stage (0 to 1), the iteration and the residual. It
may raise, `smsr.errors.Cancelled` for one, to stop the stage."""


def ignore(fraction: float, iteration: int, residual: float | None) -> None:
    """Take a stage's report and do nothing: the default hook."""


def part_of(hook: StageHook, first: float, last: float) -> StageHook:
    """Return a hook that reports into a part, from `first` to `last`, of another hook's range."""

    def part(fraction: float, iteration: int, residual: float | None) -> None:
        hook(first + fraction * (last - first), iteration, residual)

    return part
