"""The service against its own OpenAPI document, by Schemathesis: any request, in any order."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.conftest import ROOT, clean_environment, redis_running
from tests.service.conftest import api_running, settings_for
from worker.keys import KeyStore
from worker.pool import WorkerPool

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

EXAMPLES = os.environ.get("SMSR_CONTRACT_EXAMPLES", "")
"""Requests for each operation and phase; 20 make some thousands in all, which takes minutes."""
PHASES = "examples,coverage,fuzzing,stateful" if EXAMPLES else "examples,fuzzing,stateful"
"""Without a number asked for, a sample that takes less than a minute."""


@pytest.mark.slow
def test_every_answer_is_as_documented(tmp_path: Path) -> None:
    config = ROOT / "tests" / "service" / "contract" / "schemathesis.toml"
    with redis_running(tmp_path) as redis:
        settings = settings_for(tmp_path, redis, access="keys", event_heartbeat_seconds=0.5)
        _, key = KeyStore(redis.client()).create("ann")
        with api_running(settings, redis, tmp_path / "log") as api, WorkerPool(settings, 1):
            run = subprocess.run(
                [
                    *(sys.executable, "-m", "schemathesis.cli", "--config-file", str(config)),
                    *("run", f"{api.url}/openapi.json", "--checks", "all"),
                    *("--header", f"Authorization: Bearer {key}"),
                    *("--phases", PHASES, "--max-examples", EXAMPLES or "5"),
                    *("--no-color", "--generation-database", ":memory:"),
                ],
                cwd=tmp_path,
                env=clean_environment(),
                capture_output=True,
                text=True,
                timeout=3000,
            )
        assert run.returncode == 0, run.stdout[-20_000:] + run.stderr[-2000:]
        cases = re.search(r"(\d+) generated", run.stdout)
        assert cases is not None
        assert int(cases[1]) > (500 if EXAMPLES else 50)
        log.info("%s", run.stdout[run.stdout.rindex(" SUMMARY ") :])
        assert "Traceback" not in api.log.read_text()
