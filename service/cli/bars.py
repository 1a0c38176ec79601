"""Progress bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from service.cli.exits import errors

if TYPE_CHECKING:
    from rich.progress import TaskID

    from smsr.progress import Progress as Report


def progress_bars(*, quiet: bool = False) -> Progress:
    """Return rich's progress display on standard error, one line a task.

    Parameters
    ----------
    quiet : bool
        Show nothing.
    """
    return Progress(
        SpinnerColumn(finished_text="[green]done[/]"),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[stage]}[/]"),
        console=errors,
        disable=quiet,
    )


class SolverBar:
    """A progress callback of the solver that moves one bar."""

    def __init__(self, bars: Progress, description: str) -> None:
        self._bars = bars
        self._task: TaskID = bars.add_task(description, total=1.0, stage="")

    def __call__(self, report: Report) -> None:
        """Show one report."""
        self._bars.update(
            self._task, completed=report.fraction, stage=stage_text(report.stage, report.iteration)
        )

    def finish(self) -> None:
        """Fill the bar."""
        self._bars.update(self._task, completed=1.0, stage="")


def stage_text(stage: str, iteration: int) -> str:
    """Say where a run is."""
    return f"{stage}, iteration {iteration}" if iteration else stage
