"""Real workers for the tests, some of which are slow, stuck or short of memory at some stage."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import worker.supervisor
from worker.logs import configure_logging
from worker.main import run_worker
from worker.progress import ProgressReporter
from worker.task import RESULTS  # noqa: F401  (the fork server loads the task for all workers)

if TYPE_CHECKING:
    from smsr.progress import Progress
    from worker.settings import Settings


@dataclass(frozen=True)
class Behaviour:
    """What a worker does when it has reported a stage.

    `slow` goes on reporting, `stuck` does not, `deaf` is stuck in a library call that no Python
    signal handler can interrupt, `greedy` finds no memory, `broken` has a bug.
    """

    stage: str
    kind: Literal["slow", "stuck", "deaf", "greedy", "broken"] = "slow"
    attempts: int = 1
    seconds: float = 60.0


def work(settings: Settings, behaviour: Behaviour | None) -> None:
    """Run a worker until it is told to stop."""
    configure_logging(settings.log_level)
    if behaviour is not None:
        _misbehave(behaviour)
    run_worker(settings)


def _misbehave(behaviour: Behaviour) -> None:
    worker.supervisor.LIMIT_GRACE = 0.5
    report = ProgressReporter.__call__

    def misbehaving(self: ProgressReporter, progress: Progress) -> bool:
        going_on = report(self, progress)
        if progress.stage == behaviour.stage and self._attempt <= behaviour.attempts:
            if behaviour.kind == "greedy":
                raise MemoryError
            if behaviour.kind == "broken":
                raise ZeroDivisionError("a bug")
            if behaviour.kind == "deaf":
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
            end = time.monotonic() + behaviour.seconds
            while going_on and time.monotonic() < end:
                time.sleep(0.05 if behaviour.kind == "slow" else behaviour.seconds)
                going_on = report(self, progress)
        return going_on

    ProgressReporter.__call__ = misbehaving  # type: ignore[method-assign]
