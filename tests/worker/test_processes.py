from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.worker.conftest import alive, eventually
from worker.processes import KeptProcess, raise_after

if TYPE_CHECKING:
    from pathlib import Path

SLEEP = "import time; time.sleep(60)"


class TooLong(Exception):
    pass


def test_a_body_that_takes_too_long() -> None:
    began = time.monotonic()
    with pytest.raises(TooLong), raise_after(0.05, TooLong()):
        time.sleep(10)
    assert time.monotonic() - began < 5


def test_a_body_that_is_quick_enough() -> None:
    former = signal.getsignal(signal.SIGALRM)
    with raise_after(0.05, TooLong()):
        pass
    time.sleep(0.1)
    assert signal.getsignal(signal.SIGALRM) is former


def test_a_kept_process_is_started_again() -> None:
    kept = KeptProcess([sys.executable, "-c", SLEEP])
    kept.start()
    try:
        eventually(lambda: kept.pid, "the process runs")
        first = kept.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        eventually(lambda: kept.pid not in (None, first), "the process runs again")
        assert kept.starts == 2
    finally:
        last = kept.pid
        kept.stop()
    assert kept.pid is None
    assert last is not None
    assert not alive(last)


def test_a_kept_process_that_does_not_want_to_end() -> None:
    stubborn = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEP}"
    kept = KeptProcess([sys.executable, "-c", stubborn], stop_seconds=0.3)
    kept.start()
    eventually(lambda: kept.pid, "the process runs")
    time.sleep(0.3)
    kept.stop()
    assert kept.pid is None


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl(2)")
def test_a_kept_process_ends_with_its_keeper(tmp_path: Path) -> None:
    """Even when the thread that had it started has ended long before."""
    keeper = f"""
import sys, threading, time
from worker.processes import KeptProcess
kept = KeptProcess([sys.executable, "-c", {SLEEP!r}])
thread = threading.Thread(target=kept.start)
thread.start()
thread.join()
while kept.pid is None:
    time.sleep(0.01)
time.sleep(0.5)
print(kept.pid, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", keeper], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        assert alive(pid)
        process.kill()
    eventually(lambda: not alive(pid), "the kept process ends")
