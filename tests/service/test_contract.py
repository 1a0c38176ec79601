"""The service against its own OpenAPI document, by Schemathesis: any request, in any order."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.conftest import ROOT, clean_environment

if TYPE_CHECKING:
    from pathlib import Path

    from tests.service.conftest import Api

EXAMPLES = os.environ.get("SMSR_CONTRACT_EXAMPLES", "8")
"""Requests for each operation and phase."""


@pytest.mark.slow
def test_every_answer_is_as_documented(api: Api, tmp_path: Path) -> None:
    config = ROOT / "tests" / "service" / "contract" / "schemathesis.toml"
    run = subprocess.run(
        [
            *(sys.executable, "-m", "schemathesis.cli", "--config-file", str(config)),
            *("run", f"{api.url}/openapi.json", "--checks", "all"),
            *("--phases", "examples,coverage,fuzzing,stateful", "--max-examples", EXAMPLES),
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
    assert int(cases[1]) > 200
    assert "Traceback" not in api.log.read_text()
