"""Time large uploads against a bare uvicorn application that writes the same body to disk.

    python benchmarks/uploads.py --mib 1024 --runs 3

In each round a matrix goes through multipart, PUT and tus (one PATCH), each time beside two runs of
the bare application: one that leaves the body to the page cache, and one that syncs it to the disk
(fsync) before it answers, as the service does. All come from one client over raw sockets, and all
files lie on one disk. The table gives medians of wall time, and each ratio is the median over the
rounds of the bare application's time in the same round by the service's: 1 is as fast as bare.
`CPU` is the same of the processor time of the server process, for machines that are busy with other
things. `grown` is by how much the API's resident memory went beyond what it was before.

The service does more than the bare application: it looks at the first bytes, counts, hashes
(SHA-256), makes the file safe against a power cut and keeps records in Redis.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np

from smsr.files import npy_header
from worker.redis_server import EmbeddedRedis

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

MIB = 1 << 20
ROWS = 256
BOUNDARY = "------------------------d74496d66958873e"
"""As curl makes them: to look for a short one takes longer."""
_TICKS = os.sysconf("SC_CLK_TCK")

BARE = """
import os
FOLDER = os.environ["BARE_FOLDER"]
async def app(scope, receive, send):
    assert scope["type"] == "http"
    with open(os.path.join(FOLDER, "body"), "wb") as file:
        while True:
            message = await receive()
            file.write(message.get("body", b""))
            if not message.get("more_body"):
                break
        if scope["path"] == "/synced":
            file.flush()
            os.fsync(file.fileno())
    await send({"type": "http.response.start", "status": 204, "headers": []})
    await send({"type": "http.response.body"})
"""


@dataclass
class Server:
    """A server process."""

    port: int
    process: subprocess.Popen[bytes]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def memory(self, which: str) -> int:
        """Bytes of resident memory, 'VmRSS' now or 'VmHWM' at most."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        return 1024 * int(status.split(f"{which}:")[1].split()[0])

    def forget_most(self) -> None:
        """Measure the largest memory anew from here."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5", encoding="ascii")

    def cpu(self) -> float:
        """Processor seconds so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").split()
        return (int(fields[13]) + int(fields[14])) / _TICKS


@dataclass
class Series:
    """What one way of uploading took."""

    seconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    synced_ratios: list[float] = field(default_factory=list)
    cpu_ratios: list[float] = field(default_factory=list)
    grown: int = 0


