"""Options of a job: those of the solver and those of its files and its time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from smsr.options import Options, option


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOptions(Options):
    """Options of one job; `smsr.options.parse` builds it from JSON, `describe` explains it."""

    measurements_key: str | None = option(
        None, "Name of the measurement matrix in a file with several arrays."
    )
    ground_truth_key: str | None = option(
        None, "Name of the ground truth in a file with several arrays."
    )
    faces_key: str | None = option(None, "Name of the faces in a file with several arrays.")
    ground_truth_frame: Literal["auto", "object", "camera"] = option(
        "auto",
        "Frame of the ground truth: 'object' is one world frame for all frames, 'camera' is the "
        "frame of the camera at each time; 'auto' recognises it.",
    )
    time_limit: float | None = option(
        None,
        "Seconds this job may run before it fails; the server's own limit holds as well.",
        minimum=1,
    )

    def solver_options(self) -> Options:
        """Return the options that `smsr.reconstruct` takes."""
        return Options(**{f.name: getattr(self, f.name) for f in dataclasses.fields(Options)})
