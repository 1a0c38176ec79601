from __future__ import annotations

import multiprocessing
import os
import signal
import time
from typing import TYPE_CHECKING

from worker.scratch import empty_folder, scratch_folder, sweep_scratch

if TYPE_CHECKING:
    from pathlib import Path


def names(root: Path) -> set[str]:
    return {path.name for path in root.iterdir()}


def hold(root: Path, name: str) -> None:
    with scratch_folder(root, name) as folder:
        (folder / "shapes.npy").write_bytes(b"x")
        time.sleep(60)


def held(root: Path, name: str) -> int:
    """Hold a folder in another process; return its process id."""
    process = multiprocessing.get_context("fork").Process(target=hold, args=(root, name))
    process.start()
    while not (root / name / "shapes.npy").exists():
        time.sleep(0.01)
    assert process.pid is not None
    return process.pid


def test_a_folder_is_removed_at_the_end(tmp_path: Path) -> None:
    root = tmp_path / "scratch"
    with scratch_folder(root, "ann") as folder:
        (folder / "job").mkdir()
        (folder / "job" / "shapes.npy").write_bytes(b"x")
        assert names(root) == {"ann", "ann.lock"}
    assert names(root) == set()


def test_sweeping_removes_what_the_dead_left_and_nothing_else(tmp_path: Path) -> None:
    living, dead = held(tmp_path, "living"), held(tmp_path, "dead")
    (tmp_path / "old").mkdir()  # without a lock
    try:
        sweep_scratch(tmp_path)
        assert names(tmp_path) == {"living", "living.lock", "dead", "dead.lock"}
        os.kill(dead, signal.SIGKILL)
        os.waitpid(dead, 0)
        sweep_scratch(tmp_path)
        assert names(tmp_path) == {"living", "living.lock"}
        assert (tmp_path / "living" / "shapes.npy").exists()
    finally:
        os.kill(living, signal.SIGKILL)
        os.waitpid(living, 0)


def test_sweeping_a_folder_that_is_not_there(tmp_path: Path) -> None:
    sweep_scratch(tmp_path / "none")


def test_emptying(tmp_path: Path) -> None:
    (tmp_path / "job" / "deep").mkdir(parents=True)
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path.parent)
    empty_folder(tmp_path)
    assert names(tmp_path) == set()
    assert tmp_path.parent.exists()
