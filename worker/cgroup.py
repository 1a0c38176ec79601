"""Limits that the kernel's control groups put on this process: a container's, a systemd unit's.

Both versions of the interface are read (cgroups(7)): version 2 has one tree for all controllers,
version 1 a tree for each. A limit of any group above ours binds us too, so the smallest counts.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path("/sys/fs/cgroup")
MEMBERSHIP = Path("/proc/self/cgroup")

_UNLIMITED_BYTES = 1 << 60
"""Version 1 has no word for 'none'; it gives the largest multiple of the page size."""


def available_cores(root: Path = ROOT, membership: Path = MEMBERSHIP) -> int:
    """Return how many cores this process can keep busy: by affinity and by CPU quota.

    A fraction of a core is left out: BLAS threads wait for each other, so one that is throttled
    holds up all.
    """
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    limit = cpu_limit(root, membership)
    return cores if limit is None else max(1, min(cores, int(limit)))


def cpu_limit(root: Path = ROOT, membership: Path = MEMBERSHIP) -> float | None:
    """Return the CPU quota in cores, which may be a fraction, or None without one."""
    limits = []
    for folder in _groups("cpu", root, membership):
        quota = _words(folder / "cpu.max") or (
            _words(folder / "cpu.cfs_quota_us") + _words(folder / "cpu.cfs_period_us")
        )
        if len(quota) == 2 and quota[0] not in ("max", "-1"):
            limits.append(int(quota[0]) / int(quota[1]))
    return min(limits, default=None)


def memory_limit(root: Path = ROOT, membership: Path = MEMBERSHIP) -> int | None:
    """Return the memory limit in bytes, or None without one."""
    limits = []
    for folder in _groups("memory", root, membership):
        for name in ("memory.max", "memory.limit_in_bytes"):
            words = _words(folder / name)
            if words and words[0] != "max" and int(words[0]) < _UNLIMITED_BYTES:
                limits.append(int(words[0]))
    return min(limits, default=None)


def out_of_memory_kills(root: Path = ROOT, membership: Path = MEMBERSHIP) -> int | None:
    """Return how many processes of our group the kernel has killed for want of memory.

    None where the kernel does not count them. A caller compares two readings.
    """
    for folder in _groups("memory", root, membership):
        for name in ("memory.events", "memory.oom_control"):
            words = _words(folder / name)
            if "oom_kill" in words:
                return int(words[words.index("oom_kill") + 1])
    return None


def _groups(controller: str, root: Path, membership: Path) -> Iterator[Path]:
    """Yield the folders of our group and those above it, the innermost first.

    A container that does not have a namespace of its own sees the host's path in its membership but
    only its own group below the root: the folders that are not there are passed over.
    """
    try:
        lines = membership.read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = root / controller if controllers else root
        folder = top / path.lstrip("/")
        while folder != top:
            yield folder
            folder = folder.parent
        yield top


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split()
    except OSError:
        return []
