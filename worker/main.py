"""The worker process: ``python -m worker.main``.

It consists of three kinds of processes: the supervisor, which takes jobs from the queue; a
work-horse for each job, forked from it; and a keeper, which does the maintenance beside it.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib
import multiprocessing
import os
import re
import secrets
import signal
import socket
import sys
import time
from typing import TYPE_CHECKING

import structlog
from redis.exceptions import RedisError
from threadpoolctl import threadpool_limits

from worker import tracing
from worker.connections import connect
from worker.logs import configure_logging
from worker.maintenance import Maintenance
from worker.pool import THREAD_VARIABLES
from worker.processes import die_with_parent
from worker.queue import JobQueue
from worker.scratch import scratch_folder, sweep_scratch
from worker.settings import Settings, WrongSettings, environment_settings, read_settings
from worker.supervisor import Supervisor

if TYPE_CHECKING:
    from multiprocessing.context import ForkProcess
    from pathlib import Path

_AGAIN_SECONDS = (0.2, 0.5, 1.0, 2.0)
_SWEEP_SECONDS = 60.0

log = structlog.get_logger(__name__)


def run_worker(settings: Settings, *, burst: bool = False) -> None:
    """Work until told to stop by SIGINT or SIGTERM; main thread of a process of its own.

    The environment of the process is changed: it tells work-horses their settings and the numeric
    libraries their number of threads.

    Parameters
    ----------
    settings : Settings
        With a Redis server.
    burst : bool
        End when the queue is empty.
    """
    if settings.redis_url is None:
        raise ValueError("the settings name no Redis server")
    stop = _Stop()
    signal.signal(signal.SIGTERM, stop)
    name = _worker_name()
    root = settings.scratch
    sweep_scratch(root)
    with scratch_folder(root, name) as folder:
        settings = settings.model_copy(update={"scratch_dir": folder})
        os.environ.update(settings.to_environ())
        keeper = _Keeper(settings, name, root)
        keeper.ensure()
        _prepare_for_forks(settings.threads_per_worker)
        try:
            _work(settings, name, keeper, stop, burst=burst)
        finally:
            keeper.stop()


class _Stop:
    """Handler of SIGTERM that ends the process and leaves nothing behind.

    Of a worker until RQ has its own, and of a keeper. It is remembered, as a finaliser or some
    library that is being imported may swallow the SystemExit.
    """

    def __init__(self) -> None:
        self.received = False

    def __call__(self, *_: object) -> None:
        self.received = True
        sys.exit()


def _work(settings: Settings, name: str, keeper: _Keeper, stop: _Stop, *, burst: bool) -> None:
    """Work, and begin anew when the connection to Redis broke."""
    failures = 0
    while not stop.received:
        supervisor = None
        started = time.monotonic()
        try:
            queue = JobQueue(settings, connect(str(settings.redis_url), patient=True))
            supervisor = Supervisor(queue, connect(str(settings.redis_url)), name, keeper.ensure)
            supervisor.work(burst=burst, logging_level=None)
        except RedisError as error:
            log.warning("Redis is away", reason=str(error))
        if burst or (supervisor is not None and supervisor.stop_at is not None):
            return
        failures = 0 if time.monotonic() - started > 10.0 else failures + 1
        time.sleep(_AGAIN_SECONDS[min(failures, len(_AGAIN_SECONDS) - 1)])


def _worker_name() -> str:
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname())
    return f"{host}-{os.getpid()}-{secrets.token_hex(3)}"


def _prepare_for_forks(threads: int) -> None:
    """Load what work-horses need, once: a fork then takes milliseconds and shares the memory."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = str(threads)
    for module in ("worker.task", "smsr.pipeline"):
        importlib.import_module(module)
    # Here, for all of them: to look for the loaded libraries takes longer than a small job.
    threadpool_limits(threads)
    environment_settings.cache_clear()
    environment_settings()
    tracing.preload()
    gc.collect()
    gc.freeze()


class _Keeper:
    """The process that does the maintenance: it may use the storage, which a forking one may not.

    Parameters
    ----------
    settings : Settings
    name : str
        Name of the worker, which is kept on the list of living workers.
    scratch : Path
        Folder of the scratch folders of all workers on this machine.
    """

    def __init__(self, settings: Settings, name: str, scratch: Path) -> None:
        self._arguments = (settings, name, scratch, os.getpid())
        self._process: ForkProcess | None = None

    def ensure(self) -> None:
        """Start the process if it does not run."""
        if self._process is None or not self._process.is_alive():
            context = multiprocessing.get_context("fork")
            self._process = context.Process(
                target=_keep_order, args=self._arguments, name="keeper", daemon=True
            )
            self._process.start()

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()


def _keep_order(settings: Settings, name: str, scratch: Path, parent: int) -> None:
    """Do the maintenance until the worker ends."""
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = _Stop()
    signal.signal(signal.SIGTERM, stop)
    queue = JobQueue(settings)
    maintenance = Maintenance(queue)
    swept = time.monotonic()
    try:
        while os.getppid() == parent and not stop.received:
            with contextlib.suppress(RedisError):  # the maintenance says so, too
                queue.records.sign_of_life(name)
            maintenance.run_once()
            if time.monotonic() - swept > _SWEEP_SECONDS:
                sweep_scratch(scratch)
                swept = time.monotonic()
            time.sleep(settings.maintenance_interval_seconds)
    finally:
        with contextlib.suppress(RedisError):
            queue.records.sign_off(name)


def main() -> None:
    """Run a worker with the settings of the environment."""
    parser = argparse.ArgumentParser(prog="python -m worker.main", description=main.__doc__)
    parser.add_argument("--burst", action="store_true", help="end when the queue is empty")
    arguments = parser.parse_args()
    try:
        settings = read_settings()
    except WrongSettings as error:
        parser.exit(2, "".join(f"Error: {problem}\n" for problem in error.problems))
    configure_logging(settings.log_level)
    run_worker(settings, burst=arguments.burst)


if __name__ == "__main__":
    main()
