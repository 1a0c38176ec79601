"""Commands that talk to a server: submit files, look after jobs."""

from __future__ import annotations

import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from service.cli.bars import progress_bars, stage_text
from service.cli.exits import code_of, complain, console, message_of
from service.cli.local import (
    AsJson,
    Faces,
    OptionValues,
    Preset,
    preset_and_options,
)
from smsr.options import parse
from smsr_client import FINAL, Client, ClientError, require_success
from smsr_client.documents import JobStatus
from worker.options import JobOptions
from worker.records import Priority

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.progress import Progress

    from smsr_client.documents import Job

Server = Annotated[
    str, typer.Option(envvar="SMSR_SERVER", metavar="URL", help="Address of the server.")
]
ApiKey = Annotated[
    str | None,
    typer.Option(
        envvar="SMSR_API_KEY",
        metavar="KEY",
        show_default=False,
        help="API key, where the server needs one; the environment keeps it from other users.",
    ),
]
LOCAL_SERVER = "http://127.0.0.1:8000"
OfStatus = Annotated[JobStatus | None, typer.Option(help="Only jobs of this status.")]
JobId = Annotated[str, typer.Argument(metavar="ID", show_default=False)]
Patience = Annotated[
    float, typer.Option(min=0, help="Seconds for which a request that fails is tried again.")
]

_UPLOAD, _RUN = 0.2, 0.7
"""Parts of a file's bar that uploading and running take; downloading takes the rest."""


class _Left(Exception):
    """The command is being interrupted."""


@dataclass(frozen=True, slots=True)
class _Order:
    """What to do with each file."""

    ground_truth: str | None
    faces: Path | None
    options: dict[str, object]
    settings: dict[str, object]
    wait: bool
    out: Path | None
    ply: bool

    def truth_of(self, file: Path) -> Path | None:
        """Return the file of the ground truth: {stem} stands for the file's name."""
        if self.ground_truth is None:
            return None
        return Path(self.ground_truth.replace("{stem}", file.stem).replace("{file}", str(file)))


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What became of one file."""

    file: Path
    job: Job | None = None
    error: Exception | None = None


def submit(
    files: Annotated[
        list[Path],
        typer.Argument(
            exists=True,
            dir_okay=False,
            metavar="FILE...",
            show_default=False,
            help="2D tracks: .npy, .npz, .mat, .csv, .txt, ...",
        ),
    ],
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    wait: Annotated[
        bool, typer.Option(help="Wait for the jobs and tell how they ended; -o implies it.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="Download results into DIR/NAME/, NAME as the file's.",
        ),
    ] = None,
    ground_truth: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="{stem} and {file} stand for each FILE's name and path."),
    ] = None,
    faces: Faces = None,
    preset: Preset = None,
    option: OptionValues = None,
    batch: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Batch that the jobs belong to.")
    ] = None,
    priority: Annotated[
        Priority | None, typer.Option(help="Jobs of a higher one start first.")
    ] = None,
    ttl: Annotated[
        float | None,
        typer.Option(
            min=0, metavar="SECONDS", help="How long the server keeps them; 0 is for ever."
        ),
    ] = None,
    reuse: Annotated[
        bool | None,
        typer.Option(
            "--reuse/--no-reuse",
            help="Take the result of an equal job, where there is one.  [default: the server's]",
        ),
    ] = None,
    ply: Annotated[bool, typer.Option(help="Download a PLY of every frame too.")] = True,
    parallel: Annotated[int, typer.Option(min=1, max=64, help="Files in hand at once.")] = 4,
    patience: Patience = 60.0,
    as_json: AsJson = False,
) -> None:
    """Submit files of 2D tracks to a server.

    Files that fail do not hold up the others; they are told at the end, and the exit status says
    that there were some. A name that is no file is wrong usage: nothing is sent then.
    """
    values = preset_and_options(JobOptions, preset, option)
    parse(JobOptions, values)
    asked = {"batch": batch, "priority": priority, "ttl": ttl, "reuse": reuse}
    settings: dict[str, object] = {
        name: value for name, value in asked.items() if value is not None
    }
    order = _Order(ground_truth, faces, values, settings, wait or out is not None, out, ply)
    with Client(server, patience=patience, api_key=api_key) as client, progress_bars() as bars:
        outcomes = _all(client, order, files, bars, parallel)
    if as_json:
        console.print_json(
            data=[outcome.job.model_dump(mode="json") for outcome in outcomes if outcome.job]
        )
    else:
        _tell(outcomes)
    failed = [(outcome.file, outcome.error) for outcome in outcomes if outcome.error is not None]
    for file, error in failed:
        complain(f"{file}: {message_of(error)}")
    if failed:
        raise typer.Exit(max(code_of(error) for _, error in failed))


def _all(
    client: Client, order: _Order, files: Sequence[Path], bars: Progress, parallel: int
) -> list[_Outcome]:
    """Handle files side by side; outcomes come in the order of the files."""
    leaving = threading.Event()
    pool = ThreadPoolExecutor(parallel, thread_name_prefix="submit")
    try:
        targets = _targets(order.out, files)
        work = [
            pool.submit(_Errand(client, order, file, target, bars, leaving).run)
            for file, target in zip(files, targets, strict=True)
        ]
        for done in as_completed(work):
            done.result()
        return [done.result() for done in work]
    finally:
        leaving.set()
        pool.shutdown(cancel_futures=True)


def _targets(out: Path | None, files: Sequence[Path]) -> list[Path | None]:
    """Return a folder for each file; files of the same name get numbers."""
    taken: set[str] = set()
    targets: list[Path | None] = []
    for file in files:
        name, number = file.stem, 1
        while name in taken:
            number += 1
            name = f"{file.stem}-{number}"
        taken.add(name)
        targets.append(None if out is None else out / name)
    return targets


class _Errand:
    """One file's way to the server and back, with its bar."""

    def __init__(
        self,
        client: Client,
        order: _Order,
        file: Path,
        target: Path | None,
        bars: Progress,
        leaving: threading.Event,
    ) -> None:
        self._client, self._order, self._file, self._target = client, order, file, target
        self._bars, self._leaving = bars, leaving
        self._bar = bars.add_task(escape(file.name), total=1.0, stage="waits")

    def run(self) -> _Outcome:
        """Upload, and where asked wait and download."""
        job: Job | None = None
        try:
            job = self._upload()
            if self._order.wait:
                job = self._client.wait(job.id, progress=self._follow)
                require_success(job)
                if self._target is not None:
                    fetch(self._client, job, self._target, ply=self._order.ply, bars=self._at)
            self._at(1.0, "")
        except _Left:
            return _Outcome(self._file, job)
        except (ClientError, OSError) as error:
            self._bars.update(self._bar, stage="[red]failed[/]")
            return _Outcome(self._file, job, error)
        return _Outcome(self._file, job)

    def _upload(self) -> Job:
        share = _UPLOAD if self._order.wait else 1.0
        return self._client.submit(
            self._file,
            ground_truth=self._order.truth_of(self._file),
            faces=self._order.faces,
            options=self._order.options,
            settings=self._order.settings,
            progress=lambda done, total: self._at(share * done / max(total, 1), "uploading"),
        )

    def _follow(self, job: Job) -> None:
        if job.progress is None or job.status == "queued":
            self._at(_UPLOAD, job.status)
        else:
            where = stage_text(job.progress.stage, job.progress.iteration)
            self._at(_UPLOAD + _RUN * job.progress.fraction, where)

    def _at(self, fraction: float, stage: str) -> None:
        """Move the bar; called often on every way, so this is where an interrupt takes hold."""
        if self._leaving.is_set():
            raise _Left
        self._bars.update(self._bar, completed=fraction, stage=stage)


