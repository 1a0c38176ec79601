"""The memory budget of a job, with real allocations."""

from __future__ import annotations

import mmap
import resource
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from worker.memory import memory_budget
from worker.problems import OutOfMemory, problem_document
from worker.settings import Settings

if TYPE_CHECKING:
    from pathlib import Path

MIB = 1 << 20

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux counts private memory")


def test_allocation_beyond_the_budget_fails_and_the_process_goes_on() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with pytest.raises(MemoryError), memory_budget(64 * MIB):
        np.ones(256 * MIB, dtype=np.uint8)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert np.ones(256 * MIB, dtype=np.uint8).all()


def test_allocation_within_the_budget_succeeds() -> None:
    with memory_budget(256 * MIB):
        assert np.ones(64 * MIB, dtype=np.uint8).all()


def test_no_budget_is_no_limit() -> None:
    with memory_budget(None):
        assert np.ones(256 * MIB, dtype=np.uint8).all()


def test_mapped_files_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "shapes"
    with path.open("wb") as new:
        new.truncate(256 * MIB)
    with (
        memory_budget(64 * MIB),
        path.open("r+b") as file,
        mmap.mmap(file.fileno(), 0) as mapped,
    ):
        assert mapped[255 * MIB] == 0


def test_setting_says_what_a_job_may_take(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(redis_url=None)
    monkeypatch.setattr("worker.settings.memory_limit", lambda: None)
    assert settings.memory_per_job is None
    monkeypatch.setattr("worker.settings.memory_limit", lambda: 4096 * MIB)
    whole, half = settings.memory_per_job, settings.model_copy(update={"workers": 2}).memory_per_job
    assert whole is not None
    assert half is not None
    assert 2048 * MIB < whole < 4096 * MIB
    assert half == whole - 2048 * MIB
    explicit = settings.model_copy(update={"job_memory_bytes": 123 * MIB})
    assert explicit.memory_per_job == 123 * MIB


def test_problem_names_the_budget() -> None:
    document = problem_document(OutOfMemory.budget(512 * MIB))
    assert document["type"] == "/problems/out-of-memory"
    assert document["limit_bytes"] == 512 * MIB
    assert "512 MiB" in document["detail"]
