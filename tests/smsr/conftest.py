"""Fixtures of the solver's tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def evaluation_data() -> Path:
    """Folder of the evaluation data; tests that use it carry the marker `data`."""
    folder = Path(os.environ.get("SMSR_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("the evaluation data are not here (SMSR_DATA or ../shared/data)")
    return folder
