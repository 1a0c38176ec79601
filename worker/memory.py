"""A budget for the memory of a job, so that one that is too large fails and takes nothing with it.

Where a container's memory ends the kernel kills the process that asks for more, or, as Kubernetes
sets it up, the whole container. An allocation that fails before that is an error like any other.
"""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_DATA_PAGES = 5  # field of /proc/self/statm, proc(5)


@contextlib.contextmanager
def memory_budget(budget: int | None) -> Iterator[None]:
    """Make allocations in the body that go beyond a budget raise MemoryError; on Linux only.

    Private memory counts (RLIMIT_DATA, getrlimit(2)). Mapped files do not: the kernel can take
    their pages back.

    Parameters
    ----------
    budget : int or None
        Bytes beyond what the process has now; None sets no limit.
    """
    if budget is None or sys.platform != "linux":
        yield
        return
    former, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = private_bytes() + budget
    if most != resource.RLIM_INFINITY:
        limit = min(limit, most)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (former, most))


def private_bytes() -> int:
    """Return the size of this process's private writable memory, in use or not; on Linux only."""
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return int(pages[_DATA_PAGES]) * resource.getpagesize()
