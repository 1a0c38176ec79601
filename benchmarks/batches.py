"""A batch of thousands of jobs: what it takes to look at it, and to deal with all of it.

    python benchmarks/batches.py --jobs 5000

The records of the jobs are made in Redis, nine of ten ended with an error and a time, one of ten
queued, beside as many jobs of no batch. Then each request is made again and again over HTTP.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
import redis

from benchmarks.scaling import redis_server, service
from worker.records import InputFile, JobRecord, RecordStore, upload_key

LABEL = "many"
REPEATS = 20


def fill(url: str, jobs: int) -> int:
    """Make the records; return the bytes of a job in Redis."""
    with redis.Redis.from_url(url) as client:
        store = RecordStore(client, result_ttl=86400)
        before = client.info("memory")["used_memory"]
        rng = np.random.default_rng(0)
        for number in range(2 * jobs):
            batch = LABEL if number % 2 else None
            made = JobRecord.new(options={}, inputs={}, batch=batch)
            file = InputFile(upload_key(made.id, "measurements"), f"w{number}.npy", 10**6, "0" * 64)
            record = JobRecord.new(
                made.id, options={}, inputs={"measurements": file}, batch=batch, name=file.name
            )
            store.create(record)
            if number // 2 % 10:
                attempt = store.begin_attempt(record.id, worker="w", ticket="t", lease=60)
                assert attempt is not None
                store.publish(
                    record.id,
                    attempt,
                    frames=100,
                    points=1000,
                    timings={"cameras": 0.1, "shapes": 0.2},
                    metrics={"e3d": float(rng.uniform(0, 0.1))},
                )
        return int((client.info("memory")["used_memory"] - before) / (2 * jobs))


def measure(client: httpx.Client, what: str) -> str:
    """Return a row of the table: the times of a request that only looks."""
    method, path = what.split(" ", 1)
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        client.request(method, path).raise_for_status()
        seconds.append(time.perf_counter() - began)
    return f"| `{what}` | {statistics.median(seconds) * 1000:.0f} | {max(seconds) * 1000:.0f} |"


def walk(client: httpx.Client) -> str:
    """Return the row of going through all pages of the jobs of the batch."""
    began, path, pages = time.perf_counter(), f"/v1/jobs?batch={LABEL}&limit=200", 0
    while path:
        path, pages = client.get(path).raise_for_status().json()["next"], pages + 1
    seconds = time.perf_counter() - began
    return f"| all {pages} pages of 200 jobs | {seconds * 1000:.0f} | |"


def once(client: httpx.Client, method: str, path: str) -> str:
    """Return the row of a request that deals with the whole batch."""
    began = time.perf_counter()
    client.request(method, path).raise_for_status()
    return f"| `{method} {path}` | {(time.perf_counter() - began) * 1000:.0f} | |"


def run(jobs: int) -> None:
    """Measure and print."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="smsr-batches-")))
        url = stack.enter_context(redis_server(folder))
        size = fill(url, jobs)
        server, _ = stack.enter_context(service(folder / "data", url, 0, 1))
        client = stack.enter_context(httpx.Client(base_url=server, timeout=120))
        here = f"/v1/batches/{LABEL}"
        lines = ["| request | median, ms | most, ms |", "|---|---:|---:|"]
        looks = (here, "/v1/batches", f"/v1/jobs?batch={LABEL}", "/v1/jobs?limit=200", "/metrics")
        lines += [measure(client, f"GET {path}") for path in looks]
        lines.append(walk(client))
        lines.append(once(client, "POST", f"{here}/cancel"))
        lines.append(once(client, "POST", f"{here}/retry"))
        lines.append(once(client, "DELETE", here))
        print(f"{jobs} jobs of one batch among {2 * jobs}; {size} bytes of Redis a job")
        print("\n".join(lines))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, default=5000)
    run(parser.parse_args().jobs)


if __name__ == "__main__":
    main()
