"""Limits of control groups, read from trees laid out as the kernel lays them out."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from worker.cgroup import available_cores, cpu_limit, memory_limit, out_of_memory_kills

if TYPE_CHECKING:
    from pathlib import Path

GIB = 1 << 30


def lay(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def member(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "membership"
    path.write_text(text)
    return path


def test_version_2_container(tmp_path: Path) -> None:
    lay(
        tmp_path,
        {
            "cpu.max": "150000 100000\n",
            "memory.max": f"{2 * GIB}\n",
            "memory.events": "low 0\nhigh 0\nmax 12\noom 1\noom_kill 3\noom_group_kill 0\n",
        },
    )
    here = member(tmp_path, "0::/\n")
    assert cpu_limit(tmp_path, here) == 1.5
    assert memory_limit(tmp_path, here) == 2 * GIB
    assert out_of_memory_kills(tmp_path, here) == 3


def test_version_2_limit_of_a_group_above(tmp_path: Path) -> None:
    lay(
        tmp_path,
        {
            "smsr.slice/cpu.max": "200000 100000\n",
            "smsr.slice/memory.max": f"{GIB}\n",
            "smsr.slice/worker.service/cpu.max": "max 100000\n",
            "smsr.slice/worker.service/memory.max": f"{3 * GIB}\n",
        },
    )
    here = member(tmp_path, "0::/smsr.slice/worker.service\n")
    assert cpu_limit(tmp_path, here) == 2
    assert memory_limit(tmp_path, here) == GIB


@pytest.mark.parametrize("path", ["/", "/docker/0123456789ab"])
def test_version_1_container(tmp_path: Path, path: str) -> None:
    """The container's own group is mounted as the root, whatever the host calls it."""
    lay(
        tmp_path,
        {
            "cpu/cpu.cfs_quota_us": "50000\n",
            "cpu/cpu.cfs_period_us": "100000\n",
            "memory/memory.limit_in_bytes": f"{GIB}\n",
            "memory/memory.oom_control": "oom_kill_disable 0\nunder_oom 0\noom_kill 1\n",
        },
    )
    here = member(tmp_path, f"4:memory:{path}\n2:cpuacct,cpu:{path}\n0::{path}\n")
    assert cpu_limit(tmp_path, here) == 0.5
    assert memory_limit(tmp_path, here) == GIB
    assert out_of_memory_kills(tmp_path, here) == 1


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"cpu.max": "max 100000\n", "memory.max": "max\n"},
        {
            "cpu/cpu.cfs_quota_us": "-1\n",
            "cpu/cpu.cfs_period_us": "100000\n",
            "memory/memory.limit_in_bytes": "9223372036854771712\n",
        },
    ],
)
def test_no_limit(tmp_path: Path, files: dict[str, str]) -> None:
    lay(tmp_path, files)
    here = member(tmp_path, "4:memory:/\n1:cpu:/\n0::/\n")
    assert cpu_limit(tmp_path, here) is None
    assert memory_limit(tmp_path, here) is None
    assert out_of_memory_kills(tmp_path, here) is None


def test_system_without_control_groups(tmp_path: Path) -> None:
    absent = tmp_path / "absent"
    assert cpu_limit(tmp_path, absent) is None
    assert memory_limit(tmp_path, absent) is None


@pytest.mark.parametrize(("quota", "most"), [("50000", 1), ("150000", 1), ("200000", 2)])
def test_cores_that_a_quota_leaves(tmp_path: Path, quota: str, most: int) -> None:
    lay(tmp_path, {"cpu.max": f"{quota} 100000\n"})
    here = member(tmp_path, "0::/\n")
    assert available_cores(tmp_path, here) == min(most, len(os.sched_getaffinity(0)))


def test_a_wide_quota_does_not_make_cores(tmp_path: Path) -> None:
    lay(tmp_path, {"cpu.max": "102400000 100000\n"})
    here = member(tmp_path, "0::/\n")
    assert available_cores(tmp_path, here) == len(os.sched_getaffinity(0))
