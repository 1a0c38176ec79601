"""What the standard library lacks about processes.

Dying with the parent, timers that raise, and subprocesses that are started again. Run as a script,
this file becomes another program that dies with its parent; it imports the standard library only.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
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


class KeptProcess:
    """A subprocess that is started again whenever it ends, until it is stopped.

    It gets a session of its own, so that Ctrl-C in a terminal reaches only the process that keeps
    it, and (on Linux) SIGTERM when that one dies.

    Parameters
    ----------
    command : sequence of str
        Program, with its path, and arguments.
    environment : mapping, optional
        Environment variables; those of this process by default.
    stop_seconds : float
        Time it has to end after SIGTERM.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        stop_seconds: float = 10.0,
    ) -> None:
        wrapper = [sys.executable, "-I", "-S", __file__, str(os.getpid())]
        self._command = [*wrapper, *command]
        self._environment = environment
        self._stop_seconds = stop_seconds
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        # A thread of its own starts it: the kernel takes the end of the thread that started a
        # process for the end of its parent.
        self._thread = threading.Thread(target=self._keep, name="keep a process", daemon=True)
        self.starts = 0

    def start(self) -> None:
        """Start the program."""
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Process id, None while it is not running."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    def stop(self) -> None:
        """End the program: SIGTERM, then SIGKILL."""
        with self._lock:
            self._stopping.set()
            process = self._process
        if process is not None:
            process.terminate()
            try:
                process.wait(self._stop_seconds)
            except subprocess.TimeoutExpired:
                process.kill()
        if self._thread.is_alive():
            self._thread.join()

    def _keep(self) -> None:
        pause = 0.0
        while not self._stopping.wait(pause):
            with self._lock:
                if self._stopping.is_set():
                    return
                process = self._process = subprocess.Popen(
                    self._command,
                    env=None if self._environment is None else dict(self._environment),
                    stdin=subprocess.DEVNULL,
                    start_new_session=True,
                )
                self.starts += 1
            began = time.monotonic()
            process.wait()
            pause = 0.1 if time.monotonic() - began > 5.0 else min(5.0, 2 * pause + 0.1)


def _become(parent: str, program: str, *arguments: str) -> None:
    """Replace this process by a program that is asked to end when its parent dies."""
    die_with_parent(int(parent), signal.SIGTERM)
    os.execv(program, [program, *arguments])


if __name__ == "__main__":
    _become(*sys.argv[1:])
