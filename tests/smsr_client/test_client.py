from __future__ import annotations

import contextlib
import hashlib
import io
import json
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from smsr.synthetic import write_example
from smsr_client import Client, JobFailed, ServerUnreachable, ServiceError, require_success

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from smsr_client.documents import Job
    from tests.conftest import Served


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("example")
    write_example(folder, frames=20, side=6)
    return folder


@pytest.fixture
def client(served: Served) -> Iterator[Client]:
    with Client(served.url) as one:
        yield one


@pytest.fixture(scope="module")
def finished(served: Served, example: Path) -> Job:
    with Client(served.url) as client:
        job = client.submit(
            example / "measurements.npy",
            ground_truth=example / "ground_truth.npy",
            faces=example / "faces.npy",
            options={"layout": "interleaved"},
        )
        return client.wait(job.id, timeout=120)


def test_a_job_goes_from_files_to_a_result(finished: Job) -> None:
    assert require_success(finished) is finished
    assert (finished.frames, finished.points) == (20, 36)
    assert finished.options["layout"] == "interleaved"
    assert set(finished.inputs) == {"measurements", "ground_truth", "faces"}
    assert finished.metrics is not None
    assert 0 <= finished.metrics["e3d"] < 1


def test_downloads_are_whole(client: Client, finished: Job, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    target = client.download(
        finished.id,
        "result.npz",
        tmp_path / "deep" / "result.npz",
        progress=lambda done, total: seen.append((done, total)),
    )
    with np.load(target) as arrays:
        assert arrays["shapes"].shape == (20, 36, 3)
        assert arrays["cameras"].shape == (20, 2, 3)
    assert seen[-1] == (target.stat().st_size, target.stat().st_size)
    assert [path.name for path in target.parent.iterdir()] == ["result.npz"]


class Breaking(httpx.BaseTransport):
    """A network that breaks every answer off after some bytes, and notes what was asked for."""

    def __init__(self, after: int) -> None:
        self.after = after
        self.ranges: list[str | None] = []
        self._network = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.ranges.append(request.headers.get("range"))
        answer = self._network.handle_request(request)
        body = answer.read()
        stream = Broken(body, self.after) if len(body) > self.after else httpx.ByteStream(body)
        return httpx.Response(answer.status_code, headers=answer.headers, stream=stream)


class Broken(httpx.SyncByteStream):
    def __init__(self, body: bytes, after: int) -> None:
        self.body, self.after = body, after

    def __iter__(self) -> Iterator[bytes]:
        yield self.body[: self.after]
        raise httpx.ReadError("the connection broke")


@pytest.mark.parametrize("what", ["result.npz", "frames.zip", "shapes.npy"])
def test_a_download_goes_on_where_it_broke(
    client: Client, served: Served, finished: Job, tmp_path: Path, what: str
) -> None:
    whole = client.download(finished.id, what, tmp_path / "whole").read_bytes()
    after = len(whole) // 3
    network = Breaking(after + 1)
    seen: list[tuple[int, int]] = []
    with Client(served.url, transport=network) as broken:
        target = broken.download(
            finished.id, what, tmp_path / what, progress=lambda *now: seen.append(now)
        )
    assert target.read_bytes() == whole
    # Each request asks for what is missing only.
    assert network.ranges[0] is None
    assert len(network.ranges) > 1
    assert seen[-1] == (len(whole), len(whole))
    starts = [
        int(found.removeprefix("bytes=").rstrip("-")) for found in network.ranges[1:] if found
    ]
    assert starts == sorted(set(starts))
    assert starts[0] > 0


def test_a_refused_download_leaves_no_file(client: Client, finished: Job, tmp_path: Path) -> None:
    with pytest.raises(ServiceError) as caught:
        client.download(finished.id, "frames/20.ply", tmp_path / "frame.ply")
    assert caught.value.slug == "unknown-frame"
    assert list(tmp_path.iterdir()) == []


def test_an_upload_tells_how_far_it_is(client: Client, example: Path) -> None:
    seen: list[tuple[int, int]] = []
    job = client.submit(
        example / "measurements.npy", progress=lambda done, total: seen.append((done, total))
    )
    size = (example / "measurements.npy").stat().st_size
    assert seen[0] == (0, size)
    assert seen[-1] == (size, size)
    client.delete(job.id)


def test_waiting_follows_the_job_and_can_be_given_up(client: Client, example: Path) -> None:
    job = client.submit(example / "measurements.npy")
    first = client.wait(job.id, progress=lambda _: False)
    assert first.id == job.id
    statuses: list[str] = []
    done = client.wait(job.id, progress=lambda now: statuses.append(now.status), timeout=120)
    assert statuses[-1] == done.status == "succeeded"


def test_jobs_are_listed_newest_first_and_deleted(
    client: Client, finished: Job, example: Path
) -> None:
    later = client.wait(client.submit(example / "measurements.npy").id)
    ids = [job.id for job in client.list(status="succeeded")]
    assert ids.index(later.id) < ids.index(finished.id)
    client.delete(later.id)
    with pytest.raises(ServiceError) as caught:
        client.get(later.id)
    assert (caught.value.status, caught.value.slug) == (404, "unknown-job")
    assert not caught.value.refused_input


def test_refused_input_is_told_with_the_problem(client: Client, tmp_path: Path) -> None:
    np.save(tmp_path / "odd.npy", np.ones((7, 10)))
    with pytest.raises(ServiceError) as caught:
        client.submit(tmp_path / "odd.npy")
    assert caught.value.slug == "odd-row-count"
    assert caught.value.refused_input
    assert "7" in str(caught.value)


def test_a_failed_job_is_raised_with_its_cause(client: Client, tmp_path: Path) -> None:
    np.save(tmp_path / "constant.npy", np.zeros((20, 30)))
    job = client.wait(client.submit(tmp_path / "constant.npy").id, timeout=60)
    assert job.status == "failed"
    with pytest.raises(JobFailed, match="do not vary") as caught:
        require_success(job)
    assert caught.value.job is job


def test_nobody_there() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with Client(f"http://127.0.0.1:{port}", patience=0.3) as client:
        begun = time.monotonic()
        with pytest.raises(ServerUnreachable, match=str(port)):
            client.info()
        assert time.monotonic() - begun < 5


class _Moody(ThreadingHTTPServer):
    """A server that answers as it is told, in order, then with an empty list of jobs."""

    def __init__(self) -> None:
        self.bodies: list[bytes] = []
        self.paths: list[str] = []
        self.answers: list[Callable[[BaseHTTPRequestHandler], None]] = []
        super().__init__(("127.0.0.1", 0), _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Moody

    def do_GET(self) -> None:
        self.server.paths.append(self.path)
        if self.server.answers:
            self.server.answers.pop(0)(self)
        else:
            answer(self, 200, {"jobs": [], "next": None})

    def do_POST(self) -> None:
        self.server.bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
        self.do_GET()

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002
        """Keep quiet."""


def answer(handler: BaseHTTPRequestHandler, status: int, document: object, **headers: str) -> None:
    body = json.dumps(document).encode()
    handler.send_response(status)
    for name, value in headers.items():
        handler.send_header(name.replace("_", "-"), value)
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    handler.wfile.write(body)


def hang_up(handler: BaseHTTPRequestHandler) -> None:
    handler.close_connection = True
    handler.wfile = io.BytesIO()
    handler.connection.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def moody() -> Iterator[_Moody]:
    with _Moody() as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()


def _client(moody: _Moody, patience: float = 10.0) -> Client:
    return Client(f"http://127.0.0.1:{moody.server_address[1]}", patience=patience)


def test_what_passes_is_tried_again(moody: _Moody) -> None:
    moody.answers = [
        hang_up,
        lambda handler: answer(handler, 503, {"title": "Away"}, Retry_After="0"),
        lambda handler: answer(handler, 429, {"title": "Slower"}, Retry_After="1"),
    ]
    begun = time.monotonic()
    with _client(moody) as client:
        assert list(client.list()) == []
    assert moody.answers == []
    assert time.monotonic() - begun >= 1, "Retry-After was not kept"


def test_an_upload_is_sent_whole_again(moody: _Moody, tmp_path: Path, finished: Job) -> None:
    np.save(tmp_path / "tracks.npy", np.arange(1000.0).reshape(20, 50))
    moody.answers = [
        lambda handler: answer(handler, 503, {"title": "Away"}),
        lambda handler: answer(handler, 201, finished.model_dump(mode="json")),
    ]
    with _client(moody) as client:
        assert client.submit(tmp_path / "tracks.npy").id == finished.id
    content = (tmp_path / "tracks.npy").read_bytes()
    assert [content in body for body in moody.bodies] == [True, True]


def test_a_list_goes_on_over_pages_below_a_prefix(moody: _Moody, finished: Job) -> None:
    job = finished.model_dump(mode="json")
    moody.answers = [
        lambda handler: answer(
            handler, 200, {"jobs": [job], "next": "/prefix/v1/jobs?status=succeeded&cursor=a%2Bb"}
        ),
        lambda handler: answer(handler, 200, {"jobs": [job, job], "next": None}),
    ]
    with Client(f"http://127.0.0.1:{moody.server_address[1]}/prefix/") as client:
        assert len(list(client.list(status="succeeded"))) == 3
    assert moody.paths == [
        "/prefix/v1/jobs?status=succeeded",
        "/prefix/v1/jobs?status=succeeded&cursor=a%2Bb",
    ]


def test_loopback_needs_no_proxy(moody: _Moody, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    with _client(moody, patience=0) as client:
        assert list(client.list()) == []


def test_patience_ends(moody: _Moody) -> None:
    moody.answers = [lambda handler: answer(handler, 503, {"title": "Away"}, Retry_After="60")]
    with _client(moody, patience=1.0) as client, pytest.raises(ServiceError, match="Away"):
        client.info()


def test_an_address_that_no_request_goes_to_is_not_tried_again(
    moody: _Moody, tmp_path: Path
) -> None:
    moody.answers = [lambda handler: answer(handler, 302, {}, Location="ftp://127.0.0.1/a")]
    begun = time.monotonic()
    with _client(moody, patience=60.0) as client:
        with pytest.raises(ServerUnreachable, match="'ftp://'"):
            client.download("0" * 32, "result.npz", tmp_path / "result.npz")
        with pytest.raises(ServerUnreachable, match="non-printable"):
            client.get("\n")
    assert time.monotonic() - begun < 5
    assert len(moody.paths) == 1


def test_an_answer_that_is_no_problem_document_is_still_told(moody: _Moody) -> None:
    moody.answers = [lambda handler: answer(handler, 404, ["nothing"])]
    with _client(moody) as client, pytest.raises(ServiceError, match="404"):
        client.info()


class _Breaking(threading.Thread):
    """A way to a server that breaks off after so many bytes, as often as it is told."""

    def __init__(self, url: str, after: int, times: int) -> None:
        super().__init__(daemon=True)
        host, port = url.rpartition("/")[2].split(":")
        self._target = (host, int(port))
        self._after, self._left = after, times
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.broken = 0

    def run(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._carry, args=(client,), daemon=True).start()

    def _carry(self, client: socket.socket) -> None:
        server = socket.create_connection(self._target)

        def back() -> None:
            with contextlib.suppress(OSError):  # broken off meanwhile
                while data := server.recv(65536):
                    client.sendall(data)
            client.close()

        threading.Thread(target=back, daemon=True).start()
        carried = 0
        while data := client.recv(65536):
            server.sendall(data)
            carried += len(data)
            if carried > self._after and self._left > 0:
                self._left -= 1
                self.broken += 1
                break
        server.shutdown(socket.SHUT_WR)
        server.close()
        client.close()

    def stop(self) -> None:
        self._listener.close()


def test_a_large_file_gets_over_a_network_that_breaks(served: Served, tmp_path: Path) -> None:
    tracks = np.random.default_rng(0).standard_normal((60, 20_000))
    np.save(tmp_path / "w.npy", tracks)
    size = (tmp_path / "w.npy").stat().st_size
    way = _Breaking(served.url, 3_000_000, times=2)
    way.start()
    seen: list[tuple[int, int]] = []
    with Client(way.url, patience=20) as client:
        job = client.submit(
            tmp_path / "w.npy",
            options={"layout": "interleaved"},
            progress=lambda done, total: seen.append((done, total)),
            resumable=1,
        )
        assert (
            job.inputs["measurements"].sha256
            == hashlib.sha256((tmp_path / "w.npy").read_bytes()).hexdigest()
        )
        assert (job.frames, job.points) == (30, 20_000)
        client.delete(job.id)
    way.stop()
    assert way.broken == 2
    assert (seen[0], seen[-1]) == ((0, size), (size, size))


def test_a_large_file_that_is_refused(client: Client, tmp_path: Path) -> None:
    np.save(tmp_path / "odd.npy", np.ones((7, 10_000)))
    with pytest.raises(ServiceError) as caught:
        client.submit(tmp_path / "odd.npy", resumable=1)
    assert caught.value.slug == "odd-row-count"
