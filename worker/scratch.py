"""Scratch folders that are cleaned up even after a SIGKILL.

Each worker process has a folder of its own beside a lock file that it holds (flock) while it lives.
The kernel gives the lock up with the last process that inherited it, so whoever can take the lock
knows that the folder's owner and its work-horse are dead: process ids, which containers share and
systems reuse, need not be trusted.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_LOCK = ".lock"

log = structlog.get_logger(__name__)


@contextlib.contextmanager
def scratch_folder(root: Path, name: str) -> Iterator[Path]:
    """Make and hold a folder; remove it at the end.

    Parameters
    ----------
    root : Path
        Folder of all scratch folders, made if absent.
    name : str
        Name of the owner, used by nobody else.
    """
    root.mkdir(parents=True, exist_ok=True)
    lock = root / (name + _LOCK)
    descriptor = _take(lock)
    folder = root / name
    try:
        folder.mkdir(exist_ok=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def empty_folder(folder: Path) -> None:
    """Remove all that is in a folder."""
    for entry in folder.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def sweep_scratch(root: Path) -> None:
    """Remove the folders of dead owners."""
    if not root.is_dir():
        return
    names = {entry.name.removesuffix(_LOCK) for entry in root.iterdir()}
    for name in sorted(names):
        lock = root / (name + _LOCK)
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(root / name, ignore_errors=True)
            lock.unlink(missing_ok=True)
            log.info("scratch of a dead worker removed", worker=name)
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)


def _take(lock: Path) -> int:
    """Open and lock a file that a sweeper may be removing."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        try:
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        except FileNotFoundError:
            pass
        os.close(descriptor)
