from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
from redis.exceptions import AuthenticationError, RedisError

from tests.worker.conftest import alive, eventually
from worker.connections import connect
from worker.redis_server import DataFolderInUse, EmbeddedRedis, ServerFailed

if TYPE_CHECKING:
    from pathlib import Path


def answer(server: EmbeddedRedis, key: str) -> object:
    try:
        return connect(server.url).get(key)
    except RedisError:
        return None


def test_data_outlive_the_server(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connect(server.url).set("a", "1")
        pid = server.pid
    assert pid is not None
    assert not alive(pid)
    with EmbeddedRedis(tmp_path / "redis") as server:
        assert connect(server.url).get("a") == b"1"


def test_a_killed_server_is_started_again_with_its_data(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connect(server.url).set("a", "1")
        time.sleep(1.1)  # the append-only file is synced every second
        assert server.pid is not None
        os.kill(server.pid, signal.SIGKILL)
        eventually(lambda: answer(server, "a") == b"1", "the server is back")


def test_a_folder_has_one_server(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        with pytest.raises(DataFolderInUse, match=str(os.getpid())):
            EmbeddedRedis(tmp_path / "redis").start()
        assert connect(server.url).ping()


def test_after_a_crash_of_everything(tmp_path: Path) -> None:
    """The process that runs the server is killed; the next one takes over folder and data."""
    program = f"""
import pathlib, time
from worker.connections import connect
from worker.redis_server import EmbeddedRedis
server = EmbeddedRedis(pathlib.Path({str(tmp_path / "redis")!r}))
server.start()
connect(server.url).set("a", "1")
print(server.pid, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
    with EmbeddedRedis(tmp_path / "redis") as server:
        assert connect(server.url).get("a") == b"1"
        assert not alive(pid)


def test_a_damaged_file_is_repaired_and_kept(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connect(server.url).set("a", "1")
        connect(server.url).set("b", "2")
    (log,) = [*tmp_path.rglob("*.aof"), *tmp_path.rglob("*.incr.aof")][:1]
    with log.open("ab") as file:
        file.write(b"\x00\x00 what a power cut left \r\n")
    with EmbeddedRedis(tmp_path / "redis") as server:
        assert connect(server.url).mget("a", "b") == [b"1", b"2"]
    assert list((tmp_path / "redis").glob("damaged-*"))


def test_a_server_that_cannot_start_says_why(tmp_path: Path) -> None:
    folder = tmp_path / "redis"
    folder.mkdir()
    (folder / "redis.sock").mkdir()  # in the way of the socket
    with pytest.raises(ServerFailed, match="does not start"):
        EmbeddedRedis(folder).start()
    (folder / "redis.sock").rmdir()
    with EmbeddedRedis(folder) as server:
        assert connect(server.url).ping()


def test_a_path_too_long_for_a_socket(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / ("x" * 120) / "redis") as server:
        assert server.url.startswith("redis://:")
        assert connect(server.url).ping()
        _, _, address = server.url.rpartition("@")
        with pytest.raises(AuthenticationError):
            connect(f"redis://{address}").ping()


def test_others_may_not_look(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis"):
        folder = tmp_path / "redis"
        assert folder.stat().st_mode & 0o077 == 0
        assert (folder / "redis.sock").stat().st_mode & 0o077 == 0
        assert (folder / "address").stat().st_mode & 0o077 == 0
