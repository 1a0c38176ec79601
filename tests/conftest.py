"""Fixtures that more than one floor uses."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import redis

from worker.redis_server import find_server

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

ROOT = Path(__file__).resolve().parent.parent
_OF_A_CLUSTER = (
    "REDIS_URL",
    "SMSR_ACCESS",
    "SMSR_API_KEY",
    "SMSR_DATA_DIR",
    "SMSR_REDIS_URL",
    "SMSR_SERVER",
    "SMSR_STORAGE_URL",
)


def clean_environment(**more: str) -> dict[str, str]:
    """Return the environment without settings of a service, with those given."""
    kept = {name: value for name, value in os.environ.items() if name not in _OF_A_CLUSTER}
    path = os.pathsep.join(filter(None, (str(ROOT), kept.get("PYTHONPATH"))))
    # Tests that submit the same files again mean to have them run again, unless they say so.
    return kept | {"PYTHONPATH": path, "COLUMNS": "120", "SMSR_REUSE_RESULTS": "false"} | more


@dataclass(frozen=True)
class Served:
    """A running ``smsr serve``."""

    url: str
    process: subprocess.Popen[str]
    data_dir: Path
    log: Path


@contextlib.contextmanager
def serving(folder: Path, *arguments: str, environment: Mapping[str, str]) -> Iterator[Served]:
    """Run ``smsr serve`` with an embedded Redis server on a free port until the block ends."""
    data_dir, log = folder / "data", folder / "server.log"
    command = [sys.executable, "-m", "service.cli", "serve", "--port", "0"]
    with (
        log.open("w") as errors,
        subprocess.Popen(
            [*command, "--data-dir", str(data_dir), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=dict(environment),
            text=True,
        ) as process,
    ):
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("SMSR serves http"), log.read_text()
            yield Served(line.split()[-1], process, data_dir, log)
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                raise


@pytest.fixture(scope="session")
def evaluation_data() -> Path:
    """Folder of the evaluation data; tests that use it carry the marker `data`."""
    folder = Path(os.environ.get("SMSR_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("the evaluation data are not here (SMSR_DATA or ../shared/data)")
    return folder


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with one worker, shared by the tests of a process; jobs of others may be on it."""
    folder = tmp_path_factory.mktemp("served")
    with serving(folder, "--workers", "1", environment=clean_environment()) as server:
        yield server


@dataclass
class RedisProcess:
    """A real Redis server of the tests, which can be killed and started again."""

    folder: Path
    process: subprocess.Popen[bytes] | None = field(default=None, init=False)

    @property
    def url(self) -> str:
        return f"unix://{self.folder}/redis.sock"

    def client(self) -> redis.Redis:
        return redis.Redis.from_url(self.url)

    def start(self) -> None:
        options = {
            "--port": "0",
            "--unixsocket": f"{self.folder}/redis.sock",
            "--dir": str(self.folder),
            "--appendonly": "yes",
            "--save": "",
            "--logfile": f"{self.folder}/redis.log",
        }
        flat = [part for option in options.items() for part in option]
        self.process = subprocess.Popen([find_server(), *flat], start_new_session=True)
        for _ in range(1000):
            with contextlib.suppress(redis.RedisError):
                self.client().ping()
                return
            time.sleep(0.01)
        raise AssertionError("the Redis server does not start")

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def redis_running(folder: Path) -> Iterator[RedisProcess]:
    """Run a Redis server until the block ends."""
    server = RedisProcess(folder)
    server.start()
    try:
        yield server
    finally:
        server.kill()


@pytest.fixture(scope="session")
def redis_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RedisProcess]:
    with redis_running(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture
def redis_url(redis_process: RedisProcess) -> str:
    """Address of an empty Redis server."""
    redis_process.client().flushall()
    return redis_process.url
