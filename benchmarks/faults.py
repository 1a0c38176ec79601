"""The whole service under failures: every accepted job ends well, once, with the right arrays.

    python benchmarks/faults.py --jobs 200

Two API processes and two workers share a Redis server (append-only file, every write synced) and a
folder. While clients send jobs of mixed size, by multipart and by tus, and wait for them, workers
and their work-horses are killed with SIGKILL every few seconds, one API process again and again in
the middle of uploads, Redis twice, and for ten seconds the storage can be neither written nor read.
At the end the script compares all arrays with those of runs in its own process, looks for jobs that
are lost, doubled or ended twice (by the service's own count, and by the webhooks that a receiver
got), deletes all jobs and looks for what is left over. It exits with 1 where anything is, and where
the jobs were done before everything had been broken.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
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
ARRAYS = ("shapes", "cameras", "translations")

REDIS_AT = (12.0, 36.0)
STORAGE_AT = 22.0
STORAGE_SECONDS = 10.0
"""When what is not broken again and again is broken, in seconds from the start."""
LEAST = {"worker": 5, "work-horse": 5, "API": 3, "Redis": len(REDIS_AT), "storage": 1}
"""How often each has to have been broken for a run to count."""

STANDING = re.compile(
    r"smsr:(counters|workers|maintained|looking|orphans|incoming)"
    r"|rq:(queues|workers(:.*)?|wip:.*)"
)
"""Keys that are there without jobs, too, and RQ's list of what runs, whose entries lapse; all
others have to be gone, or go by themselves."""


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
        began, rounds = time.monotonic(), 0
        redis_at, storage_at = [*REDIS_AT], [STORAGE_AT]
        while not self.stop.wait(self.rng.uniform(1.5, 3.5)):
            rounds += 1
            self._kill_worker()
            if rounds % 3 == 0:
                self._kill_api()
            if redis_at and time.monotonic() - began > redis_at[0]:
                redis_at.pop(0)
                self.redis.kill()
                self.done["Redis"] += 1
                time.sleep(1.0)
                self.redis.start()
            if storage_at and time.monotonic() - began > storage_at[0]:
                storage_at.pop()
                self._break_storage()

    def missing(self) -> list[str]:
        """Return what was not broken as often as it has to be."""
        found = ((what, self.done[what], least) for what, least in LEAST.items())
        return [f"broken too rarely: {w}, {n} of {least}" for w, n, least in found if n < least]

    def _kill_worker(self) -> None:
        workers = self.pool.pids
        if not workers:
            return
        worker = self.rng.choice(workers)
        horses = [pid for pid in children(worker) if self.rng.random() < 0.8]
        what = self.rng.choice(["work-horse", "worker", "both"])
        if what != "work-horse":
            kill(worker)
            self.done["worker"] += 1
        if what != "worker":
            for horse in horses:
                kill(horse)
                self.done["work-horse"] += 1

    def _kill_api(self) -> None:
        """Wait for an upload to be under way, then kill the process that receives it."""
        self.uploading.clear()
        if self.uploading.wait(3.0) and self.api.pid is not None:
            time.sleep(self.rng.uniform(0.0, 0.02))
            kill(self.api.pid)
            self.done["API"] += 1

    def _break_storage(self) -> None:
        away = self.objects.with_name("objects.away")
        self.objects.rename(away)
        self.objects.touch()  # a file: no folder can be made where it stands
        self.stop.wait(STORAGE_SECONDS)
        self.objects.unlink()
        away.rename(self.objects)
        self.done["storage"] += not self.stop.is_set()


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


def digest(folder: Path) -> str:
    """Return a hash of the arrays of a result, types and shapes included."""
    found = hashlib.sha256()
    for name in ARRAYS:
        array = np.load(folder / f"{name}.npy")
        found.update(f"{array.dtype} {array.shape} ".encode() + array.tobytes())
    return found.hexdigest()


@dataclass
class Receiver:
    """What webhooks told: for each job the ids and types of its messages."""

    url: str = ""
    told: defaultdict[str, set[tuple[str, str]]] = field(default_factory=lambda: defaultdict(set))


@contextlib.contextmanager
def receiving() -> Iterator[Receiver]:
    """Take webhooks until the block ends."""
    receiver = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            document = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            message = (self.headers["webhook-id"], document["type"])
            receiver.told[document["data"]["id"]].add(message)
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        receiver.url = f"http://127.0.0.1:{server.server_address[1]}/"
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield receiver
        server.shutdown()


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
            expected[path] = digest(result)
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
        webhook_secret="whsec_" + base64.b64encode(os.urandom(32)).decode(),
        webhook_http=True,
        webhook_allow="127.0.0.0/8",
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
    webhook: str
    refused: Counter[str] = field(default_factory=Counter)

    def run(self, number: int, path: Path) -> tuple[str, Path]:
        """Send one job until it is accepted, wait for its end; return its id."""
        api, by_tus = number % 2, number // 2 % 2
        with Client(self.urls[api], patience=PATIENCE) as client:

            def told(done: int, _total: int) -> None:
                if done > 0 and api == 0:  # the one that is killed
                    self.killer.uploading.set()

            submit = partial(
                client.submit,
                path,
                settings={"reuse": False, "webhook": self.webhook},
                progress=told,
                resumable=0 if by_tus else 1 << 40,
            )
            return client.wait(self._insist(submit).id, timeout=PATIENCE).id, path

    def _insist(self, submit: Callable[[], Job]) -> Job:
        while True:
            try:
                return submit()
            except ServiceError as error:
                # What a client that is cut off may be told; it sends again.
                self.refused[error.slug or str(error.status)] += 1
                if self.refused.total() > 1000:
                    raise
                time.sleep(0.5)


def check(
    queue: JobQueue, ids: dict[str, Path], expected: dict[Path, str], receiver: Receiver
) -> list[str]:
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
        if record is None or record.status != "succeeded" or record.result_prefix is None:
            status = record and (record.status, record.problem)
            wrong.append(f"not succeeded: {job} {status}")
            continue
        assert queue.storage.folder is not None
        if digest(queue.storage.folder / record.result_prefix) != expected[path]:
            wrong.append(f"wrong arrays: {job} of {path.name}")
    ended = queue.records.survey(60).counters.ended
    if ended != {"succeeded": len(ids)}:
        wrong.append(f"ends counted: {ended}")
    for job in {*ids, *receiver.told}:
        types = [kind for _, kind in receiver.told[job]]
        if types != ["job.succeeded"]:
            wrong.append(f"webhooks told of {job}: {types}")
    return wrong


def leftovers(queue: JobQueue, settings: Settings) -> list[str]:
    """Return the files and keys that should not be there without a job."""
    folders = (settings.data_dir / "objects", settings.scratch)
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    redis = queue.redis
    keys = [
        f"{key.decode()}: {redis.hgetall(key) if redis.type(key) == b'hash' else redis.dump(key)!r}"
        for key in redis.scan_iter("*")
        if not STANDING.fullmatch(key.decode()) and redis.pttl(key) == -1
    ]
    return [str(path) for path in files if path.suffix != ".lock"] + keys


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
        with receiving() as receiver, cluster(folder) as (queue, killer, urls):
            breaking = threading.Thread(target=killer.run)
            breaking.start()
            began = time.monotonic()
            sender = Sender(urls, killer, receiver.url)
            with ThreadPoolExecutor(SENDERS) as senders:
                ids = dict(senders.map(sender.run, range(jobs), paths))
            seconds = time.monotonic() - began
            killer.stop.set()
            breaking.join()
            records = [queue.records.get(job) for job in ids]
            attempts = Counter(record.attempt for record in records if record)
            print(f"{jobs} jobs in {seconds:.0f} s; broken: {dict(killer.done)}")
            print(
                f"attempts: {dict(sorted(attempts.items()))}; refused and sent again: "
                f"{dict(sender.refused)}",
                flush=True,
            )
            with contextlib.suppress(SystemExit):
                wait_for(lambda: not queue.redis.exists("smsr:webhooks"))
            wrong = killer.missing() + check(queue, ids, expected, receiver)
            for job in ids:
                queue.delete(job)
            with contextlib.suppress(SystemExit):
                wait_for(lambda: not leftovers(queue, queue.settings), 90)
            wrong += [f"left over: {what}" for what in leftovers(queue, queue.settings)]
    print(
        "\n".join(wrong)
        or "each job succeeded once, with the right arrays, and was told of once; nothing is left"
    )
    return 1 if wrong else 0


def main() -> None:
    """Run with the arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, default=200)
    raise SystemExit(run(parser.parse_args().jobs))


if __name__ == "__main__":
    main()
