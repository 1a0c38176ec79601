"""Uploads that are large, slow, broken off or killed."""

from __future__ import annotations

import asyncio
import hashlib
import json
import shutil
import signal
import socket
from contextlib import closing
from typing import TYPE_CHECKING

import httpx
import numpy as np
import pytest
from starlette.requests import Request

from service.problems import Problem
from service.uploads import UploadLimits, receive_submission, safe_name
from smsr.files import npy_header
from tests.service.conftest import (
    UPLOAD_LIMIT,
    Api,
    Files,
    api_running,
    npy,
    problem,
    settings_for,
    submit,
    wait_for,
)
from worker.records import new_job_id
from worker.storage import ObjectStorage

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from starlette.types import Message

    from tests.conftest import RedisProcess

MIB = 1 << 20
MULTIPART = "multipart/form-data; boundary=x"
PART = b'--x\r\nContent-Disposition: form-data; name="measurements"; filename="w.npy"\r\n\r\n'
END = b"\r\n--x--\r\n"


def head(points: int, frames: int = 128) -> bytes:
    """Return the header of float32 measurements whose rows have 4 bytes a point."""
    return npy_header((2 * frames, points), "<f4")


def large(mib: int) -> tuple[bytes, int]:
    """Return a header, and the number of bytes that must follow it."""
    points = mib * MIB // (4 * 256)
    return head(points), 4 * 256 * points


