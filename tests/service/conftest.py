"""A real server: uvicorn in a process of its own, a worker in another, and a Redis server."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import httpx
import numpy as np
import pytest

from smsr.synthetic import Example, make_example
from tests.conftest import ROOT, RedisProcess, clean_environment, redis_running
from worker.pool import WorkerPool
from worker.settings import Settings
from worker.storage import ObjectStorage

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from tests.conftest import S3Process

Files = dict[str, tuple[str, bytes]]

UPLOAD_LIMIT = 32 << 20
ARRAY_LIMIT = 64 << 20


def npy(array: NDArray[Any]) -> bytes:
    """Return the bytes of an .npy file; objects are pickled, which no reader may trust."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


class InTurn(httpx.BaseTransport):
    """Sends each request to the next of several servers, as a load balancer does."""

    def __init__(self, servers: list[str]) -> None:
        self._servers = itertools.cycle([httpx.URL(server) for server in servers])
        self._network = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        server = next(self._servers)
        request.url = request.url.copy_with(host=server.host, port=server.port)
        return self._network.handle_request(request)

    def close(self) -> None:
        self._network.close()


@dataclass(frozen=True)
class Api:
    """A running API process, and what it writes to."""

    url: str
    process: subprocess.Popen[bytes]
    settings: Settings
    redis: RedisProcess
    log: Path
    others: tuple[str, ...] = ()
    """Addresses of further API processes of the same cluster."""

    @property
    def objects(self) -> Path:
        """Folder of the storage; a test that looks into it cannot run on a bucket."""
        if self.settings.storage_url is not None:
            pytest.skip("the storage of this cluster is no folder")
        return self.settings.data_dir / "objects"

    def client(self, **more: Any) -> httpx.Client:
        """A client; of a cluster each request goes to another API process."""
        if self.others and "transport" not in more:
            more["transport"] = InTurn([self.url, *self.others])
        return httpx.Client(base_url=self.url, timeout=60, **more)

    def storage(self) -> ObjectStorage:
        """The storage of the process, for what needs no HTTP."""
        return ObjectStorage(self.settings.objects_url)

    def stored(self) -> set[str]:
        """Paths of all files in the storage."""
        if self.settings.storage_url is not None:
            storage = self.storage()
            prefixes = ("uploads/", "incoming/", "results/")
            return {item.key for prefix in prefixes for item in storage.list_prefix(prefix)}
        # Unlike Path.rglob, it passes over folders that go while it looks.
        return {f"{folder}/{name}" for folder, _, names in os.walk(self.objects) for name in names}

    def left_behind(self) -> set[str]:
        """Names of all stored files and of all Redis keys that are a job's."""
        keys = {key.decode() for key in self.redis.client().scan_iter("smsr:job:*")}
        tickets = {key.decode() for key in self.redis.client().scan_iter("rq:job:*")}
        return self.stored() | keys | tickets

    def resident(self, which: str = "VmRSS") -> int:
        """Bytes of memory of the process; VmHWM is the most it ever had."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(which):
                return int(line.split()[1]) * 1024
        raise AssertionError(f"no {which} for {self.process.pid}")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def api_running(
    settings: Settings, redis: RedisProcess, log: Path, port: int | None = None
) -> Iterator[Api]:
    """Run the application in uvicorn until the block ends."""
    port = port or free_port()
    command = [sys.executable, "-m", "uvicorn", "--factory", "service.app:app_from_environment"]
    more = ["--port", str(port), "--log-level", "warning", "--timeout-graceful-shutdown", "3"]
    with (
        log.open("ab") as output,
        subprocess.Popen(
            [*command, *more],
            env=clean_environment(**settings.to_environ()),
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        ) as process,
    ):
        try:
            api = Api(f"http://127.0.0.1:{port}", process, settings, redis, log)
            for _ in range(600):
                assert process.poll() is None, log.read_text()
                with contextlib.suppress(httpx.TransportError):
                    if httpx.get(f"{api.url}/healthz").status_code == 200:
                        break
                time.sleep(0.05)
            else:
                raise AssertionError(log.read_text())
            yield api
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                try:
                    process.wait(15)
                except subprocess.TimeoutExpired:
                    process.kill()
                    raise


def settings_for(folder: Path, redis: RedisProcess, **more: Any) -> Settings:
    given = {
        "data_dir": folder / "data",
        "redis_url": redis.url,
        "max_upload_bytes": UPLOAD_LIMIT,
        "max_array_bytes": ARRAY_LIMIT,
        "threads": 1,
        "access": "open",
        "progress_interval_seconds": 0.05,
        "reuse_results": False,
    }
    return Settings(**{**given, **more})


@pytest.fixture(scope="session")
def api_redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RedisProcess]:
    """A Redis server that no other test empties."""
    with redis_running(tmp_path_factory.mktemp("api-redis")) as server:
        yield server


@pytest.fixture(scope="session")
def api(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    api_redis: RedisProcess,
) -> Iterator[Api]:
    """An API and one worker, shared by all tests that break neither.

    With SMSR_TEST_CLUSTER=s3: two API processes and three workers on one Redis and one bucket.
    """
    folder = tmp_path_factory.mktemp("api")
    log = folder / "api.log"
    if os.environ.get("SMSR_TEST_CLUSTER") != "s3":
        settings = settings_for(folder, api_redis)
        with WorkerPool(settings, 1), api_running(settings, api_redis, log) as running:
            yield running
        return
    s3: S3Process = request.getfixturevalue("s3_process")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in s3.environment.items():
            patch.setenv(name, value)
        settings = settings_for(folder, api_redis, storage_url=s3.new_bucket(), workers=3)
        with (
            WorkerPool(settings, 3),
            api_running(settings, api_redis, log) as first,
            api_running(settings, api_redis, log) as second,
        ):
            yield dataclasses.replace(first, others=(second.url,))


@pytest.fixture
def client(api: Api) -> Iterator[httpx.Client]:
    with api.client() as opened:
        yield opened


@pytest.fixture(scope="session")
def idle_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    """An API without workers, with a Redis server of its own."""
    folder = tmp_path_factory.mktemp("idle")
    with (
        redis_running(folder) as redis,
        api_running(settings_for(folder, redis), redis, folder / "api.log") as running,
    ):
        yield running


@pytest.fixture
def idle_api(idle_server: Api) -> Api:
    """An API without jobs and without workers: what is submitted stays queued."""
    idle_server.redis.client().flushall()
    for folder in ("uploads", "results"):
        shutil.rmtree(idle_server.objects / folder, ignore_errors=True)
    idle_server.log.write_text("")
    return idle_server


@pytest.fixture(scope="session")
def example() -> Example:
    return make_example(frames=20, side=8)


@pytest.fixture(scope="session")
def tracks(example: Example) -> bytes:
    return npy(example.measurements.astype(np.float32))


def submit(
    client: httpx.Client, files: Files, options: Mapping[str, object] | None = None
) -> httpx.Response:
    """Submit a job."""
    data = {} if options is None else {"options": json.dumps(options)}
    return client.post("/v1/jobs", files=files, data=data)


def finished(client: httpx.Client, submitted: httpx.Response) -> dict[str, Any]:
    """Return the document of a submitted job once it has ended."""
    assert submitted.status_code == 201, submitted.text
    location = submitted.headers["Location"]
    for _ in range(4):
        answer = client.get(location, headers={"Prefer": "wait=30"})
        assert answer.status_code == 200, answer.text
        job: dict[str, Any] = answer.json()
        if job["status"] not in ("queued", "running"):
            return job
    raise AssertionError(f"the job did not end: {job}")


def problem(answer: httpx.Response, slug: str, status: int) -> dict[str, Any]:
    """Check that an answer is a well-formed problem document of a type, and return it."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    document: dict[str, Any] = answer.json()
    assert document["type"] == f"/problems/{slug}", document
    assert (answer.status_code, document["status"]) == (status, status), document
    assert document["title"]
    assert document["detail"]
    assert unquote(document["instance"]) == answer.request.url.path
    assert answer.headers["x-content-type-options"] == "nosniff"
    for trace in ("Traceback", str(ROOT), os.sep + "tmp" + os.sep, ".py"):
        assert trace not in answer.text
    return document


def wait_for(condition: Any, seconds: float = 10.0) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)
