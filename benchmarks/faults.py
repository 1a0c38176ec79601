"""The whole service under failures: every accepted job ends well, once, with the right arrays.

    python benchmarks/faults.py --jobs 200

Two API processes and two workers share a Redis server (append-only file, every write synced) and a
folder. While clients send jobs of mixed size and wait for them, workers and their work-horses are
killed with SIGKILL every few seconds, one API process again and again in the middle of uploads,
Redis twice, and for ten seconds the storage can be neither written nor read. At the end the script
compares all arrays with those of runs in its own process, looks for jobs that are lost, doubled or
ended twice, deletes all jobs and looks for what is left over. It exits with 1 where anything is.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import numpy as np
import redis
from threadpoolctl import threadpool_limits

import smsr
from smsr.synthetic import make_low_rank
from smsr_client import Client, ServiceError
from worker.connections import connect
from worker.pool import WorkerPool
from worker.processes import KeptProcess
from worker.queue import JobQueue
from worker.redis_server import find_server
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smsr_client import Job

SIZES = ((60, 41), (120, 400), (60, 20_000))
"""Frames and points of small, medium and large jobs; the last are uploads of 10 MB and more."""
SHARES = (0.6, 0.3, 0.1)
DISTINCT = 7
"""Matrices of each size."""
SENDERS = 6
PATIENCE = 600.0


@dataclass
class Killer:
    """Breaks parts of the service until it is told to stop, and counts."""

    pool: WorkerPool
    api: KeptProcess
    redis: RedisServer
    objects: Path
    rng: random.Random
    done: Counter[str] = field(default_factory=Counter)
    uploading: threading.Event = field(default_factory=threading.Event)
    stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Break something every few seconds."""
        rounds = 0
        while not self.stop.wait(self.rng.uniform(1.5, 3.5)):
            rounds += 1
            self._kill_worker()
            if rounds % 3 == 0:
                self._kill_api()
            if rounds in (8, 20):
                self.redis.kill()
                self.done["Redis killed"] += 1
                time.sleep(1.0)
                self.redis.start()
            if rounds == 14:
                self._break_storage(10.0)

    def _kill_worker(self) -> None:
        workers = self.pool.pids
        if not workers:
            return
        worker = self.rng.choice(workers)
        horses = [pid for pid in children(worker) if self.rng.random() < 0.8]
        what = self.rng.choice(["work-horse", "worker", "both"])
        if what != "work-horse":
            kill(worker)
        if what != "worker":
            for horse in horses:
                kill(horse)
        self.done[f"{what} killed"] += 1

    def _kill_api(self) -> None:
        """Wait for an upload to be under way, then kill the process that receives it."""
        self.uploading.clear()
        if self.uploading.wait(3.0) and self.api.pid is not None:
            time.sleep(self.rng.uniform(0.0, 0.02))
            kill(self.api.pid)
            self.done["API killed in an upload"] += 1

    def _break_storage(self, seconds: float) -> None:
        away = self.objects.with_name("objects.away")
        self.objects.rename(away)
        self.objects.touch()  # a file: no folder can be made where it stands
        self.stop.wait(seconds)
        self.objects.unlink()
        away.rename(self.objects)
        self.done["storage broken for 10 s"] += 1


