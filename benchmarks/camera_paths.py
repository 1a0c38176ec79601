"""Measure the error of true shapes under many camera paths and levels of noise.

    python benchmarks/camera_paths.py --data ../shared/data --out camera-paths

`smsr benchmark --camera-paths all` prints the same table; here every member is kept, too:
``camera-paths.md`` and ``camera-paths.json`` receive the table and the members.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from smsr.benchmark.camera_paths import (
    NOISES,
    PATHS,
    SHAPES,
    keys,
    lost_lines,
    measure_members,
    rows,
    write_members,
)


def markdown(table: list[list[str]], losses: list[str]) -> str:
    """Return the table and the members that lost."""
    head, *body = table
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body)]
    lines += ["", "Members that lost more than 5 %:", ""]
    return "\n".join([*lines, *(f"- {line}" for line in losses or ["none"])]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SMSR_DATA"))
    parser.add_argument("--out", type=Path, default=Path("camera-paths"))
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--paths", nargs="+", choices=list(PATHS), default=list(PATHS))
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES)
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.data is None or not chosen.data.is_dir():
        parser.error("the evaluation data are needed: --data FOLDER or SMSR_DATA")
    which = keys(chosen.shapes, chosen.paths, chosen.noises)
    members = list(measure_members(chosen.data, which, chosen.processes))
    text = markdown(rows(members), lost_lines(members))
    chosen.out.with_suffix(".md").write_text(text)
    write_members(chosen.out.with_suffix(".json"), members)
    print(text)


if __name__ == "__main__":
    main()
