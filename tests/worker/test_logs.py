from __future__ import annotations

import json
import subprocess
import sys

PROGRAM = """
import logging, structlog
from worker.logs import configure_logging
configure_logging("INFO")
log = structlog.get_logger("x")
with structlog.contextvars.bound_contextvars(job="ab12"):
    log.info("began", points=3)
    try:
        1 / 0
    except ZeroDivisionError:
        log.exception("failed")
logging.getLogger("library").warning("heard %s", "too")
logging.getLogger("rq.worker").info("not heard")
log.debug("not heard")
"""


def test_logs_are_json_lines() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    assert [line["event"] for line in lines] == ["began", "failed", "heard too"]
    assert (lines[0]["job"], lines[0]["points"], lines[0]["level"]) == ("ab12", 3, "info")
    assert "ZeroDivisionError" in lines[1]["exception"]
    assert all("timestamp" in line for line in lines)
