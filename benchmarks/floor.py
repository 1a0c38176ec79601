"""Time the two passes over the points against the least that any implementation must do.

    python benchmarks/floor.py --frames 51 --points 1000 10000 100000 1000000

The floor reads W once, multiplies two matrices with the operation counts of the factorisation
(float64) and of the map back (float32), and writes S sequentially, each with plain numpy and plain
files. Floor and passes alternate in one run, so that both meet the same machine; the table gives
medians of wall time, and each ratio is the median over the runs: of wall time, and of processor
time for machines that are busy with other things. On these set OMP_NUM_THREADS=1 as well: threads
of BLAS that wait for each other make the floor look slow.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smsr.measurements import as_source
from smsr.rowspace import factorise, map_back
from smsr.streaming import blas_threads

if TYPE_CHECKING:
    from collections.abc import Callable

BLOCK_BYTES = 16 * 2**20


def make_measurements(path: Path, frames: int, points: int) -> None:
    """Write tracks of low rank with noise, float32, a run of rows at a time."""
    rng = np.random.default_rng(0)
    basis = rng.standard_normal((12, points), dtype=np.float32)
    W = np.lib.format.open_memmap(path, "w+", np.dtype("<f4"), (2 * frames, points))
    for row in range(2 * frames):
        weights = rng.standard_normal(12, dtype=np.float32)
        noise = rng.standard_normal(points, dtype=np.float32)
        W[row] = weights @ basis + 1e-3 * noise + rng.standard_normal() * 100
    W.flush()


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Return the wall and the processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def read_floor(path: Path) -> None:
    buffer = bytearray(BLOCK_BYTES)
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass


def write_floor(path: Path, size: int) -> None:
    buffer = np.ones(BLOCK_BYTES, np.uint8).data
    with path.open("wb", buffering=0) as file:
        while size > 0:
            size -= file.write(buffer[: min(size, BLOCK_BYTES)])


def multiply_floor(rows: int, columns: int, points: int, inner_is_points: bool) -> None:
    """Multiply in blocks: (rows, n) by (n, columns), or (rows, columns) by (columns, n)."""
    dtype = np.float64 if inner_is_points else np.float32
    step = min(points, 16384)
    if inner_is_points:
        left, right = np.ones((rows, step), dtype), np.ones((step, columns), dtype)
        out = np.empty((rows, columns), dtype)
    else:
        left, right = np.ones((rows, columns), dtype), np.ones((columns, step), dtype)
        out = np.empty((rows, step), dtype)
    for _ in range(-(-points // step)):
        np.matmul(left, right, out=out)


def measure(frames: int, points: int, repeats: int, folder: Path) -> None:
    path = folder / "W.npy"
    make_measurements(path, frames, points)
    A = np.random.default_rng(1).standard_normal((3 * frames, 2 * frames))
    source = as_source(np.load(path, mmap_mode="r"))
    rowspace = factorise(source)
    rows = 2 * frames
    parts: dict[str, Callable[[], object]] = {
        "read": lambda: read_floor(path),
        "matmul 1": lambda: multiply_floor(rows, rows, points, inner_is_points=True),
        "matmul 2": lambda: multiply_floor(3 * frames, rows, points, inner_is_points=False),
        "write": lambda: write_floor(folder / "floor", 3 * frames * points * 4),
        "factorise": lambda: factorise(source),
        "map back": lambda: map_back(source, rowspace, A, folder / "S"),
    }
    runs = np.array([[timed(work) for work in parts.values()] for _ in range(repeats)])
    floor, ours = runs[:, :4].sum(axis=1), runs[:, 4:].sum(axis=1)
    walls = np.median(np.column_stack([runs[:, :, 0], floor[:, 0], ours[:, 0]]), axis=0)
    ratios = np.median(ours / floor, axis=0)
    print(
        f"{points:9d}",
        *(f"{value:9.3g}" for value in walls),
        *(f"{value:9.2f}" for value in ratios),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=51)
    parser.add_argument("--points", type=int, nargs="+", default=[10**3, 10**4, 10**5, 10**6])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="where files go; the default is temporary")
    arguments = parser.parse_args()
    columns = ["points", "read", "matmul 1", "matmul 2", "write", "factorise", "map back"]
    columns += ["floor", "ours", "ratio", "cpu ratio"]
    print(f"{arguments.frames} frames, {blas_threads()} threads, seconds (median)")
    print(*(f"{column:>9}" for column in columns))
    for points in arguments.points:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            measure(arguments.frames, points, arguments.repeats, Path(folder))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak resident memory {peak:.0f} MiB")


if __name__ == "__main__":
    main()