def fetch(
    client: Client,
    job: Job,
    target: Path,
    *,
    ply: bool,
    bars: Callable[[float, str], object] = lambda _fraction, _stage: None,
) -> None:
    """Download a job's result.npz, report.json and frames into a folder."""

    def loading(done: int, total: int) -> None:
        bars(_UPLOAD + _RUN + (1 - _UPLOAD - _RUN) * done / max(total, 1), "downloading")

    client.download(job.id, "report.json", target / "report.json")
    client.download(job.id, "result.npz", target / "result.npz", progress=loading)
    if ply:
        packed = client.download(job.id, "frames.zip", target / "frames.zip", progress=loading)
        with zipfile.ZipFile(packed) as archive:
            archive.extractall(target / "frames")
        packed.unlink()


def _tell(outcomes: Sequence[_Outcome]) -> None:
    table = Table("file", "job", "status", "frames", "points", "e3D", header_style="bold", box=None)
    for outcome in outcomes:
        if outcome.job is not None:
            table.add_row(escape(outcome.file.name), *_row(outcome.job))
    if table.row_count:
        _print_whole(table)


_WIDEST = 1000


def _print_whole(table: Table) -> None:
    """Print a table as wide as it is: ids that are cut off cannot be copied."""
    wide = Console(file=console.file, width=_WIDEST)
    wide.width = max(console.width, wide.measure(table).maximum)
    wide.print(table)


def _row(job: Job) -> tuple[str, ...]:
    e3d = (job.metrics or {}).get("e3d")
    colour = {"succeeded": "green", "failed": "red", "cancelled": "yellow"}.get(job.status, "blue")
    return (
        job.id,
        f"[{colour}]{job.status}[/]",
        str(job.frames or ""),
        str(job.points or ""),
        "" if e3d is None else f"{e3d:.4f}",
    )


