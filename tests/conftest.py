"""Fixtures that more than one floor uses."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
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


@dataclass(frozen=True)
class S3Process:
    """A real S3 server of the tests, which keeps objects in memory."""

    url: str

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to reach it."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "smsr-test",
            "AWS_SECRET_ACCESS_KEY": "smsr-test",
        }

    def new_bucket(self) -> str:
        """Make a bucket and return its address."""
        name = f"smsr-{uuid.uuid4().hex}"
        httpx.put(f"{self.url}/{name}").raise_for_status()
        return f"s3://{name}/prefix"


@contextlib.contextmanager
def s3_running(folder: Path) -> Iterator[S3Process]:
    """Run an S3 server until the block ends."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    log = folder / "s3.log"
    with (
        log.open("w") as output,
        subprocess.Popen(command, stdout=output, stderr=output) as process,
    ):
        try:
            for _ in range(1200):
                assert process.poll() is None, log.read_text()
                with contextlib.suppress(httpx.TransportError):
                    httpx.get(f"http://127.0.0.1:{port}/")
                    break
                time.sleep(0.05)
            else:
                raise AssertionError(log.read_text())
            yield S3Process(f"http://127.0.0.1:{port}")
        finally:
            process.kill()  # it would wait for connections that are kept open


@pytest.fixture(scope="session")
def s3_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[S3Process]:
    with s3_running(tmp_path_factory.mktemp("s3")) as server:
        yield server
