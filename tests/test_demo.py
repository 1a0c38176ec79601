"""The first thing a newcomer runs."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conftest import ROOT, clean_environment

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.slow


def test_the_demo_reconstructs_over_http_and_cleans_up(tmp_path: Path) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    out = tmp_path / "demo-output"
    run = subprocess.run(
        [sys.executable, "-m", "service.cli", "demo", "-o", str(out)],
        capture_output=True,
        text=True,
        # A Redis server of the environment's is none of the demo's business.
        env=clean_environment(TMPDIR=str(temporary), REDIS_URL="redis://127.0.0.1:1"),
        cwd=tmp_path,
        timeout=240,
        check=False,
    )
    assert run.returncode == 0, run.stderr + (out / "server.log").read_text()
    said = run.stdout.partition("e3D = ")[2].split()
    assert 0.0 < float(said[0]) < 0.1
    with np.load(out / "result.npz") as arrays:
        frames, points, _ = arrays["shapes"].shape
    plies = sorted((out / "frames").glob("frame_*.ply"))
    assert len(plies) == frames
    assert f"element vertex {points}".encode() in plies[0].read_bytes()
    assert b"element face" in plies[0].read_bytes()
    assert list(temporary.iterdir()) == [], "the demo left files behind"


def test_every_target_of_the_makefile_calls_a_script_that_is_there() -> None:
    lines = (ROOT / "Makefile").read_text().splitlines()
    called = [line.split()[0].lstrip("@") for line in lines if line.startswith("\t@scripts/")]
    assert len(called) >= 5
    for script in called:
        path = ROOT / script
        assert path.stat().st_mode & 0o111, f"{script} cannot be run"
        assert path.read_text().startswith("#!"), script
