"""What the standard library lacks about processes: dying with the parent, and timers that raise."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

_PR_SET_PDEATHSIG = 1  # linux/prctl.h

_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def die_with_parent(parent: int, signum: signal.Signals = signal.SIGKILL) -> None:
    """Have this process receive a signal when its parent dies; on Linux only.

    The kernel sends it when the *thread* that started this process ends, so that thread must live
    as long as the parent process is meant to.

    Parameters
    ----------
    parent : int
        Process id of the parent, taken before this process was started: it may be dead already.
    signum : Signals
    """
    if _libc is None:
        return
    _libc.prctl(_PR_SET_PDEATHSIG, int(signum), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), signum)


@contextlib.contextmanager
def raise_after(seconds: float, error: Exception) -> Iterator[None]:
    """Raise an exception in the body when it takes too long; main thread only, not nestable."""

    def expire(_signum: int, _frame: FrameType | None) -> None:
        raise error

    former = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)
