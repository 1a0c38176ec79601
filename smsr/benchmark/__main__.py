"""The process that measures one set: a task as JSON on standard input, the result on output."""

from __future__ import annotations

import json
import sys

from smsr.benchmark.measure import run_task

if __name__ == "__main__":
    sys.stdout.write(json.dumps(run_task(json.load(sys.stdin))))
