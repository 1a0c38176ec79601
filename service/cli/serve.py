"""Commands that serve: the API with its workers and its Redis, or one worker of a cluster.

What only a server needs is imported when it starts: the other commands need not wait for it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.exits import ExitCode, complain, console, errors
from worker.logs import configure_logging
from worker.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

    from worker.settings import Settings

_BACKLOG = 2048


def serve(
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 is every address.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.")
    ] = 8000,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Worker processes; 0 leaves the work to workers elsewhere."),
    ] = None,
    data_dir: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder of uploads, results and the embedded Redis."),
    ] = None,
) -> None:
    """Serve the API and run its workers until interrupted.

    Without REDIS_URL an embedded Redis server keeps the queue in the data folder. Everything else
    is set by SMSR_* variables.
    """
    from service.server import run_server
    from worker.pool import WorkerPool
    from worker.redis_server import DataFolderInUse, EmbeddedRedis, ServerFailed

    given = {"workers": workers or None, "data_dir": data_dir}
    settings = read_settings(**{name: v for name, v in given.items() if v is not None})
    configure_logging(settings.log_level)
    with _until_signalled(), contextlib.ExitStack() as stack:
        listener = stack.enter_context(contextlib.closing(_listen(host, port)))
        if settings.redis_url is None:
            try:
                redis = stack.enter_context(EmbeddedRedis(settings.data_dir / "redis"))
            except (DataFolderInUse, ServerFailed) as error:
                complain(str(error))
                raise typer.Exit(ExitCode.FAILED) from error
            settings = settings.model_copy(update={"redis_url": redis.url})
        if workers != 0:
            stack.enter_context(WorkerPool(settings))
        url = _url(host, listener)

        def ready() -> None:
            console.print(f"SMSR serves {url}", soft_wrap=True)
            _tell_who_may_come(settings, listener)

        if not run_server(settings, listener, ready):
            raise typer.Exit(ExitCode.FAILED)


def _tell_who_may_come(settings: Settings, listener: socket.socket) -> None:
    """Say on standard error what an operator may not expect."""
    from redis.exceptions import RedisError

    from service.access import policy_for
    from worker.connections import connect
    from worker.keys import KeyStore

    address = listener.getsockname()[0]
    match policy_for(settings, address):
        case "keys":
            with contextlib.closing(connect(str(settings.redis_url))) as redis:
                try:
                    known = KeyStore(redis).list()
                except RedisError:
                    return
            if known:
                return
            errors.print(
                "API keys are needed, and there is none yet; make one with: smsr keys create OWNER "
                "(with the same SMSR_DATA_DIR or REDIS_URL; or set SMSR_ACCESS=open for a service "
                "that everyone who reaches it may use)",
                soft_wrap=True,
            )
        case "open" if (
            policy_for(settings.model_copy(update={"access": "auto"}), address) == "keys"
        ):
            errors.print(f"Everyone who reaches {address} may use the service.", soft_wrap=True)


def worker() -> None:
    """Run one worker process of a cluster; REDIS_URL says where the queue is."""
    settings = read_settings()
    if settings.redis_url is None:
        complain("Set REDIS_URL to the Redis server of the queue, or use smsr serve.")
        raise typer.Exit(ExitCode.USAGE)

    # A program of its own: a worker sets its number of BLAS threads before NumPy is loaded, and
    # forks for each job, which a process that has started threads should not.
    os.execv(sys.executable, [sys.executable, "-m", "worker.main"])


def _listen(host: str, port: int) -> socket.socket:
    """Bind before anything else starts, so that a taken port costs nothing."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise OSError(
            error.errno, f"Cannot listen on {host} port {port}: {error.strerror}. Try --port."
        ) from error
    listener.set_inheritable(False)
    return listener


def _url(host: str, listener: socket.socket) -> str:
    """Return an address that a client on this machine can use."""
    if host in ("", "0.0.0.0", "::"):  # noqa: S104
        host = "127.0.0.1"
    elif ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{listener.getsockname()[1]}"


@contextlib.contextmanager
def _until_signalled() -> Iterator[None]:
    """End the body in order at the first SIGINT or SIGTERM; later ones change nothing.

    Uvicorn handles both itself while it serves and sends itself the signal again when it is done,
    which would end the process before workers and Redis are stopped.
    """
    stopping = threading.Event()

    def stop(_signum: int, _frame: FrameType | None) -> None:
        if not stopping.is_set():
            stopping.set()
            raise SystemExit(ExitCode.OK)

    former = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for signum, handler in former.items():
            signal.signal(signum, handler)