@pytest.mark.slow
def test_memory_does_not_grow_with_the_upload_nor_with_the_download(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> None:
    assert redis_url
    settings = settings_for(
        tmp_path, redis_process, max_upload_bytes=1 << 30, max_array_bytes=1 << 30
    )
    header, length = large(300)
    block = np.random.default_rng(0).bytes(MIB)
    digest = hashlib.sha256(header)

    def body() -> Iterator[bytes]:
        yield PART + header
        for _ in range(length // MIB):
            digest.update(block)
            yield block
        yield END

    with api_running(settings, redis_process, tmp_path / "log") as api, api.client() as client:
        small = {"measurements": ("w.npy", npy(np.ones((12, 9), np.float32)))}
        assert submit(client, small).status_code == 201
        before = api.resident()
        answer = client.post("/v1/jobs", content=body(), headers={"Content-Type": MULTIPART})
        assert answer.status_code == 201, answer.text
        assert api.resident("VmHWM") - before < 64 * MIB
        stored = answer.json()["inputs"]["measurements"]
        assert stored["bytes"] == len(header) + length
        assert stored["sha256"] == digest.hexdigest()

        # The upload is moved to where a result would be: only its bytes matter to a download.
        job_id = answer.json()["id"]
        frames, points = 240, length // (240 * 12)
        folder = api.objects / "results" / job_id / "1"
        folder.mkdir(parents=True)
        shapes = npy_header((frames, points, 3), "<f4")
        with (folder / "shapes.npy").open("wb") as file:
            file.write(shapes)
            file.truncate(len(shapes) + frames * points * 12)
        (folder / "cameras.npy").write_bytes(npy(np.zeros((frames, 2, 3))))
        (folder / "translations.npy").write_bytes(npy(np.zeros((frames, 2))))
        redis_process.client().hset(
            f"smsr:job:{job_id}",
            mapping={"status": "succeeded", "result_prefix": f"results/{job_id}/1/"},
        )
        for path in ("result.npz", "frames.zip"):
            received = 0
            with client.stream("GET", f"/v1/jobs/{job_id}/{path}") as download:
                assert download.status_code == 200
                for chunk in download.iter_raw():
                    received += len(chunk)
            assert received == int(download.headers["content-length"]) > frames * points * 12
        assert api.resident("VmHWM") - before < 64 * MIB


def test_a_stored_upload_is_byte_for_byte_what_was_sent(idle_api: Api) -> None:
    """Line breaks and pieces of the boundary within the data, in packets of every size."""
    payload = head(9) + (b"\r\n--x" * 3 + b"\r\n-" + b"\r") * 100
    payload = payload.ljust(len(head(9)) + 4 * 256 * 9, b"\r")
    payload = payload.replace(b"\r\n--x", b"\r\n--y")

    def trickle(step: int) -> Iterator[bytes]:
        whole = PART + payload + END
        for start in range(0, len(whole), step):
            yield whole[start : start + step]

    with idle_api.client() as client:
        for step in (1, 7, 1000, 10**6):
            answer = client.post(
                "/v1/jobs", content=trickle(step), headers={"Content-Type": MULTIPART}
            )
            assert answer.status_code == 201, answer.text
            stored = idle_api.objects / "uploads" / answer.json()["id"] / "measurements"
            assert stored.read_bytes() == payload


def connect(api: Api) -> socket.socket:
    address = httpx.URL(api.url)
    return socket.create_connection((address.host, address.port or 80), timeout=20)


def begin_upload(api: Api, mib: int) -> socket.socket:
    """Send the first part of an upload and leave the connection open."""
    header, length = large(mib)
    total = len(PART) + len(header) + length + len(END)
    connection = connect(api)
    connection.sendall(
        f"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: {MULTIPART}\r\n"
        f"Content-Length: {total}\r\n\r\n".encode()
    )
    connection.sendall(PART + header + bytes(length // 2))
    return connection


def is_storing(api: Api) -> bool:
    return any(path.stat().st_size >= 8 * MIB for path in api.objects.rglob("*") if path.is_file())


def test_a_client_that_goes_away_leaves_nothing(idle_api: Api) -> None:
    before = idle_api.left_behind()
    connection = begin_upload(idle_api, 24)
    wait_for(lambda: is_storing(idle_api))
    connection.close()
    wait_for(lambda: idle_api.left_behind() <= before)
    wait_for(lambda: not list((idle_api.objects / "uploads").glob("*")))
    with idle_api.client() as client:
        assert client.get("/v1/jobs").json() == {"jobs": [], "next": None}
    assert "Traceback" not in idle_api.log.read_text()


def test_a_killed_server_loses_no_job_and_keeps_no_half_upload(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> None:
    """Killed in the middle of one upload, and between record and queue of another.

    And Redis comes back later than the API.
    """
    assert redis_url
    settings = settings_for(tmp_path, redis_process)
    hasty = settings.model_copy(update={"orphan_grace_seconds": 1, "lost_ticket_seconds": 0.5})
    redis = redis_process.client()
    with api_running(settings, redis_process, tmp_path / "log") as api, api.client() as client:
        good = npy(np.random.default_rng(0).standard_normal((12, 9)))
        job_id = submit(client, {"measurements": ("w.npy", good)}).json()["id"]
        with closing(begin_upload(api, 24)):
            wait_for(lambda: is_storing(api))
            api.process.send_signal(signal.SIGKILL)
            api.process.wait()
        assert is_storing(api)
        redis.delete("rq:queue:smsr", "smsr:orphans")
    redis_process.kill()
    with api_running(hasty, redis_process, tmp_path / "log") as api, api.client() as client:
        problem(client.get("/readyz"), "not-ready", 503)  # it starts all the same
        redis_process.start()
        wait_for(lambda: not is_storing(api), seconds=15)
        assert api.stored() == {str(api.objects / "uploads" / job_id / "measurements")}
        assert [job["id"] for job in client.get("/v1/jobs").json()["jobs"]] == [job_id]
        wait_for(lambda: redis.llen("rq:queue:smsr") == 1)
        tickets: list[bytes] = redis.lrange("rq:queue:smsr", 0, -1)  # type: ignore[assignment]
        assert tickets[0].decode().startswith(job_id)


def test_a_refusal_comes_while_the_client_still_sends(idle_api: Api) -> None:
    """Refused by its first bytes: the rest is neither waited for nor stored."""
    before = idle_api.left_behind()
    with closing(connect(idle_api)) as connection:
        connection.sendall(
            f"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: {MULTIPART}\r\n"
            f"Content-Length: {20 * MIB}\r\n\r\n".encode()
            + PART
            + b"\x89PNG\r\n\x1a\n"
            + bytes(100_000)
        )
        answer = connection.recv(65536)
        assert answer.startswith(b"HTTP/1.1 415 ")
        assert b"connection: close" in answer
        for _ in range(8):  # nobody resets the connection while the client goes on
            connection.sendall(bytes(MIB))
        connection.shutdown(socket.SHUT_WR)
        while rest := connection.recv(65536):
            answer += rest
    document = json.loads(answer.partition(b"\r\n\r\n")[2])
    assert document["type"] == "/problems/unsupported-format"
    assert idle_api.left_behind() <= before


def test_an_announced_length_beyond_the_limit_is_refused_unread(idle_api: Api) -> None:
    with closing(connect(idle_api)) as connection:
        connection.sendall(
            f"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: {MULTIPART}\r\n"
            f"Expect: 100-continue\r\nContent-Length: {2 * UPLOAD_LIMIT}\r\n\r\n".encode()
        )
        answer = connection.recv(65536)
    assert answer.startswith(b"HTTP/1.1 413 ")  # and no 100 Continue before it


def test_a_body_without_length_is_cut_at_the_limit(idle_api: Api) -> None:
    header, length = large(2 * UPLOAD_LIMIT // MIB)

    def body() -> Iterator[bytes]:
        yield PART + header
        for _ in range(length // MIB):
            yield bytes(MIB)

    before = idle_api.left_behind()
    with idle_api.client() as client:
        answer = client.post("/v1/jobs", content=body(), headers={"Content-Type": MULTIPART})
        document = problem(answer, "upload-too-large", 413)
        assert document["limit"] == UPLOAD_LIMIT

        def preamble() -> Iterator[bytes]:
            for _ in range(2 * UPLOAD_LIMIT // MIB):
                yield bytes(MIB)

        answer = client.post("/v1/jobs", content=preamble(), headers={"Content-Type": MULTIPART})
        problem(answer, "upload-too-large", 413)
    assert idle_api.left_behind() <= before


def test_many_uploads_at_once(idle_api: Api) -> None:
    header, length = large(4)
    content = PART + header + bytes(length) + END

    async def upload(client: httpx.AsyncClient) -> int:
        async def body() -> AsyncIterator[bytes]:
            for start in range(0, len(content), 100_000):
                yield content[start : start + 100_000]

        headers = {"Content-Type": MULTIPART}
        return (await client.post("/v1/jobs", content=body(), headers=headers)).status_code

    async def all_at_once() -> list[int]:
        async with httpx.AsyncClient(base_url=idle_api.url, timeout=60) as client:
            return await asyncio.gather(*(upload(client) for _ in range(10)))

    assert asyncio.run(all_at_once()) == [201] * 10


def good_files() -> Files:
    return {"measurements": ("w.npy", npy(np.random.default_rng(0).standard_normal((12, 9))))}


def test_without_redis_nothing_is_taken_and_nothing_breaks(idle_api: Api) -> None:
    with idle_api.client() as client:
        url = submit(client, good_files()).headers["Location"]
        stored = idle_api.stored()
        idle_api.redis.kill()
        try:
            for answer in (
                submit(client, good_files()),
                client.get(url),
                client.get("/v1/jobs"),
                client.get(f"{url}/result.npz"),
                client.delete(url),
            ):
                problem(answer, "queue-unavailable", 503)
                assert int(answer.headers["Retry-After"]) > 0
            checks = problem(client.get("/readyz"), "not-ready", 503)["checks"]
            assert checks == {"redis": "does not answer", "storage": "ok", "disk": "ok"}
            assert client.get("/healthz").json() == {"status": "alive"}
            assert client.get("/v1/info").status_code == 200
            assert idle_api.stored() == stored
        finally:
            idle_api.redis.start()
        wait_for(lambda: client.get("/readyz").status_code == 200)
        assert client.get(url).json()["status"] == "queued"


def test_a_storage_that_cannot_be_written(idle_api: Api) -> None:
    with idle_api.client() as client:
        shutil.rmtree(idle_api.objects)
        idle_api.objects.write_text("in the way")
        try:
            answer = submit(client, good_files())
            problem(answer, "storage-unavailable", 503)
            assert int(answer.headers["Retry-After"]) > 0
            checks = problem(client.get("/readyz"), "not-ready", 503)["checks"]
            assert checks["redis"] == "ok"
            assert checks["storage"] == "cannot be written and read"
        finally:
            idle_api.objects.unlink()
        assert submit(client, good_files()).status_code == 201


def test_an_upload_that_stalls_is_given_up(tmp_path: Path) -> None:
    async def receive() -> Message:
        if arrived:
            return {"type": "http.request", "body": arrived.pop(), "more_body": True}
        await asyncio.sleep(60)
        raise AssertionError("nobody waits that long")

    arrived = [PART + large(1)[0] + bytes(500_000)]
    scope = {"type": "http", "method": "POST", "headers": [(b"content-type", MULTIPART.encode())]}
    storage = ObjectStorage(tmp_path.as_uri())
    limits = UploadLimits(UPLOAD_LIMIT, UPLOAD_LIMIT, idle_seconds=0.2)
    with pytest.raises(Problem) as raised:
        asyncio.run(receive_submission(Request(scope, receive), new_job_id(), storage, limits))
    assert raised.value.type.slug == "upload-stalled"
    assert not list(storage.list_prefix("uploads/"))


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("tracks.npy", "tracks.npy"),
        ("../../etc/passwd", "passwd"),
        ("C:\\data\\tracks.npy", "tracks.npy"),
        ("a\r\nb\x00c\x1b.npy", "abc.npy"),
        ("Spuren für Ärger.npy", "Spuren für Ärger.npy"),
        ("", "measurements"),
        ("/", "measurements"),
        (None, "measurements"),
        ("n" * 400 + ".npy", "n" * 130 + "n" * 16 + ".npy"),
    ],
)
def test_file_names_are_made_harmless(given: str | None, name: str) -> None:
    assert safe_name(given, "measurements") == name
