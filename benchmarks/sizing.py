"""Memory and time of a job by frames and points, for the sizing table of docs/deployment.md.

    python benchmarks/sizing.py --frames 60 200 1000 --points 1000 10000 100000 1000000

Each size runs in a process of its own, from a .npy file to result files, as a worker does it. What
counts is private memory beyond that at the start, as in a budget of a worker (`worker.memory`).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from smsr.synthetic import make_low_rank
from worker.memory import private_bytes


def one(folder: Path) -> None:
    """Run the job whose tracks are in a folder, and print its memory and time as JSON."""
    import smsr
    import worker.task  # noqa: F401 - what a worker has loaded before a job begins

    start = most = private_bytes()
    done = threading.Event()

    def watch() -> None:
        nonlocal most
        while not done.wait(0.005):
            most = max(most, private_bytes())

    watcher = threading.Thread(target=watch)
    watcher.start()
    began = time.perf_counter()
    cpu = time.process_time()
    smsr.reconstruct(folder / "tracks.npy", out=folder)
    seconds = time.perf_counter() - began
    cpu = time.process_time() - cpu
    done.set()
    watcher.join()
    print(json.dumps({"bytes": most - start, "seconds": seconds, "cpu": cpu}))


def measure(frames: int, points: int) -> dict[str, float]:
    """Measure one size."""
    with tempfile.TemporaryDirectory(prefix="smsr-sizing-") as name:
        folder = Path(name)
        tracks = make_low_rank(frames, points, modes=4, noise=0.01).measurements
        np.save(folder / "tracks.npy", tracks.astype(np.float32))
        del tracks
        command = [sys.executable, __file__, "--one", name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return measured


def main() -> None:
    """Measure all sizes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[60, 200, 1000])
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        one(arguments.one)
        return
    print("| frames | points | memory, MiB | seconds | CPU seconds |\n|---:|---:|---:|---:|---:|")
    for frames in arguments.frames:
        for points in arguments.points:
            if frames * points > 100_000_000:
                continue
            found = measure(frames, points)
            mebibytes = found["bytes"] / (1 << 20)
            print(
                f"| {frames} | {points:,} | {mebibytes:.0f} | {found['seconds']:.1f} "
                f"| {found['cpu']:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
