"""Measuring one set in a process of its own: accuracy in each frame, wall time, peak memory.

A process that has run one set keeps what its allocator holds, so peak memory is only a set's own in
a fresh process: `run` starts one for each set, with its number of BLAS threads fixed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import threadpoolctl

from smsr import __version__
from smsr.benchmark.datasets import Dataset, load
from smsr.metrics import evaluate
from smsr.options import Options, parse
from smsr.pipeline import reconstruct

if TYPE_CHECKING:
    from collections.abc import Mapping

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


@dataclass(frozen=True, slots=True)
class Measurement:
    """What one set gave.

    Attributes
    ----------
    name : str
        The set.
    frames, points : int
        T and N.
    e3d : dict of str to float
        The error by frame of comparison, the frame of the ground truth first.
    e3d_per_frame : dict of str to float
        The same after a Procrustes alignment of every frame on its own.
    seconds : float
        Wall time of the reconstruction, with writing its result to disk, without evaluation.
    peak_bytes : int
        Largest resident memory of the process up to then, pages of mapped files included.
    start_bytes : int
        Resident memory before the input was opened: the interpreter and its libraries.
    camera_model : str
        Which camera model the solver took.
    basis_size : int
        K, as the solver found it.
    converged : bool
        Whether every stage met its tolerance.
    """

    name: str
    frames: int
    points: int
    e3d: dict[str, float]
    e3d_per_frame: dict[str, float]
    seconds: float
    peak_bytes: int
    start_bytes: int
    camera_model: str
    basis_size: int
    converged: bool


@dataclass(frozen=True, slots=True)
class Environment:
    """What the figures depend on beside the code."""

    smsr: str
    python: str
    numpy: str
    scipy: str
    machine: str
    processors: int
    blas: str
    blas_threads: int


class BenchmarkFailed(RuntimeError):
    """A set's process ended without a result."""


def environment(threads: int) -> Environment:
    """Describe this interpreter, its libraries and its machine."""
    blas = {
        f"{pool['internal_api']} {pool['version']}"
        for pool in threadpoolctl.threadpool_info()
        if pool["user_api"] == "blas"
    }
    return Environment(
        smsr=__version__,
        python=platform.python_version(),
        numpy=np.__version__,
        scipy=scipy.__version__,
        machine=platform.machine(),
        processors=os.cpu_count() or 1,
        blas=", ".join(sorted(blas)) or "unknown BLAS",
        blas_threads=threads,
    )


def measure(dataset: Dataset, folder: Path, options: Options) -> Measurement:
    """Reconstruct and evaluate one set in this process."""
    start_bytes = _peak_bytes()
    measurements, truths = load(dataset, folder)
    with tempfile.TemporaryDirectory(prefix="smsr-benchmark-") as scratch:
        begun = time.perf_counter()
        result = reconstruct(measurements, out=Path(scratch), options=options)
        seconds = time.perf_counter() - begun
        peak_bytes = _peak_bytes()
        errors = {frame: evaluate(truth, result, frame=frame) for frame, truth in truths.items()}
        return Measurement(
            name=dataset.name,
            frames=result.diagnostics.frames,
            points=result.diagnostics.points,
            e3d={frame: error.e3d for frame, error in errors.items()},
            e3d_per_frame={frame: error.e3d_per_frame for frame, error in errors.items()},
            seconds=seconds,
            peak_bytes=peak_bytes,
            start_bytes=start_bytes,
            camera_model=result.diagnostics.camera_model,
            basis_size=result.diagnostics.basis_size,
            converged=result.diagnostics.converged,
        )


def run(
    dataset: Dataset,
    folder: Path,
    *,
    options: Mapping[str, object] | None = None,
    threads: int = 1,
) -> Measurement:
    """Measure one set in a fresh process with a fixed number of BLAS threads.

    Parameters
    ----------
    dataset : Dataset
        Which set.
    folder : Path
        The data folder.
    options : mapping, optional
        Names and values of solver options.
    threads : int
        BLAS threads.

    Raises
    ------
    InvalidOption, UnknownOption
        As `smsr.options.parse`.
    BenchmarkFailed
        The process ended without a result.
    """
    values = dict(options or {})
    parse(Options, values)
    task = {
        "dataset": dataclasses.asdict(dataset),
        "folder": str(Path(folder).resolve()),
        "options": values,
    }
    done = subprocess.run(
        [sys.executable, "-m", "smsr.benchmark"],
        input=json.dumps(task),
        env=os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise BenchmarkFailed(f"{dataset.name}: {lines[-1]}")
    return Measurement(**json.loads(done.stdout))


def run_task(task: Mapping[str, Any]) -> dict[str, Any]:
    """Do what `run` asks of its process: from JSON to JSON."""
    measurement = measure(
        Dataset(**task["dataset"]), Path(task["folder"]), parse(Options, task["options"])
    )
    return dataclasses.asdict(measurement)


def _peak_bytes() -> int:
    """Peak resident memory of this process.

    Linux carries ru_maxrss over an exec, so a child would report its parent's peak; VmHWM starts
    anew with the program.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024
