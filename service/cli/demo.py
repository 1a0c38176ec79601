"""The whole service in one command: serve, submit over HTTP, download, stop."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.bars import progress_bars, stage_text
from service.cli.exits import console
from service.cli.remote import fetch
from smsr.synthetic import write_example
from smsr_client import Client, ClientError, require_success

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smsr_client.documents import Job

_STOP_SECONDS = 60
_NOT_INHERITED = (
    "SMSR_ACCESS",
    "SMSR_API_KEY",
    "REDIS_URL",
    "SMSR_REDIS_URL",
    "SMSR_STORAGE_URL",
    "SMSR_DATA_DIR",
)


def demo(
    out: Annotated[
        Path, typer.Option("-o", "--out", file_okay=False, metavar="DIR", help="Folder of results.")
    ] = Path("demo-output"),
) -> None:
    """Try everything: start a server, submit a generated example, download the moving surface."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="smsr-demo-") as scratch:
        write_example(out / "example")
        with _server(Path(scratch), out / "server.log") as url:
            console.print(f"Started a server with its own Redis and a worker at {url}")
            with Client(url) as client:
                job = _run(client, out)
    console.print("Stopped the server")
    metrics = job.metrics or {}
    console.print(
        f"[bold]e3D = {metrics['e3d']:.4f}[/] ({job.frames} frames of {job.points} points, "
        f"{job.timings['total'] - job.timings['queued']:.1f} s)"
    )
    console.print(f"{out}/result.npz, {out}/report.json, {out}/frames/*.ply", soft_wrap=True)


def _run(client: Client, out: Path) -> Job:
    """Submit the example, follow the job, download its result."""
    example = out / "example"
    with progress_bars() as bars:
        bar = bars.add_task("reconstructing", total=1.0, stage="uploading")
        job = client.submit(
            example / "measurements.npy",
            ground_truth=example / "ground_truth.npy",
            faces=example / "faces.npy",
        )

        def follow(now: Job) -> None:
            if now.progress is not None:
                where = stage_text(now.progress.stage, now.progress.iteration)
                bars.update(bar, completed=now.progress.fraction, stage=where)

        job = require_success(client.wait(job.id, progress=follow))
        fetch(client, job, out, ply=True)
        bars.update(bar, completed=1.0, stage="")
    return job


@contextlib.contextmanager
def _server(data_dir: Path, log: Path) -> Iterator[str]:
    """Run ``smsr serve`` with its own Redis on a free port; gives its address."""
    environment = {name: v for name, v in os.environ.items() if name not in _NOT_INHERITED}
    command = [sys.executable, "-m", "service.cli", "serve", "--port", "0"]
    with (
        log.open("wb") as errors,
        subprocess.Popen(
            [*command, "--data-dir", str(data_dir)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
            # An interrupt at the terminal reaches only this process, which stops the server.
            start_new_session=True,
            text=True,
        ) as process,
    ):
        try:
            line = process.stdout.readline() if process.stdout else ""
            if not line:
                raise ClientError(f"The server did not start; see {log}.")
            yield line.split()[-1]
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
