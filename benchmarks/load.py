"""Many small jobs through the whole service, beside the same solves in a bare RQ script.

    python benchmarks/load.py --jobs 1000 --workers 2

Both sides solve the same matrices with the same number of workers, one BLAS thread each, on a Redis
server with the same durability (every write synced). The bare script is the least that RQ needs: it
reads a file by its path, solves and writes the arrays, without uploads, records, leases, progress
or a way to ask. Batches of both alternate, so that what else the machine does falls on both.

Then single jobs are sent to the idle service one after the other; the overhead of a job is the time
from its first byte sent to its end known by the client, less the time that the solver took. As the
solver reports its progress meanwhile, that time is compared with the same solve in an idle bare
worker, too.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import redis
from rq import Queue, Worker
from rq.job import JobStatus
from rq.serializers import JSONSerializer
from threadpoolctl import threadpool_limits

import smsr
from benchmarks.scaling import redis_server, service
from smsr.synthetic import make_low_rank
from smsr_client import Client
from worker.pool import THREAD_VARIABLES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smsr_client.documents import Job

FRAMES, POINTS = 60, 41
SENDERS = 4
IDLE_SECONDS = 0.2
"""Pause before a single job, for the worker to be done with the one before."""


def solve(path: str) -> float:
    """Do what a job does, and nothing else; return the solver's seconds."""
    began = time.perf_counter()
    result = smsr.reconstruct(np.load(path))
    seconds = time.perf_counter() - began
    np.savez(f"{path}.result.npz", shapes=result.shapes, cameras=result.cameras)
    return seconds


def work_bare(url: str) -> None:
    """Be one bare RQ worker: forks a process for each job, as RQ does by default."""
    # Loaded once, before the forks: else each job would load all of it again.
    for module in ("benchmarks.load", "smsr.pipeline"):
        importlib.import_module(module)
    threadpool_limits(1)  # as in the service, for all jobs: looking for the libraries takes time
    with redis.Redis.from_url(url) as connection:
        worker = Worker([Queue("bare", connection=connection)], serializer=JSONSerializer)
        worker.log_result_lifespan = False
        worker.work(logging_level="ERROR")


@contextlib.contextmanager
def bare_workers(url: str, count: int) -> Iterator[None]:
    """Run bare workers until the block ends."""
    command = [sys.executable, "-m", "benchmarks.load", "--bare-worker", url]
    root = Path(__file__).parents[1]
    # As the service's: threads of BLAS that exist when a process forks slow down what it forks.
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    workers = [subprocess.Popen(command, cwd=root, env=environment) for _ in range(count)]
    try:
        with redis.Redis.from_url(url) as connection:
            while len(Worker.all(connection=connection)) < count:
                time.sleep(0.1)
        yield
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.wait()


def bare_batch(url: str, paths: Sequence[Path]) -> float:
    """Run a batch in the bare workers; return its seconds."""
    with redis.Redis.from_url(url) as connection:
        queue = Queue("bare", connection=connection, serializer=JSONSerializer)
        began = time.perf_counter()
        jobs = [
            queue.enqueue("benchmarks.load.solve", str(path), result_ttl=600, failure_ttl=600)
            for path in paths
        ]
        for job in jobs:
            while (status := job.get_status(refresh=True)) != JobStatus.FINISHED:
                if status == JobStatus.FAILED:
                    raise SystemExit(f"a bare job failed: {job.latest_result()}")
                time.sleep(0.01)
        return time.perf_counter() - began


def service_batch(server: str, paths: Sequence[Path]) -> tuple[float, list[float]]:
    """Run a batch through the service; return its seconds and those in the queue of each job."""
    began = time.perf_counter()
    with (
        Client(server) as client,
        ThreadPoolExecutor(SENDERS) as senders,
        ThreadPoolExecutor(SENDERS) as waiters,
    ):
        sent = [senders.submit(_submit, client, path) for path in paths]
        waits = [waiters.submit(_wait, client, job.result()) for job in sent]
        jobs = [wait.result() for wait in waits]
    return time.perf_counter() - began, [job.timings["queued"] for job in jobs]


