"""Time the two passes over the points where an array lies on a device, against those of numpy.

    python -m benchmarks.device cupy torch:cuda --frames 51 --points 100000 1000000

Each name is a library of the array API, after a colon its device. The tracks, float32, lie in the
memory of the device; the shapes come back to that of the host. Both sides alternate in one run, and
the table gives medians of wall time. The last column is the largest difference of the shapes.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.floor import make_measurements, timed
from smsr.measurements import as_source
from smsr.rowspace import factorise, map_back
from smsr.streaming import blas_threads

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


def put(W: NDArray[np.float32], name: str) -> Any:
    """Copy W to the library and device of a name like torch:cuda."""
    library, _, device = name.partition(":")
    xp = importlib.import_module(library)
    return xp.asarray(W, device=device) if device else xp.asarray(W)


def measure(frames: int, points: int, names: list[str], repeats: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        make_measurements(Path(folder, "W.npy"), frames, points)
        W = np.load(Path(folder, "W.npy"))
    A = np.random.default_rng(1).standard_normal((3 * frames, 2 * frames))
    sources = {"numpy": as_source(W)} | {name: as_source(put(W, name)) for name in names}
    space = factorise(sources["numpy"])
    shapes = {name: np.empty((frames, points, 3), np.float32) for name in sources}
    work: list[Callable[[], object]] = []
    for name, source in sources.items():
        work += [partial(factorise, source), partial(map_back, source, space, A, shapes[name])]
    for each in work:  # the first call loads a device's libraries
        each()
    seconds = np.median([[timed(each)[0] for each in work] for _ in range(repeats)], axis=0)
    expected = shapes["numpy"]
    for name, (factorising, mapping) in zip(sources, seconds.reshape(-1, 2), strict=True):
        total, host = factorising + mapping, float(seconds[:2].sum())
        difference = float(np.abs(shapes[name] - expected).max() / np.abs(expected).max())
        print(
            f"{points:9d} {name:>12} {factorising:10.3g} {mapping:9.3g}"
            f" {total / host:9.2f} {difference:10.1e}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", help="libraries, with devices, e.g. torch:cuda")
    parser.add_argument("--frames", type=int, default=51)
    parser.add_argument("--points", type=int, nargs="+", default=[10**5, 10**6])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(f"{arguments.frames} frames, {blas_threads()} threads, seconds (median)")
    print("   points      library  factorise  map back  to numpy difference")
    for points in arguments.points:
        measure(arguments.frames, points, arguments.names, arguments.repeats)


if __name__ == "__main__":
    main()
