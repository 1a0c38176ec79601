"""The benchmarks run, and what they compare agrees."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(name: str, *arguments: str) -> list[list[str]]:
    """Return the words of each line that a benchmark prints."""
    answer = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / name), *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    return [line.split() for line in answer.stdout.splitlines()]


def test_floor(tmp_path: Path) -> None:
    options = ("--frames", "10", "--repeats", "2", "--folder", str(tmp_path))
    rows = run("floor.py", *options, "--points", "100", "5000")
    first, second = rows[2:4]
    assert (first[0], second[0]) == ("100", "5000")
    assert all(float(word) > 0 for word in first[5:])
    assert not list(tmp_path.iterdir())


def test_the_reduction_computes_the_same_as_the_whole() -> None:
    rows = run("unreduced.py", "--frames", "12", "--points", "300", "3000", "--iterations", "20")
    for row in rows[2:]:
        assert float(row[-1]) < 1e-12