def bare_single(url: str, path: Path) -> float:
    """Run one job in an idle bare worker; return the solver's seconds."""
    time.sleep(IDLE_SECONDS)
    with redis.Redis.from_url(url) as connection:
        queue = Queue("bare", connection=connection, serializer=JSONSerializer)
        job = queue.enqueue("benchmarks.load.solve", str(path), result_ttl=600)
        while job.get_status(refresh=True) != JobStatus.FINISHED:
            time.sleep(0.01)
        return cast("float", job.return_value(refresh=True))


def single(client: Client, path: Path) -> tuple[float, float]:
    """Send one job to the idle service; return its overhead and the solver's seconds."""
    time.sleep(IDLE_SECONDS)
    began = time.perf_counter()
    job = _wait(client, _submit(client, path))
    whole = time.perf_counter() - began
    service = sum(job.timings[name] for name in ("queued", "opening", "publishing"))
    solver = job.timings["total"] - service
    return whole - solver, solver


def _submit(client: Client, path: Path) -> str:
    return client.submit(path).id


def _wait(client: Client, job_id: str) -> Job:
    job = client.wait(job_id, timeout=3600)
    if job.status != "succeeded":
        raise SystemExit(f"job {job_id} {job.status}: {job.problem}")
    return job


def percentiles(values: Sequence[float]) -> str:
    """Return the median and the 99th percentile in milliseconds."""
    p50, p99 = np.percentile(values, [50, 99]) * 1000
    return f"p50 {p50:.0f} ms, p99 {p99:.0f} ms"


def run(jobs: int, workers: int, batches: int, singles: int) -> None:
    """Measure both sides and print."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="smsr-load-")))
        paths = _matrices(folder, jobs + singles)
        homes = [folder / name for name in ("bare", "service")]
        for home in homes:
            home.mkdir()
        bare_url, service_url = (stack.enter_context(redis_server(home)) for home in homes)
        stack.enter_context(bare_workers(bare_url, workers))
        server, _ = stack.enter_context(service(folder / "data", service_url, workers, 1))
        client = stack.enter_context(Client(server))
        for warm_up in (lambda p: bare_batch(bare_url, p), lambda p: service_batch(server, p)):
            warm_up(_matrices(folder, 2 * workers, first=10**6 + id(warm_up) % 1000))
        seconds: dict[str, list[float]] = {"bare": [], "service": []}
        queued: list[float] = []
        for part in np.array_split(np.arange(jobs), batches):
            batch = [paths[i] for i in part]
            seconds["bare"].append(bare_batch(bare_url, batch))
            took, waits = service_batch(server, batch)
            seconds["service"].append(took)
            queued += waits
            print(f"  {len(batch)} jobs: bare {seconds['bare'][-1]:.1f} s, service {took:.1f} s")
        ones = [(*single(client, path), bare_single(bare_url, path)) for path in paths[jobs:]]
        overheads, solver, alone = zip(*ones, strict=True)
    bare, whole = sum(seconds["bare"]), sum(seconds["service"])
    ratios: list[Any] = [b / s for b, s in zip(seconds["bare"], seconds["service"], strict=True)]
    print(
        f"{jobs} jobs of {POINTS} points x {FRAMES} frames, {workers} workers",
        f"bare RQ  {jobs / bare:.2f} jobs/s",
        f"service  {jobs / whole:.2f} jobs/s, {bare / whole:.2f} of bare RQ "
        f"(batches {min(ratios):.2f} to {max(ratios):.2f}); in the queue {percentiles(queued)}",
        f"idle service, {singles} single jobs: overhead {percentiles(overheads)} "
        f"(solver {statistics.median(solver) * 1000:.0f} ms; "
        f"alone {statistics.median(alone) * 1000:.0f} ms)",
        sep="\n",
    )


def _matrices(folder: Path, count: int, first: int = 0) -> list[Path]:
    """Write distinct matrices, so that no result of one can serve another."""
    paths = []
    for seed in range(first, first + count):
        example = make_low_rank(FRAMES, POINTS, modes=3, seed=seed)
        paths.append(folder / f"tracks-{seed}.npy")
        np.save(paths[-1], example.measurements)
    return paths


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batches", type=int, default=5)
    parser.add_argument("--singles", type=int, default=100)
    parser.add_argument("--bare-worker", metavar="REDIS_URL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.bare_worker:
        work_bare(arguments.bare_worker)
    else:
        run(arguments.jobs, arguments.workers, arguments.batches, arguments.singles)


if __name__ == "__main__":
    main()