@contextlib.contextmanager
def serving(application: str, environment: Mapping[str, str], *more: str) -> Iterator[Server]:
    """Run an application in uvicorn until the block ends."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "uvicorn", application, "--port", str(port), *more]
    with subprocess.Popen(
        [*command, "--log-level", "warning", "--no-access-log"], env={**os.environ, **environment}
    ) as process:
        try:
            for _ in range(1200):
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                    break
                time.sleep(0.05)
            yield Server(port, process)
        finally:
            process.send_signal(signal.SIGTERM)


def send(server: Server, head: str, before: bytes, path: Path, after: bytes) -> int:
    """Send a request with a file in its body; return the status of the answer."""
    length = len(before) + path.stat().st_size + len(after)
    fields = f"Host: 127.0.0.1\r\nContent-Length: {length}\r\nConnection: close\r\n"
    with (
        socket.create_connection(("127.0.0.1", server.port)) as connection,
        path.open("rb") as file,
    ):
        connection.sendall(f"{head}\r\n{fields}\r\n".encode() + before)
        connection.sendfile(file)
        connection.sendall(after)
        answer = connection.recv(65536).decode()
    status = int(answer.split()[1])
    if status >= 300:
        raise SystemExit(answer)
    return status


def to_bare(server: Server, path: Path) -> None:
    send(server, "PUT / HTTP/1.1", b"", path, b"")


def to_bare_synced(server: Server, path: Path) -> None:
    send(server, "PUT /synced HTTP/1.1", b"", path, b"")


def by_multipart(server: Server, path: Path) -> None:
    fields = 'Content-Disposition: form-data; name="measurements"; filename="w.npy"'
    before = f"--{BOUNDARY}\r\n{fields}\r\n\r\n".encode()
    head = f"POST /v1/jobs HTTP/1.1\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}"
    send(server, head, before, path, f"\r\n--{BOUNDARY}--\r\n".encode())


def by_put(server: Server, path: Path) -> None:
    send(server, f"PUT /v1/uploads/{uuid.uuid4().hex}?name=w.npy HTTP/1.1", b"", path, b"")


def by_tus(server: Server, path: Path) -> None:
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": str(path.stat().st_size)}
    url = httpx.post(f"{server.url}/v1/uploads", headers=tus).headers["Location"]
    head = (
        f"PATCH {url} HTTP/1.1\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
        "Content-Type: application/offset+octet-stream"
    )
    send(server, head, b"", path, b"")


WAYS: dict[str, Callable[[Server, Path], None]] = {
    "multipart": by_multipart,
    "PUT": by_put,
    "tus": by_tus,
}


def timed(server: Server, way: Callable[[Server, Path], None], path: Path) -> tuple[float, float]:
    """Return the wall time of an upload and the processor time of the server."""
    started, before = time.perf_counter(), server.cpu()
    way(server, path)
    return time.perf_counter() - started, server.cpu() - before


def clean(folder: Path) -> None:
    """Remove what was uploaded, and wait for the disk."""
    for name in ("incoming", "uploads"):
        shutil.rmtree(folder / "data" / "objects" / name, ignore_errors=True)
    with contextlib.suppress(FileNotFoundError):
        (folder / "body").unlink()
    os.sync()


def measure(
    folder: Path, mib: int, runs: int, ways: Mapping[str, Callable[[Server, Path], None]]
) -> tuple[Series, Series, dict[str, Series]]:
    """Run all uploads, bare and service in turns."""
    path = folder / "w.npy"
    points = mib * MIB // (4 * ROWS)
    block = np.random.default_rng(0).bytes(MIB)
    with path.open("wb") as file:
        file.write(npy_header((ROWS, points), "<f4"))
        for _ in range(4 * ROWS * points // MIB):
            file.write(block)
    (folder / "bare.py").write_text(BARE, encoding="utf-8")
    bare, synced, found = Series(), Series(), {name: Series() for name in ways}
    environment: dict[str, str] = {
        "SMSR_DATA_DIR": str(folder / "data"),
        "SMSR_ACCESS": "open",
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).resolve().parent.parent), str(folder)]),
        "BARE_FOLDER": str(folder),
        "SMSR_LOG_LEVEL": "WARNING",
    }
    with EmbeddedRedis(folder / "redis") as redis:
        environment["SMSR_REDIS_URL"] = redis.url
        more = ("--factory",)
        with (
            serving("bare:app", environment) as plain,
            serving("service.app:app_from_environment", environment, *more) as service,
        ):
            small = folder / "small.npy"
            small.write_bytes(npy_header((ROWS, 16), "<f4") + bytes(4 * ROWS * 16))
            to_bare(plain, path)  # the file is read once, and both servers are warm
            for way in ways.values():
                way(service, small)
            for number in range(runs):
                for name, way in ways.items():
                    clean(folder)
                    wall, cpu = timed(plain, to_bare, path)
                    clean(folder)
                    wall_synced, _ = timed(plain, to_bare_synced, path)
                    clean(folder)
                    service.forget_most()
                    before = service.memory("VmRSS")
                    wall_here, cpu_here = timed(service, way, path)
                    series = found[name]
                    bare.seconds.append(wall)
                    synced.seconds.append(wall_synced)
                    series.seconds.append(wall_here)
                    series.ratios.append(wall / wall_here)
                    series.synced_ratios.append(wall_synced / wall_here)
                    series.cpu_ratios.append(cpu / cpu_here)
                    series.grown = max(series.grown, service.memory("VmHWM") - before)
                    sys.stderr.write(
                        f"round {number + 1}: bare {wall:.2f} s ({cpu:.2f} s CPU), "
                        f"synced {wall_synced:.2f} s, "
                        f"{name} {wall_here:.2f} s ({cpu_here:.2f} s CPU)\n"
                    )
            clean(folder)
    return bare, synced, found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mib", type=int, default=1024, help="size of the matrix")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--folder", type=Path, default=None, help="where to write")
    given: Any = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        bare, synced, found = measure(
            Path(folder), given.mib, given.runs, {w: WAYS[w] for w in given.ways}
        )
    middle = statistics.median
    print(f"{given.mib} MiB, medians of {given.runs} runs\n")
    print("| way | s | MiB/s | of bare | of bare, synced | of bare, CPU | grown, MiB |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, series in {"bare": bare, "bare, synced": synced}.items():
        seconds = middle(series.seconds)
        print(f"| {name} | {seconds:.2f} | {given.mib / seconds:.0f} | | | | |")
    for name, series in found.items():
        seconds = middle(series.seconds)
        print(
            f"| {name} | {seconds:.2f} | {given.mib / seconds:.0f} | {middle(series.ratios):.2f} | "
            f"{middle(series.synced_ratios):.2f} | {middle(series.cpu_ratios):.2f} | "
            f"{series.grown / MIB:.0f} |"
        )


if __name__ == "__main__":
    main()
