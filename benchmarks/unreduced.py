"""Time the published shape stage on all points against the same on virtual points.

    python benchmarks/unreduced.py --frames 51 --points 1000 10000 100000 --iterations 50

Both run the same code for the same number of iterations with the true cameras: once on the N
columns of the centred measurements, once on the columns of their left factor, with the pass over
the points before and the one after counted in. The last column is the largest difference between
the shapes relative to their largest coordinate: both compute the same. On a busy machine set
OMP_NUM_THREADS=1: threads of BLAS that wait for each other make the baseline look slow.
``--figure FILE`` draws the growth of both.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from smsr.lifting import exact_lifting
from smsr.measurements import as_source
from smsr.rotations import complete
from smsr.rowspace import factorise, map_back
from smsr.shapes.paper import published_shapes
from smsr.synthetic import make_low_rank

if TYPE_CHECKING:
    from numpy.typing import NDArray


def unreduced(
    W: NDArray[np.float64], rotations: NDArray[np.float64], iterations: int
) -> tuple[NDArray[np.floating], float]:
    """Return the shapes (T, N, 3) and the seconds."""
    start = time.perf_counter()
    centred = W - W.mean(axis=1, keepdims=True)
    scale = float(np.sqrt(np.linalg.eigvalsh(centred @ centred.T)[-1]))
    centred /= scale
    found = published_shapes(centred, rotations, max_iterations=iterations, tolerance=0.0)
    shapes = found.shapes.transpose(0, 2, 1) * scale
    return shapes, time.perf_counter() - start


def reduced(
    W: NDArray[np.float64], rotations: NDArray[np.float64], iterations: int
) -> tuple[NDArray[np.floating], list[float]]:
    """Return the shapes (T, N, 3) and the seconds of the three steps."""
    marks = [time.perf_counter()]
    source = as_source(W)
    space = factorise(source)
    marks.append(time.perf_counter())
    values = space.singular_values / space.singular_values[0]
    with threadpool_limits(limits=1, user_api="blas"):
        found = published_shapes(
            space.left * values, rotations, max_iterations=iterations, tolerance=0.0
        )
    marks.append(time.perf_counter())
    lifting = exact_lifting(found.shapes, rotations[:, :2], space.left, values)
    shapes = map_back(source, space, lifting)
    marks.append(time.perf_counter())
    return shapes, np.diff(marks).tolist()


def draw(target: Path, frames: int, rows: list[tuple[int, float, float]]) -> None:
    """Draw points against seconds, of the baseline and of ours, both axes logarithmic."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    points, baseline, ours = zip(*rows, strict=True)
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    axes.loglog(points, baseline, "o--", color="0.45", label="all points")
    axes.loglog(points, ours, "s-", color="0.0", label="virtual points, both passes included")
    axes.set_xlabel("points")
    axes.set_ylabel("seconds")
    axes.set_title(f"The published shape stage on {frames} frames", fontsize=11)
    axes.grid(which="major", color="0.9")
    axes.legend(frameon=False)
    figure.savefig(target, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=51)
    parser.add_argument("--points", type=int, nargs="+", default=[10**3, 10**4, 10**5])
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    rows: list[tuple[int, float, float]] = []
    columns = ["points", "unreduced", "factorise", "shapes", "map back", "ours", "ratio"]
    print(f"{arguments.frames} frames, {arguments.iterations} iterations, seconds")
    print(*(f"{column:>10}" for column in columns), "difference")
    for points in arguments.points:
        example = make_low_rank(arguments.frames, points, modes=4, noise=1e-2)
        W, rotations = example.measurements, complete(example.cameras)
        ours, seconds = reduced(W, rotations, arguments.iterations)
        theirs, baseline = unreduced(W, rotations, arguments.iterations)
        difference = float(np.abs(ours - theirs).max() / np.abs(theirs).max())
        total = sum(seconds)
        rows.append((points, baseline, total))
        print(
            f"{points:10d}",
            *(f"{value:10.3f}" for value in (baseline, *seconds, total)),
            f"{baseline / total:10.1f} {difference:10.1e}",
            flush=True,
        )
    if arguments.figure is not None:
        draw(arguments.figure, arguments.frames, rows)


if __name__ == "__main__":
    main()
