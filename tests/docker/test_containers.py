"""The image and the cluster of docker/compose.yaml, built and run for real, and broken on purpose.

`make test-containers` runs this. The order of the tests matters: the last one takes all down.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import httpx
import numpy as np
import pytest

from smsr.synthetic import make_example
from smsr_client import Client
from tests.docker.engine import REPOSITORY, Compose, docker, inspect, logs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from smsr_client.documents import Job

    Array: TypeAlias = NDArray[Any]

MIB = 1 << 20
IMAGE = "smsr:test"
BASE = os.environ.get("BASE", "python:3.11-slim-bookworm")
LARGEST = 350_000_000
"""Bytes that the image may add to its base."""
UID = 10001
WORKERS = 3
WORKER_MEMORY = 640 * MIB

log = logging.getLogger(__name__)

pytestmark = [
    pytest.mark.docker,
    pytest.mark.slow,
    pytest.mark.skipif(
        os.environ.get("SMSR_TEST_CONTAINERS") != "1",
        reason="builds and runs containers for minutes: `make test-containers`",
    ),
]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@pytest.fixture(scope="module")
def image() -> str:
    """Build the image as the Compose file does."""
    started = time.monotonic()
    Compose("smsr-test", {"SMSR_IMAGE": IMAGE})("build", "api", timeout=1200)
    log.info("image built in %.1f s", time.monotonic() - started)
    return IMAGE


@pytest.fixture(scope="module")
def cluster(image: str) -> Iterator[Compose]:
    """Bring up one API, Redis and three workers, as the one command does."""
    settings = {
        "SMSR_IMAGE": image,
        "SMSR_PORT": str(free_port()),
        "SMSR_WORKER_MEMORY": str(WORKER_MEMORY),
        "SMSR_WORKER_CPUS": "1",
    }
    compose = Compose("smsr-test", settings)
    compose("down", "--volumes", "--remove-orphans")
    try:
        started = time.monotonic()
        compose.up(WORKERS)
        log.info("healthy after %.1f s, the image being there", time.monotonic() - started)
        yield compose
    finally:
        log.info("at the end:\n%s", compose("ps", "--all"))
        log.info("logs:\n%s", compose("logs", "--no-color", "--tail", "100", check=False))
        compose("down", "--volumes")


@pytest.fixture
def client(cluster: Compose) -> Iterator[Client]:
    with Client(f"http://127.0.0.1:{cluster.settings['SMSR_PORT']}") as client:
        yield client


@dataclass(frozen=True)
class Sender:
    """Sends jobs from this machine to the cluster."""

    client: Client
    folder: Path

    def send(self, measurements: Array, ground_truth: Array | None = None) -> Job:
        return self.client.submit(
            self._file("measurements", measurements),
            ground_truth=None if ground_truth is None else self._file("truth", ground_truth),
        )

    def result(self, job: Job) -> dict[str, Array]:
        path = self.folder / "result.npz"
        self.client.download(job.id, "result.npz", path)
        with np.load(path) as arrays:
            return dict(arrays)

    def _file(self, name: str, array: Array) -> Path:
        path = self.folder / f"{name}.npy"
        np.save(path, array)
        return path


@pytest.fixture
def sender(client: Client, tmp_path: Path) -> Sender:
    return Sender(client, tmp_path)


def until(condition: Callable[[], object], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not so within {seconds} s"
        time.sleep(0.1)


def too_large() -> Array:
    """Frames and points both in thousands, and no structure: the solver asks for over a GiB."""
    return np.random.default_rng(0).standard_normal((4000, 4000), dtype=np.float32)


def worker_of(cluster: Compose, job: Job) -> str | None:
    """Return the container that runs a job."""
    redis = cluster.container("redis")
    name = docker("exec", redis, "redis-cli", "hget", f"smsr:job:{job.id}", "worker")
    found = [c for c in cluster.containers("worker") if name.startswith(c[:12])]
    return found[0] if found else None


# The image


def test_image_adds_little_to_its_base(image: str) -> None:
    added = inspect(image)["Size"] - inspect(BASE)["Size"]
    log.info("image: %.0f MB beyond its base", added / 1e6)
    assert added < LARGEST


def test_image_says_what_it_is_and_how_it_runs(image: str) -> None:
    config = inspect(image)["Config"]
    assert config["User"] == f"{UID}:{UID}"
    assert config["Healthcheck"]["Test"] == ["CMD", "smsr-healthcheck"]
    assert config["StopSignal"] == "SIGTERM"
    labels = config["Labels"]
    assert labels["org.opencontainers.image.title"] == "SMSR"
    assert labels["org.opencontainers.image.licenses"] == "MIT"
    assert {"version", "revision", "description"} <= {n.rpartition(".")[2] for n in labels}


def test_image_has_no_build_tools(image: str) -> None:
    looked = docker(
        "run", "--rm", "--entrypoint", "sh", image, "-c",
        "for tool in gcc cc c++ ld as make cmake; do command -v $tool; done;"
        "ls /opt/smsr/bin /opt/smsr/lib/python3.*/site-packages",
    )  # fmt: skip
    names = set(looked.split())
    assert "smsr" in names
    assert not names & {"gcc", "cc", "c++", "ld", "as", "make", "cmake"}
    assert not {n for n in names if re.match(r"(pip|setuptools|wheel|hatchling)\b", n)}


def test_image_holds_what_the_lock_file_says(image: str) -> None:
    listed = docker(
        "run", "--rm", "--entrypoint", "python", image, "-c",
        "from importlib.metadata import distributions\n"
        "for d in distributions(path=__import__('site').getsitepackages()):"
        " print(d.name.lower().replace('_', '-') + '==' + d.version)",
    )  # fmt: skip
    installed = {line for line in listed.splitlines() if not line.startswith("smsr==")}
    lock = (REPOSITORY / "docker" / "requirements.lock").read_text()
    locked = set(re.findall(r"^([a-z0-9.-]+==[^ ;\\]+)", lock, re.MULTILINE))
    assert installed
    assert installed <= locked


@pytest.mark.parametrize(("cpus", "threads"), [("1", 1), ("1.5", 1), ("2", 2)])
def test_threads_follow_the_cpu_limit(image: str, cpus: str, threads: int) -> None:
    program = (
        "import os, numpy, scipy.linalg, threadpoolctl;"
        "pools = {p['num_threads'] for p in threadpoolctl.threadpool_info()};"
        "print(pools, os.environ['OMP_NUM_THREADS'])"
    )
    instead = 's/^exec smsr .*/exec python -c "$1"/'
    started = docker(
        "run", "--rm", "--cpus", cpus, "--entrypoint", "sh", image, "-c",
        f"sed '{instead}' /usr/local/bin/smsr-entrypoint > /tmp/entry; sh /tmp/entry \"{program}\"",
    )  # fmt: skip
    expected = min(threads, len(os.sched_getaffinity(0)))
    assert started == f"{{{expected}}} {expected}"


@contextlib.contextmanager
def alone(image: str, *options: str) -> Iterator[str]:
    """Run one container that is the whole service; yield its name once it is healthy."""
    name = "smsr-test-alone"
    docker(
        "run", "--detach", "--name", name, "--read-only", "--cap-drop", "ALL", "--tmpfs", "/tmp",
        "--volume", f"{name}:/data", *options, image,
    )  # fmt: skip
    try:
        until(lambda: inspect(name)["State"]["Health"]["Status"] == "healthy")
        yield name
    finally:
        log.info("logs:\n%s", logs(name))
        docker("rm", "--force", name)
        docker("volume", "rm", name)


def test_one_container_serves_with_a_redis_of_its_own(image: str) -> None:
    """Without REDIS_URL the image is the whole service, and ends in order."""
    with alone(image) as name:
        started = time.monotonic()
        docker("stop", "--time", "30", name)
        assert time.monotonic() - started < 20
        assert inspect(name)["State"]["ExitCode"] == 0


def test_a_job_that_the_kernel_kills_fails_clearly_too(image: str, tmp_path: Path) -> None:
    """Where the budget is set too high, the kernel ends the job; it is not tried for ever."""
    port = free_port()
    options = ["--memory", "400m", "--memory-swap", "400m", "--publish", f"127.0.0.1:{port}:8000"]
    options += ["--env", f"SMSR_JOB_MEMORY_BYTES={1 << 40}", "--env", "SMSR_ACCESS=open"]
    with alone(image, *options) as name, Client(f"http://127.0.0.1:{port}") as client:
        sender = Sender(client, tmp_path)
        ended = client.wait(sender.send(too_large()).id, timeout=300)
        assert ended.status == "failed"
        assert ended.problem is not None
        assert ended.problem.type == "/problems/out-of-memory"
        assert 1 < ended.attempt <= 4
        assert httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200
        assert inspect(name)["RestartCount"] == 0
        test_smoke_job(sender)


# The cluster


def test_smoke_job(sender: Sender) -> None:
    example = make_example(frames=20, side=10)
    job = sender.send(example.measurements, example.ground_truth)
    job = sender.client.wait(job.id, timeout=120)
    assert job.status == "succeeded", job.problem
    assert job.metrics is not None
    assert job.metrics["e3d"] < 0.2


@pytest.mark.parametrize("service", ["api", "worker", "redis"])
def test_containers_are_closed(cluster: Compose, service: str) -> None:
    for name in cluster.containers(service):
        status = docker("exec", name, "cat", "/proc/1/status")
        fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        uids = set(fields["Uid"].split())
        assert "0" not in uids
        assert service == "redis" or uids == {str(UID)}
        assert int(fields["CapEff"], 16) == int(fields["CapBnd"], 16) == 0
        assert fields["NoNewPrivs"] == "1"
        assert fields["Seccomp"] == "2"
        for folder in ("/", "/usr/local/bin", "/opt"):
            tried = docker("exec", name, "sh", "-c", f"touch {folder}/x 2>&1", check=False)
            assert "Read-only file system" in tried or "No such file" in tried
        assert inspect(name)["HostConfig"]["Memory"] > 0
        assert inspect(name)["HostConfig"]["NanoCpus"] > 0


def test_jobs_survive_the_loss_of_a_worker_and_of_redis(cluster: Compose, sender: Sender) -> None:
    client = sender.client
    sparse, dense = make_example(frames=60, side=8), make_example(frames=120, side=150)
    jobs = [
        sender.send(dense.measurements, dense.ground_truth),
        sender.send(sparse.measurements, sparse.ground_truth),
        sender.send(dense.measurements),
    ]
    victim = jobs[0]
    until(lambda: client.get(victim.id).status == "running" and worker_of(cluster, victim))
    killed = worker_of(cluster, victim)
    assert killed is not None
    docker("kill", killed)
    jobs.append(sender.send(sparse.measurements))

    # A job of the other workers is under way, and the lost one is on its way back.
    docker("kill", cluster.container("redis"))
    server = f"http://127.0.0.1:{cluster.settings['SMSR_PORT']}"
    answer = httpx.get(f"{server}/readyz", timeout=30)
    assert answer.status_code == 503
    assert answer.headers["content-type"] == "application/problem+json"
    assert httpx.get(f"{server}/healthz", timeout=30).status_code == 200
    time.sleep(2)
    cluster.up(WORKERS)

    jobs.append(sender.send(sparse.measurements))
    ended = [client.wait(job.id, timeout=300) for job in jobs]
    for job in ended:
        assert job.status == "succeeded", (job.id, job.problem)
    assert ended[0].attempt >= 2
    for job, example in ((ended[0], dense), (ended[1], sparse)):
        assert job.metrics is not None
        assert job.metrics["e3d"] < 0.2
        shapes = sender.result(job)["shapes"]
        assert shapes.shape == example.ground_truth.shape
        assert np.isfinite(shapes).all()


def test_a_container_that_dies_comes_back_by_itself(cluster: Compose) -> None:
    """Killed from outside of Docker, as by the kernel: the restart policy brings it back."""
    name = cluster.containers("worker")[0]
    process = inspect(name)["State"]["Pid"]
    try:
        os.kill(process, 9)
    except (ProcessLookupError, PermissionError):
        pytest.skip("the engine's processes are not ours to see")
    until(lambda: inspect(name)["RestartCount"] == 1 and inspect(name)["State"]["Running"])
    until(lambda: inspect(name)["State"]["Health"]["Status"] == "healthy")


def test_a_job_over_the_memory_limit_fails_clearly(cluster: Compose, sender: Sender) -> None:
    before = {name: inspect(name)["State"]["StartedAt"] for name in cluster.containers("worker")}
    large = sender.send(too_large())
    ended = sender.client.wait(large.id, timeout=300)
    assert ended.status == "failed"
    assert ended.problem is not None
    assert ended.problem.type == "/problems/out-of-memory"
    assert ended.problem.detail
    test_smoke_job(sender)
    after = {name: inspect(name)["State"]["StartedAt"] for name in cluster.containers("worker")}
    assert after == before, "a worker container was lost to one job"


def test_workers_and_api_stop_in_order(cluster: Compose) -> None:
    """Process 1 gets the SIGTERM and ends by itself, before the engine would kill it."""
    for service, seconds in (("worker", 25), ("api", 14)):
        names = cluster.containers(service)
        started = time.monotonic()
        cluster("stop", service)
        assert time.monotonic() - started < seconds
        for name in names:
            state = inspect(name)["State"]
            assert state["ExitCode"] == 0, state
            assert state["OOMKilled"] is False


def test_nothing_is_left_after_down(cluster: Compose) -> None:
    assert all(cluster.leftovers().values())
    cluster("down", "--volumes")
    assert cluster.leftovers() == {"containers": [], "volumes": [], "networks": []}


def test_objects_can_be_in_an_s3_store(image: str, tmp_path: Path) -> None:
    """The second Compose file, with another S3 server in the place of its own."""
    folder = REPOSITORY / "docker"
    compose = Compose(
        "smsr-test-s3",
        {
            "SMSR_IMAGE": image,
            "SMSR_PORT": str(free_port()),
            "SMSR_WORKER_CPUS": "1",
            "AWS_SECRET_ACCESS_KEY": "secret",
        },
        (folder / "compose.yaml", folder / "compose.s3.yaml", Path(__file__).parent / "s3.yaml"),
    )
    try:
        compose("build", "s3", timeout=1200)
        compose("up", "--detach", "--wait", "--no-build", "api", "worker")
        with Client(f"http://127.0.0.1:{compose.settings['SMSR_PORT']}") as client:
            sender = Sender(client, tmp_path)
            example = make_example(frames=20, side=10)
            job = client.wait(sender.send(example.measurements).id, timeout=120)
            assert job.status == "succeeded", job.problem
            assert sender.result(job)["shapes"].shape == example.ground_truth.shape
        program = "import urllib.request as u; print(u.urlopen('http://127.0.0.1:8333/smsr').read().decode())"
        listed = docker("exec", compose.container("s3"), "/opt/s3/bin/python", "-c", program)
        keys = re.findall(r"<Key>([^<]+)</Key>", listed)
        assert f"uploads/{job.id}/measurements" in keys
        assert f"results/{job.id}/1/shapes.npy" in keys
        on_disk = docker("exec", compose.container("worker"), "ls", "/data").split()
        assert "objects" not in on_disk
    finally:
        log.info("logs:\n%s", compose("logs", "--no-color", "--tail", "100", check=False))
        compose("down", "--volumes")
    assert not any(compose.leftovers().values())


def test_all_compose_files_are_valid() -> None:
    folder = REPOSITORY / "docker"
    compose = Compose(
        "smsr-test",
        {"AWS_SECRET_ACCESS_KEY": "secret", "SMSR_IMAGE": IMAGE},
        (folder / "compose.yaml", folder / "compose.s3.yaml"),
    )
    text = compose("config")
    assert "SMSR_STORAGE_URL: s3://smsr" in text
    assert "REDIS_URL: redis://redis:6379/0" in text
    with pytest.raises(AssertionError, match="AWS_SECRET_ACCESS_KEY"):
        Compose("smsr-test", {"AWS_SECRET_ACCESS_KEY": ""}, compose.files)("config")