class RedisServer:
    """A Redis server that keeps every write it answered."""

    def __init__(self, folder: Path) -> None:
        self.url = f"unix://{folder}/redis.sock"
        options = {"--port": "0", "--unixsocket": f"{folder}/redis.sock", "--dir": str(folder)}
        options |= {"--save": "", "--appendonly": "yes", "--appendfsync": "always"}
        self._command = [find_server(), *(part for option in options.items() for part in option)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it and wait until it answers."""
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)
        with redis.Redis.from_url(self.url) as client:
            while True:
                with contextlib.suppress(redis.RedisError):
                    client.ping()
                    return
                time.sleep(0.02)

    def kill(self) -> None:
        """Kill it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def kill(pid: int) -> None:
    """Send SIGKILL; a process that has just ended is no error."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def children(parent: int) -> list[int]:
    """Return the direct children of a process."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if int(path.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(path.parent.name))
    return found


def digest(array: np.ndarray) -> str:
    """Return a hash of an array's values."""
    return hashlib.sha256(np.ascontiguousarray(array, dtype=np.float32).tobytes()).hexdigest()


def make_inputs(folder: Path) -> dict[Path, str]:
    """Write the matrices; return the hashes of the shapes that a run here gives."""
    expected = {}
    for frames, points in SIZES:
        for seed in range(DISTINCT):
            example = make_low_rank(frames, points, modes=2, seed=seed)
            path = folder / f"{frames}x{points}-{seed}.npy"
            np.save(path, example.measurements)
            result = folder / "result"
            smsr.reconstruct(path, out=result)
            expected[path] = digest(np.load(result / "shapes.npy"))
            shutil.rmtree(result)
    return expected


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[tuple[JobQueue, Killer, list[str]]]:
    """Run Redis, two workers and two API processes until the block ends."""
    server = RedisServer(folder)
    server.start()
    settings = Settings(
        data_dir=folder / "data",
        redis_url=server.url,
        workers=2,
        threads=1,
        log_level="ERROR",
        max_attempts=100,
        orphan_grace_seconds=20,
    )
    objects = settings.data_dir / "objects"
    objects.mkdir(parents=True)
    environment = os.environ | settings.to_environ()
    environment |= {"PYTHONPATH": str(Path(__file__).parents[1]), "SMSR_ACCESS": "open"}
    ports = [_free_port(), _free_port()]
    serve = [sys.executable, "-m", "uvicorn", "--factory", "service.app:app_from_environment"]
    apis = [
        KeptProcess(
            [*serve, "--port", str(port), "--log-level", "critical"], environment=environment
        )
        for port in ports
    ]
    with contextlib.ExitStack() as stack:
        stack.callback(server.kill)
        pool = stack.enter_context(WorkerPool(settings))
        for api in apis:
            api.start()
            stack.callback(api.stop)
        urls = [f"http://127.0.0.1:{port}" for port in ports]
        for url in urls:
            wait_for(partial(ready, url))
        queue = JobQueue(settings, connect(server.url, patient=True))
        rng = random.Random(0)
        yield queue, Killer(pool, apis[0], server, objects, rng), urls


def ready(url: str) -> bool:
    """Return whether an API process takes jobs."""
    return httpx.get(f"{url}/readyz").status_code == 200


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something holds, whatever is raised before."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(httpx.TransportError, redis.RedisError):
            if condition():
                return
        time.sleep(0.2)
    raise SystemExit(f"not within {seconds} s: {condition}")


def _free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Sender:
    """Sends jobs and waits for them, as a patient client does."""

    urls: list[str]
    killer: Killer
    refused: Counter[str] = field(default_factory=Counter)

    def run(self, number: int, path: Path) -> tuple[str, Path]:
        """Send one job until it is accepted, wait for its end; return its id."""
        with Client(self.urls[number % 2], patience=PATIENCE) as client:
            job = self._submit(client, path)
            return client.wait(job.id, timeout=PATIENCE).id, path

    def _submit(self, client: Client, path: Path) -> Job:
        def told(done: int, _total: int) -> None:
            if done > 0:
                self.killer.uploading.set()

        while True:
            try:
                return client.submit(path, settings={"reuse": False}, progress=told)
            except ServiceError as error:
                # What a client that is cut off may be told; it sends again.
                self.refused[error.slug or str(error.status)] += 1
                if self.refused.total() > 1000:
                    raise
                time.sleep(0.5)


def check(queue: JobQueue, ids: dict[str, Path], expected: dict[Path, str]) -> list[str]:
    """Return what is wrong, a line each."""
    wrong = []
    listed, cursor = [], None
    while True:
        page = queue.records.list(cursor=cursor, limit=500)
        listed += [record.id for record in page.records]
        cursor = page.next_cursor
        if cursor is None:
            break
    wrong += [f"lost: {job}" for job in ids if job not in listed]
    wrong += [f"doubled: {job}" for job in listed if job not in ids]
    for job, path in ids.items():
        record = queue.records.get(job)
        if record is None or record.status != "succeeded":
            status = record and (record.status, record.problem)
            wrong.append(f"not succeeded: {job} {status}")
            continue
        found = queue.storage.open_local(f"{record.result_prefix}shapes.npy", path.parent)
        if digest(np.load(found)) != expected[path]:
            wrong.append(f"wrong arrays: {job} of {path.name}")
    ended = queue.records.survey(60).counters.ended
    if ended != {"succeeded": len(ids)}:
        wrong.append(f"ends counted: {ended}")
    return wrong


def leftovers(queue: JobQueue) -> list[str]:
    """Return the objects and keys that are there."""
    objects = [
        item.key for kind in ("uploads/", "results/") for item in queue.storage.list_prefix(kind)
    ]
    keys = [key.decode() for key in queue.redis.scan_iter("*")]
    return objects + [key for key in keys if key.startswith(("smsr:job", "rq:job", "smsr:upload"))]


def run(jobs: int) -> int:
    """Run and print; return the exit code."""
    threadpool_limits(1)
    with tempfile.TemporaryDirectory(prefix="smsr-faults-") as name:
        folder = Path(name)
        (folder / "inputs").mkdir()
        expected = make_inputs(folder / "inputs")
        by_size = [list(expected)[i : i + DISTINCT] for i in range(0, len(expected), DISTINCT)]
        rng = random.Random(1)
        paths = [rng.choice(rng.choices(by_size, SHARES)[0]) for _ in range(jobs)]
        with cluster(folder) as (queue, killer, urls):
            breaking = threading.Thread(target=killer.run)
            breaking.start()
            began = time.monotonic()
            sender = Sender(urls, killer)
            with ThreadPoolExecutor(SENDERS) as senders:
                ids = dict(senders.map(sender.run, range(jobs), paths))
            seconds = time.monotonic() - began
            killer.stop.set()
            breaking.join()
            records = [queue.records.get(job) for job in ids]
            attempts = Counter(record.attempt for record in records if record)
            print(f"{jobs} jobs in {seconds:.0f} s; {dict(killer.done)}")
            print(
                f"attempts: {dict(sorted(attempts.items()))}; refused and sent again: "
                f"{dict(sender.refused)}"
            )
            wrong = check(queue, ids, expected)
            for job in ids:
                queue.delete(job)
            with contextlib.suppress(SystemExit):
                wait_for(lambda: not leftovers(queue), 90)
            wrong += [f"left over: {what}" for what in leftovers(queue)]
    print("\n".join(wrong) or "each job succeeded once, with the right arrays; nothing is left")
    return 1 if wrong else 0


def main() -> None:
    """Run with the arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, default=200)
    raise SystemExit(run(parser.parse_args().jobs))


if __name__ == "__main__":
    main()
