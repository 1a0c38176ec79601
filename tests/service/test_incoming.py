"""Uploads on their own: tus, PUT, and jobs made of them."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import select
import shutil
import signal
import socket
import subprocess
import threading
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
import redis
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

from smsr.files import npy_header
from tests.service.conftest import (
    UPLOAD_LIMIT,
    Api,
    api_running,
    finished,
    npy,
    problem,
    settings_for,
    wait_for,
)
from worker.records import new_job_id, upload_key
from worker.uploads import Upload, UploadStore, new_folder

if TYPE_CHECKING:
    from smsr.synthetic import Example
    from tests.conftest import RedisProcess

BROWSERS_CLIENT = Path(__file__).resolve().parent.parent / "tus"

MIB = 1 << 20
TUS = {"Tus-Resumable": "1.0.0"}
PIECE = TUS | {"Content-Type": "application/offset+octet-stream"}


def encoded(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def large(mib: int) -> bytes:
    """Return measurements of about so many MiB, whose every byte depends on its place."""
    points = mib * MIB // (4 * 256)
    rng = np.random.default_rng(mib)
    return npy_header((256, points), "<f4") + rng.bytes(4 * 256 * points)


def create(client: httpx.Client, length: int, name: str = "w.npy", **more: str) -> str:
    fields = {"filename": name, **more}
    metadata = ",".join(f"{key} {encoded(value)}" for key, value in fields.items())
    answer = client.post(
        "/v1/uploads", headers=TUS | {"Upload-Length": str(length), "Upload-Metadata": metadata}
    )
    assert answer.status_code == 201, answer.text
    assert answer.headers["Tus-Resumable"] == "1.0.0"
    assert answer.headers["Upload-Expires"].endswith("GMT")
    location: str = answer.headers["Location"]
    return location


def patch(client: httpx.Client, url: str, offset: int, data: bytes, **more: str) -> httpx.Response:
    headers = (
        PIECE | {"Upload-Offset": str(offset)} | {k.replace("_", "-"): v for k, v in more.items()}
    )
    return client.patch(url, content=data, headers=headers)


def offset_of(client: httpx.Client, url: str) -> int:
    answer = client.head(url, headers=TUS)
    assert answer.status_code == 200
    assert answer.headers["Cache-Control"] == "no-store"
    return int(answer.headers["Upload-Offset"])


def job_of(client: httpx.Client, **uploads: str) -> httpx.Response:
    document: dict[str, Any] = {
        role: {"upload": url.rpartition("/")[2]} for role, url in uploads.items()
    }
    return client.post("/v1/jobs", json=document)


def stored_bytes(api: Api, job: httpx.Response, role: str = "measurements") -> bytes:
    assert job.status_code == 201, job.text
    return api.storage().get(upload_key(job.json()["id"], role))


def test_what_is_spoken(client: httpx.Client) -> None:
    answer = client.options("/v1/uploads")
    assert answer.status_code == 204
    assert answer.headers["Tus-Version"] == "1.0.0"
    assert answer.headers["Tus-Max-Size"] == str(UPLOAD_LIMIT)
    extensions = answer.headers["Tus-Extension"].split(",")
    assert {"creation", "creation-with-upload", "termination", "checksum", "expiration"} <= {
        *extensions
    }
    assert "sha1" in answer.headers["Tus-Checksum-Algorithm"].split(",")


def test_the_protocols_own_client_and_a_job_with_three_uploads(
    client: httpx.Client, api: Api, example: Example, tmp_path: Path
) -> None:
    files = {
        "measurements": npy(example.measurements.astype(np.float32)),
        "ground_truth": npy(example.ground_truth.astype(np.float32)),
        "faces": npy(example.faces),
    }
    tus = TusClient(f"{api.url}/v1/uploads")
    urls: dict[str, str] = {}
    for role, data in files.items():
        path = tmp_path / f"{role}.npy"
        path.write_bytes(data)
        uploader = tus.uploader(
            str(path),
            chunk_size=1000,
            metadata={"filename": path.name, "filetype": "application/x-npy"},
            upload_checksum=True,
        )
        uploader.upload()
        assert uploader.url is not None
        urls[role] = uploader.url
        assert client.get(urls[role]).json()["sha256"] == hashlib.sha256(data).hexdigest()
    answer = job_of(client, **urls)
    for role, data in files.items():
        assert stored_bytes(api, answer, role) == data
    inputs = answer.json()["inputs"]
    assert (
        inputs["measurements"].items()
        >= {
            "name": "measurements.npy",
            "bytes": len(files["measurements"]),
            "content_type": "application/x-npy",
            "sha256": hashlib.sha256(files["measurements"]).hexdigest(),
        }.items()
    )
    job = finished(client, answer)
    assert job["status"] == "succeeded"
    assert job["metrics"]["e3d"] < 0.3


@pytest.mark.skipif(
    shutil.which("node") is None or not (BROWSERS_CLIENT / "node_modules").is_dir(),
    reason="needs node and `npm ci` in tests/tus",
)
def test_the_client_of_browsers(client: httpx.Client, api: Api, tmp_path: Path) -> None:
    content = large(6)
    path = tmp_path / "w.npy"
    path.write_bytes(content)
    command = ["node", "upload.mjs", f"{api.url}/v1/uploads", str(path)]
    run = subprocess.run(
        command, cwd=BROWSERS_CLIENT, capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    broken = told["broken"]
    assert broken["stopped"]
    assert broken["same"]
    assert broken["from"] >= len(content) / 2, "it began again"
    for url in (broken["url"], told["whole"], told["posted"]):
        upload = client.get(url).json()
        assert upload["complete"]
        assert upload["name"] == "w.npy"
        assert upload["sha256"] == hashlib.sha256(content).hexdigest()
        assert client.delete(url).status_code == 204
    problem(client.get(told["removed"]), "unknown-upload", 404)


def test_an_upload_serves_once(client: httpx.Client, tracks: bytes) -> None:
    url = create(client, len(tracks))
    problem(job_of(client, measurements=url), "upload-unfinished", 409)
    assert patch(client, url, 0, tracks).status_code == 204
    answers: list[int] = []

    def ask() -> None:
        with httpx.Client(base_url=client.base_url, timeout=60) as other:
            answers.append(job_of(other, measurements=url).status_code)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [201, 409, 409, 409]
    problem(job_of(client, measurements=url), "upload-used", 409)
    problem(patch(client, url, len(tracks), b""), "upload-used", 409)
    assert client.get(url).json()["links"]["job"].startswith("/v1/jobs/")
    assert url not in client.get("/v1/uploads").text


def test_pieces_offsets_and_the_end(client: httpx.Client, api: Api) -> None:
    data = large(5)
    url = create(client, len(data))
    cuts = [0, 1, 10, 70_000, 3 * MIB, len(data)]
    for start, stop in itertools.pairwise(cuts):
        assert offset_of(client, url) == start
        wrong = problem(patch(client, url, start + 1, b"x"), "upload-offset-mismatch", 409)
        assert wrong["offset"] == start
        answer = patch(client, url, start, data[start:stop])
        assert (answer.status_code, answer.headers["Upload-Offset"]) == (204, str(stop))
    problem(patch(client, url, len(data), b"x"), "upload-too-large", 413)
    document = client.get(url).json()
    assert document["complete"]
    assert document["sha256"] == hashlib.sha256(data).hexdigest()
    assert stored_bytes(api, job_of(client, measurements=url)) == data


def test_creation_with_upload_and_chunked_bodies(client: httpx.Client, api: Api) -> None:
    data = large(6)

    def body() -> Any:
        for start in range(0, len(data), 100_000):
            yield data[start : start + 100_000]

    headers = PIECE | {"Upload-Length": str(len(data))}
    answer = client.post("/v1/uploads", headers=headers, content=body())
    assert answer.status_code == 201
    assert answer.headers["Upload-Offset"] == str(len(data))
    assert stored_bytes(api, job_of(client, measurements=answer.headers["Location"])) == data


def test_termination(client: httpx.Client, api: Api) -> None:
    data = large(5)
    url = create(client, len(data))
    assert patch(client, url, 0, data[: 2 * MIB]).status_code == 204
    assert client.delete(url, headers=TUS).status_code == 204
    assert client.head(url).status_code == 404
    problem(client.delete(url, headers=TUS), "unknown-upload", 404)
    assert not any("incoming" in path for path in api.stored())


def test_methods_for_clients_without_patch(client: httpx.Client, tracks: bytes) -> None:
    url = create(client, len(tracks))
    headers = PIECE | {"Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}
    assert client.post(url, content=tracks, headers=headers).status_code == 204
    assert client.post(url, headers={"X-HTTP-Method-Override": "DELETE"}).status_code == 204
    problem(client.post(url), "method-not-allowed", 405)


@pytest.mark.parametrize(
    ("headers", "slug", "status"),
    [
        ({}, "unsupported-tus-version", 412),
        ({"Tus-Resumable": "0.2.2"}, "unsupported-tus-version", 412),
        (TUS, "malformed-upload", 400),
        (TUS | {"Upload-Length": "-1"}, "malformed-upload", 400),
        (TUS | {"Upload-Length": "9" * 30}, "malformed-upload", 400),
        (TUS | {"Upload-Length": str(UPLOAD_LIMIT + 1)}, "upload-too-large", 413),
        (TUS | {"Upload-Length": "0"}, "empty-file", 422),
        (TUS | {"Upload-Length": "9", "Upload-Metadata": "filename ???"}, "malformed-upload", 400),
        (TUS | {"Upload-Length": "9", "Upload-Metadata": "role eA=="}, "malformed-upload", 400),
    ],
)
def test_creations_that_are_refused(
    client: httpx.Client, headers: dict[str, str], slug: str, status: int
) -> None:
    answer = client.post("/v1/uploads", headers=headers)
    problem(answer, slug, status)
    assert answer.headers["Tus-Resumable"] == "1.0.0"


def test_pieces_that_are_refused(client: httpx.Client, tracks: bytes) -> None:
    url = create(client, len(tracks))
    for headers, slug, status in (
        ({}, "unsupported-tus-version", 412),
        (TUS, "unsupported-media-type", 415),
        (PIECE, "malformed-upload", 400),
        (PIECE | {"Upload-Offset": "x"}, "malformed-upload", 400),
        (PIECE | {"Upload-Offset": "0", "Upload-Checksum": "md5 eA=="}, "malformed-digest", 400),
        (PIECE | {"Upload-Offset": "0", "Upload-Checksum": "sha1 eA=="}, "malformed-digest", 400),
        (PIECE | {"Upload-Offset": "0", "Content-Digest": "md5=:eA==:"}, "malformed-digest", 400),
        (PIECE | {"Upload-Offset": "0", "Content-Digest": "x"}, "malformed-digest", 400),
    ):
        problem(client.patch(url, content=tracks, headers=headers), slug, status)
    problem(client.patch("/v1/uploads/x", content=b"", headers=PIECE), "unknown-upload", 404)
    nobody = f"/v1/uploads/{uuid.uuid4().hex}"
    problem(patch(client, nobody, 0, tracks), "unknown-upload", 404)
    problem(job_of(client, measurements=nobody), "unknown-upload", 404)
    assert offset_of(client, url) == 0


def test_a_file_that_cannot_be_used_is_refused_by_its_first_bytes(
    client: httpx.Client, api: Api
) -> None:
    url = create(client, 20 * MIB, "w.jpg")
    problem(patch(client, url, 0, b"\xff\xd8\xff\xe0" * 30_000), "unsupported-format", 415)
    assert client.head(url).status_code == 404
    odd = npy_header((7, MIB // 4), "<f4")
    url = create(client, len(odd) + 7 * MIB, role="measurements")
    problem(patch(client, url, 0, odd + bytes(MIB)), "odd-row-count", 422)
    put = f"/v1/uploads/{uuid.uuid4().hex}"
    problem(client.put(put, content=b"\xff\xd8\xff\xe0" * 30_000), "unsupported-format", 415)
    problem(client.put(put, content=b""), "empty-file", 422)
    assert client.head(put).status_code == 404
    assert not any("incoming" in path for path in api.stored())


def digest(algorithm: str, data: bytes) -> str:
    return base64.b64encode(hashlib.new(algorithm, data).digest()).decode()


def test_checksums_of_pieces(client: httpx.Client) -> None:
    data = large(12)
    url = create(client, len(data))
    first, rest = data[: 9 * MIB], data[9 * MIB :]
    wrong = f"sha1 {digest('sha1', rest)}"
    answer = patch(client, url, 0, first, Upload_Checksum=wrong)
    problem(answer, "checksum-mismatch", 460)
    assert answer.headers["Tus-Resumable"] == "1.0.0"
    assert offset_of(client, url) == 0
    right = f"sha1 {digest('sha1', first)}"
    assert patch(client, url, 0, first, Upload_Checksum=right).status_code == 204
    bad = f"sha-256=:{digest('sha256', first)}:"
    for field in ("Content_Digest", "Repr_Digest"):
        problem(patch(client, url, len(first), rest, **{field: bad}), "digest-mismatch", 400)
    assert offset_of(client, url) == len(first)
    good = f"md5=:{digest('md5', rest)}:, sha-512=:{digest('sha512', rest)}:;x=1"
    assert patch(client, url, len(first), rest, Content_Digest=good).status_code == 204
    assert client.get(url).json()["sha256"] == hashlib.sha256(data).hexdigest()


def test_a_whole_file_by_put(client: httpx.Client, api: Api, tracks: bytes) -> None:
    url = f"/v1/uploads/{uuid.uuid4().hex}"
    headers = {
        "Content-Type": "application/x-npy",
        "Content-Disposition": 'attachment; filename="../odd name.npy"',
        "Repr-Digest": f"sha-256=:{digest('sha256', tracks)}:",
    }
    assert client.put(url, content=tracks, headers=headers).status_code == 201
    again = client.put(url, content=tracks, headers=headers)
    assert again.status_code == 200
    document = again.json()
    assert (document["name"], document["content_type"]) == ("odd name.npy", "application/x-npy")
    bad = {"Content-Digest": f"sha-256=:{digest('sha256', b'x')}:"}
    problem(client.put(url, content=tracks, headers=bad), "digest-mismatch", 400)
    assert client.get(url).json() == document  # what was there stays
    chunked = client.put(url, content=iter([tracks[:100], tracks[100:]]), params={"name": "a.npy"})
    assert (chunked.status_code, chunked.json()["name"]) == (200, "a.npy")
    partial = {"Content-Range": "bytes 0-9/100"}
    problem(client.put(url, content=tracks, headers=partial), "malformed-upload", 400)
    answer = job_of(client, measurements=url)
    assert stored_bytes(api, answer) == tracks
    problem(client.put(url, content=tracks), "upload-used", 409)
    assert stored_bytes(api, answer) == tracks


def test_the_digest_of_a_multipart_body(client: httpx.Client, tracks: bytes) -> None:
    request = client.build_request("POST", "/v1/jobs", files={"measurements": ("w.npy", tracks)})
    body = request.read()
    headers = {"Content-Type": request.headers["Content-Type"]}
    bad = headers | {"Content-Digest": f"sha-256=:{digest('sha256', tracks)}:"}
    problem(client.post("/v1/jobs", content=body, headers=bad), "digest-mismatch", 400)
    good = headers | {"Content-Digest": f"sha-256=:{digest('sha256', body)}:"}
    assert client.post("/v1/jobs", content=body, headers=good).status_code == 201


def test_documents_that_are_refused(client: httpx.Client, tracks: bytes) -> None:
    url = f"/v1/uploads/{uuid.uuid4().hex}"
    client.put(url, content=tracks)
    good = {"upload": url.rpartition("/")[2]}
    for document, slug, status in (
        ([], "malformed-json", 400),
        ({}, "missing-measurements", 422),
        ({"measurements": good, "more": 1}, "unknown-part", 422),
        ({"measurements": good["upload"]}, "invalid-request", 422),
        ({"measurements": {"upload": "x"}}, "invalid-request", 422),
        ({"measurements": good, "faces": good}, "upload-used", 409),
        ({"measurements": good, "options": []}, "malformed-options", 422),
        ({"measurements": good, "options": {"x": 1}}, "unknown-option", 422),
        ({"measurements": good, "priority": "x"}, "invalid-setting", 422),
    ):
        problem(client.post("/v1/jobs", json=document), slug, status)
    json_type = {"Content-Type": "application/json; charset=utf-8"}
    problem(client.post("/v1/jobs", content=b"{", headers=json_type), "malformed-json", 400)
    full = json.dumps({"measurements": good, "options": {"layout": "interleaved"}})
    assert client.post("/v1/jobs", content=full, headers=json_type).status_code == 201


def begin_patch(api: Api, url: str, offset: int, length: int) -> socket.socket:
    """Send the head of a PATCH and leave the connection open."""
    address = httpx.URL(api.url)
    connection = socket.create_connection((address.host, address.port or 80), timeout=20)
    fields = PIECE | {"Upload-Offset": str(offset), "Content-Length": str(length), "Host": "x"}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    connection.sendall(f"PATCH {url} HTTP/1.1\r\n{lines}\r\n".encode())
    return connection


def test_what_arrived_before_the_connection_broke_is_kept(client: httpx.Client, api: Api) -> None:
    data = large(9)
    url = create(client, len(data))
    connection = begin_patch(api, url, 0, len(data))
    connection.sendall(data[: 5 * MIB + 17])
    connection.close()
    wait_for(lambda: offset_of(client, url) == 5 * MIB + 17)
    offset = 5 * MIB + 17
    assert patch(client, url, offset, data[offset:]).status_code == 204
    assert client.get(url).json()["sha256"] == hashlib.sha256(data).hexdigest()


def test_of_two_requests_at_once_the_later_one_holds(client: httpx.Client, api: Api) -> None:
    """A connection that hangs must not keep its client from going on over another one."""
    data = large(24)
    url = create(client, len(data))
    hung = begin_patch(api, url, 0, len(data))
    hung.sendall(data[: 10 * MIB])  # a bucket gets 8 MiB at a time
    wait_for(lambda: offset_of(client, url) >= 8 * MIB)
    offset = offset_of(client, url)
    assert patch(client, url, offset, data[offset : 14 * MIB]).status_code == 204
    late = len(data) - 10 * MIB
    while late and not select.select([hung], [], [], 0.2)[0]:
        step = min(late, 2 * MIB)
        hung.sendall(bytes(step))  # other bytes than the right ones, and too late
        late -= step
    assert hung.recv(100).startswith(b"HTTP/1.1 409")
    hung.close()
    assert offset_of(client, url) == 14 * MIB
    assert patch(client, url, 14 * MIB, data[14 * MIB :]).status_code == 204
    assert client.get(url).json()["sha256"] == hashlib.sha256(data).hexdigest()
    assert stored_bytes(api, job_of(client, measurements=url)) == data


def test_many_requests_at_once_corrupt_nothing(client: httpx.Client, api: Api) -> None:
    data = large(20)
    url = create(client, len(data))
    done = threading.Event()

    def go_on() -> None:
        with httpx.Client(base_url=api.url, timeout=60) as other:
            while not done.is_set():
                offset = offset_of(other, url)
                if offset == len(data):
                    done.set()
                    return
                answer = patch(other, url, offset, data[offset : offset + 5 * MIB])
                assert answer.status_code in (204, 409), answer.text

    threads = [threading.Thread(target=go_on) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wait_for(lambda: client.get(url).json()["sha256"] is not None)
    assert stored_bytes(api, job_of(client, measurements=url)) == data


def test_a_killed_server_is_gone_on_from_by_another(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> None:
    """Two processes on one storage; one is killed in the middle of a request."""
    assert redis_url
    settings = settings_for(tmp_path, redis_process)
    data = large(24)
    with (
        api_running(settings, redis_process, tmp_path / "log") as first,
        api_running(settings, redis_process, tmp_path / "log2") as second,
        second.client() as client,
    ):
        url = create(client, len(data))
        with begin_patch(first, url, 0, len(data)) as connection:
            connection.sendall(data[: 14 * MIB])
            wait_for(lambda: offset_of(client, url) >= 8 * MIB)
            first.process.send_signal(signal.SIGKILL)
            first.process.wait()
        offset = offset_of(client, url)
        assert 8 * MIB <= offset <= 14 * MIB
        assert patch(client, url, offset, data[offset:]).status_code == 204
        assert client.get(url).json()["sha256"] == hashlib.sha256(data).hexdigest()
        assert stored_bytes(second, job_of(client, measurements=url)) == data


def test_a_server_killed_before_the_upload_was_sealed(client: httpx.Client, api: Api) -> None:
    data = large(2)
    url = create(client, len(data))
    assert patch(client, url, 0, data).status_code == 204
    key = f"smsr:upload::{url.rpartition('/')[2]}"
    assert api.redis.client().hdel(key, "sha256", "key") == 2
    answer = job_of(client, measurements=url)
    assert answer.json()["inputs"]["measurements"]["sha256"] == hashlib.sha256(data).hexdigest()
    assert stored_bytes(api, answer) == data


def test_a_submission_that_died_half_way_loses_no_upload(client: httpx.Client, api: Api) -> None:
    data = large(1)
    url = create(client, len(data))
    assert patch(client, url, 0, data).status_code == 204
    upload_id = url.rpartition("/")[2]
    store = UploadStore(api.redis.client(), ttl=60)
    died = uuid.uuid4().hex
    store.take(None, {"measurements": upload_id}, died)
    upload = store.get(None, upload_id)
    assert upload is not None
    for moved in (False, True):
        if moved:
            store.give_back(None, [upload_id], died)
            store.take(None, {"measurements": upload_id}, died)
            (api.objects / "uploads" / died).mkdir(parents=True)
            (api.objects / "incoming" / upload.folder / "whole").replace(
                api.objects / "uploads" / died / "measurements"
            )
        problem(job_of(client, measurements=url), "upload-used", 409)
    api.redis.client().hset(f"smsr:upload::{upload_id}", "taken_at", 0)
    assert stored_bytes(api, job_of(client, measurements=url)) == data


def test_abandoned_uploads_expire_and_are_counted(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> None:
    assert redis_url
    settings = settings_for(tmp_path, redis_process, upload_ttl_seconds=1.5)
    data = large(6)
    with api_running(settings, redis_process, tmp_path / "log") as api, api.client() as client:
        urls = [create(client, len(data)) for _ in range(2)]
        for url in urls:
            patch(client, url, 0, data[: 5 * MIB])
        assert len(client.get("/v1/uploads").json()["uploads"]) == 2
        put = f"/v1/uploads/{uuid.uuid4().hex}"
        assert client.put(put, content=data).status_code == 201
        wait_for(lambda: api.stored() == set())
        for url in (*urls, put):
            assert client.head(url).status_code == 404
        problem(patch(client, urls[0], 5 * MIB, data[5 * MIB :]), "unknown-upload", 404)
        assert client.get("/v1/uploads").json() == {"uploads": []}
        assert not list(redis_process.client().scan_iter("smsr:upload*"))
        assert not list(redis_process.client().scan_iter("smsr:incoming"))


def begun(owner: str) -> Upload:
    return Upload(id=new_job_id(), owner=owner, folder=new_folder(), name="w", length=3)


def test_what_is_known_of_uploads_goes_with_them(
    redis_process: RedisProcess, redis_url: str
) -> None:
    """A client that leaves uploads behind for months leaves no trace of them in Redis."""
    client = redis_process.client()
    brief, long = UploadStore(client, ttl=0.2), UploadStore(client, ttl=60)
    for _ in range(25):
        assert brief.create(begun("ann"))
    kept = begun("ann")
    assert long.create(kept)
    assert client.zcard("smsr:uploads@ann") == 26
    time.sleep(0.3)
    for _ in range(3):
        assert brief.create(begun("ann"))
    assert client.zcard("smsr:uploads@ann") == 4
    assert [upload.id for upload in brief.list("ann")][-1] == kept.id
    assert 50 < client.ttl("smsr:uploads@ann") <= 60
    assert brief.create(begun("bob"))
    time.sleep(0.3)
    assert not client.exists("smsr:uploads@bob")


def test_uploads_have_owners(redis_process: RedisProcess, redis_url: str) -> None:
    assert redis_url
    store = UploadStore(redis_process.client(), ttl=60)
    mine = Upload(id="0" * 32, owner="a", folder="1" * 32, name="w", length=3)
    assert store.create(mine)
    assert store.get("b", mine.id) is None
    assert store.get(None, mine.id) is None
    assert store.list("b") == []
    assert store.delete("b", mine.id) is None
    theirs = Upload(id=mine.id, owner="b", folder="2" * 32, name="x", length=4)
    assert store.create(theirs)
    found = store.get("a", mine.id)
    assert found is not None
    assert (found.folder, found.length) == (mine.folder, 3)


def test_a_full_disk_and_a_failing_storage(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> None:
    """What was accepted stays, and the upload goes on when the storage works again."""
    assert redis_url
    settings = settings_for(tmp_path, redis_process)
    data = large(9)
    with api_running(settings, redis_process, tmp_path / "log") as api, api.client() as client:
        url = create(client, len(data))
        patch(client, url, 0, data[: 4 * MIB])
        incoming = api.objects / "incoming"
        incoming.rename(api.objects / "away")
        incoming.write_text("no folder")
        problem(patch(client, url, 4 * MIB, data[4 * MIB :]), "storage-unavailable", 503)
        put = f"/v1/uploads/{uuid.uuid4().hex}"
        problem(client.put(put, content=data), "storage-unavailable", 503)
        assert offset_of(client, url) == 4 * MIB
        incoming.unlink()
        (api.objects / "away").rename(incoming)
        assert patch(client, url, 4 * MIB, data[4 * MIB :]).status_code == 204
        assert stored_bytes(api, job_of(client, measurements=url)) == data


def test_a_refused_client_of_the_protocol_learns_why(api: Api, tmp_path: Path) -> None:
    path = tmp_path / "w.npy"
    path.write_bytes(b"")
    with pytest.raises(TusCommunicationError):
        TusClient(f"{api.url}/v1/uploads").uploader(str(path)).upload()


def test_redis_away(tmp_path: Path) -> None:
    """Nothing is promised without a record."""
    store = UploadStore(redis.Redis(unix_socket_path=str(tmp_path / "none")), ttl=60)
    with pytest.raises(redis.ConnectionError):
        store.get(None, "0" * 32)
