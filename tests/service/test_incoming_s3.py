"""Uploads on their own in a bucket, through two API processes."""

from __future__ import annotations

import base64
import hashlib
import subprocess
import sys
import uuid
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from smsr.files import npy_header
from tests.service.conftest import Api, api_running, free_port, settings_for, wait_for
from worker.storage import ObjectStorage

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import RedisProcess

pytest.importorskip("moto")

MIB = 1 << 20
PIECE = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """URL of a bucket of an S3 server, which the environment leads to."""
    port = free_port()
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
    }
    command = [sys.executable, "-m", "moto.server", "-p", str(port)]
    with (
        pytest.MonkeyPatch.context() as patch,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server,
    ):
        for name, value in environment.items():
            patch.setenv(name, value)

        def made() -> bool:
            try:
                return httpx.put(f"http://127.0.0.1:{port}/uploads").status_code == 200
            except httpx.TransportError:
                return False

        try:
            wait_for(made, 60)
            yield "s3://uploads"
        finally:
            server.terminate()


@pytest.fixture
def pair(
    bucket: str, tmp_path: Path, redis_process: RedisProcess, redis_url: str
) -> Iterator[tuple[Api, Api]]:
    """Two API processes on one bucket."""
    assert redis_url
    settings = settings_for(tmp_path, redis_process, storage_url=f"{bucket}/{tmp_path.name}")
    with (
        api_running(settings, redis_process, tmp_path / "log1") as one,
        api_running(settings, redis_process, tmp_path / "log2") as two,
    ):
        yield one, two


def large(mib: int) -> bytes:
    points = mib * MIB // (4 * 256)
    return npy_header((256, points), "<f4") + np.random.default_rng(mib).bytes(4 * 256 * points)


def keys(api: Api) -> list[str]:
    storage = ObjectStorage(api.settings.objects_url)
    return [item.key for kind in ("incoming/", "uploads/") for item in storage.list_prefix(kind)]


def job_of(client: httpx.Client, url: str) -> dict[str, Any]:
    answer = client.post("/v1/jobs", json={"measurements": {"upload": url.rpartition("/")[2]}})
    assert answer.status_code == 201, answer.text
    job: dict[str, Any] = answer.json()
    return job


def test_pieces_through_two_processes_become_one_object(pair: tuple[Api, Api]) -> None:
    data = large(21)
    with pair[0].client() as one, pair[1].client() as two:
        created = one.post(
            "/v1/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": str(len(data))}
        )
        url = created.headers["Location"]
        offset = 0
        for client, size in ((one, 10), (two, 30_000), (one, 19 * MIB), (two, len(data))):
            piece = data[offset : offset + size]
            wrong = base64.b64encode(hashlib.sha1(piece[:-1]).digest()).decode()
            headers = PIECE | {"Upload-Offset": str(offset)}
            refused = client.patch(
                url, content=piece, headers=headers | {"Upload-Checksum": f"sha1 {wrong}"}
            )
            assert refused.status_code == 460
            assert client.patch(url, content=piece, headers=headers).status_code == 204
            offset += len(piece)
            assert one.head(url).headers["Upload-Offset"] == str(offset)
        assert one.get(url).json()["sha256"] == hashlib.sha256(data).hexdigest()
        job = job_of(two, url)
    key = f"uploads/{job['id']}/measurements"
    assert keys(pair[0]) == [key]
    assert ObjectStorage(pair[0].settings.objects_url).get(key) == data


def test_an_upload_of_one_piece_and_one_by_put(pair: tuple[Api, Api]) -> None:
    data = large(3)
    with pair[0].client() as client:
        headers = PIECE | {"Upload-Length": str(len(data))}
        by_tus = client.post("/v1/uploads", headers=headers, content=data).headers["Location"]
        by_put = f"/v1/uploads/{uuid.uuid4().hex}"
        assert client.put(by_put, content=data).status_code == 201
        jobs = [job_of(client, url) for url in (by_tus, by_put)]
        assert client.delete(by_tus, headers={"Tus-Resumable": "1.0.0"}).status_code == 204
    storage = ObjectStorage(pair[0].settings.objects_url)
    expected = {f"uploads/{job['id']}/measurements" for job in jobs}
    assert set(keys(pair[0])) <= expected
    assert all(storage.get(key) == data for key in keys(pair[0]))