def batch(
    label: Annotated[str, typer.Argument(metavar="LABEL", show_default=False)],
    download: Annotated[
        Path | None,
        typer.Option(
            "-o", "--download", metavar="FILE.zip", help="Fetch the results of all its jobs."
        ),
    ] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel its unfinished jobs.")] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Run its failed and cancelled jobs again.")
    ] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Remove its jobs and files.")] = False,
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    patience: Patience = 60.0,
    as_json: AsJson = False,
) -> None:
    """Look after the jobs that share a label: how far they are, or what the options say."""
    if cancel + retry + delete + (download is not None) > 1:
        raise typer.BadParameter("Say one thing to do at a time.")
    with Client(server, api_key=api_key, patience=patience) as client:
        if cancel:
            ended = client.cancel_batch(label)
            console.print(f"{label}: {ended.cancelled} cancelled, {ended.stopping} stopping")
        elif retry:
            again = client.retry_batch(label)
            lost = again.inputs_gone + again.refused
            console.print(f"{label}: {again.queued} queued, {lost} cannot be run again")
        elif delete:
            client.delete_batch(label)
            console.print(f"{label} deleted")
        elif download is not None:
            client.download_batch(label, download)
            console.print(f"{label}: {download}", soft_wrap=True)
        else:
            found = client.batch(label)
            if as_json:
                console.print_json(found.model_dump_json())
                return
            counts = ", ".join(f"{n} {status}" for status, n in found.jobs.items() if n)
            console.print(f"{label}: {found.progress:.0%} of {found.total} jobs ({counts})")
            if found.e3d is not None:
                e3d = found.e3d
                console.print(
                    f"e3D of {e3d.count}: mean {e3d.mean:.4f}, median {e3d.median:.4f}, "
                    f"{e3d.min:.4f} to {e3d.max:.4f}"
                )


jobs = typer.Typer(no_args_is_help=True, help="Look after the jobs of a server.")


@jobs.command("list")
def list_jobs(
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    status: OfStatus = None,
    batch: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Only jobs of this batch.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many at most.")] = 50,
    patience: Patience = 5.0,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first."""
    with Client(server, patience=patience, api_key=api_key) as client:
        found = [
            job
            for job, _ in zip(client.list(status=status, batch=batch), range(limit), strict=False)
        ]
    if as_json:
        console.print_json(data=[job.model_dump(mode="json") for job in found])
        return
    table = Table(
        "job", "status", "frames", "points", "e3D", "created", "name", header_style="bold", box=None
    )
    for job in found:
        created = job.created_at.astimezone().strftime("%Y-%m-%d %H:%M:%S")
        table.add_row(*_row(job), created, escape(job.name or ""))
    _print_whole(table)


@jobs.command()
def show(
    job_id: JobId, server: Server = LOCAL_SERVER, api_key: ApiKey = None, patience: Patience = 5.0
) -> None:
    """Print everything about a job, as JSON."""
    with Client(server, patience=patience, api_key=api_key) as client:
        console.print_json(client.get(job_id).model_dump_json())


@jobs.command()
def cancel(
    job_id: JobId, server: Server = LOCAL_SERVER, api_key: ApiKey = None, patience: Patience = 5.0
) -> None:
    """Cancel a queued or running job."""
    with Client(server, patience=patience, api_key=api_key) as client:
        job = client.cancel(job_id)
    state = job.status if job.status in FINAL else "stopping"
    console.print(f"{job.id} {state}")


@jobs.command()
def retry(
    job_id: JobId, server: Server = LOCAL_SERVER, api_key: ApiKey = None, patience: Patience = 5.0
) -> None:
    """Queue a finished job again."""
    with Client(server, patience=patience, api_key=api_key) as client:
        console.print(f"{client.retry(job_id).id} queued")


@jobs.command()
def keep(
    job_id: JobId,
    ttl: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="SECONDS",
            help="From its end on, 0 for ever. [default: the service's own time]",
            show_default=False,
        ),
    ] = None,
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    patience: Patience = 5.0,
) -> None:
    """Have a job kept longer or shorter than it is."""
    with Client(server, patience=patience, api_key=api_key) as client:
        job = client.keep(job_id, ttl)
    if job.expires_at is not None:
        console.print(f"{job.id} is kept until {job.expires_at.astimezone():%Y-%m-%d %H:%M:%S}")
    elif job.status in FINAL:
        console.print(f"{job.id} is kept for ever")
    else:
        console.print(f"{job.id} is kept for its time once it has ended")


@jobs.command()
def delete(
    job_ids: Annotated[list[str], typer.Argument(metavar="ID...", show_default=False)],
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    patience: Patience = 5.0,
) -> None:
    """Remove jobs with their files."""
    with Client(server, patience=patience, api_key=api_key) as client:
        for job_id in job_ids:
            client.delete(job_id)
            console.print(f"{job_id} deleted")


@jobs.command()
def download(
    job_id: JobId,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Folder. [default: the job's id]"),
    ] = None,
    ply: Annotated[bool, typer.Option(help="Download a PLY of every frame too.")] = True,
    server: Server = LOCAL_SERVER,
    api_key: ApiKey = None,
    patience: Patience = 5.0,
) -> None:
    """Wait for a job and download its result."""
    with Client(server, patience=patience, api_key=api_key) as client:
        job = client.wait(job_id)
        require_success(job)
        target = out or Path(job.id)
        fetch(client, job, target, ply=ply)
    console.print(f"{job.id}: {target}", soft_wrap=True)
