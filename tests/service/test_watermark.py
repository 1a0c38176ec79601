from __future__ import annotations

import os
import signal
import subprocess
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conftest import redis_running
from tests.service.conftest import Api, api_running, finished, npy, problem, settings_for, submit
from worker.pool import WorkerPool
from worker.records import new_job_id

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import httpx

MEBIBYTE = 1 << 20
TUS = {"Tus-Resumable": "1.0.0"}
PIECE = {**TUS, "Content-Type": "application/offset+octet-stream"}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 MiB."""
    folder = tmp_path / "data"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if done.returncode:
        pytest.skip(f"a small disk cannot be made: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def file_of(mebibytes: int) -> bytes:
    return npy(np.zeros((mebibytes * 2, 65536)))


def full(answer: httpx.Response) -> None:
    problem(answer, "storage-full", 507)
    assert int(answer.headers["Retry-After"]) > 0


def fill(folder: Path, leave: int) -> Path:
    ballast = folder / "ballast"
    found = os.statvfs(folder)
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, found.f_bavail * found.f_frsize - leave)
    return ballast


def test_uploads_are_refused_before_the_disk_is_full(
    small_disk: Path, tmp_path: Path, tracks: bytes
) -> None:
    with redis_running(tmp_path) as redis:
        settings = settings_for(
            tmp_path,
            redis,
            min_free_bytes=32 * MEBIBYTE,
            max_upload_bytes=128 * MEBIBYTE,
            max_array_bytes=256 * MEBIBYTE,
        )
        with api_running(settings, redis, tmp_path / "log") as api, api.client() as client:
            waiting = submit(client, {"measurements": ("w.npy", tracks)})
            whole = file_of(16)
            declared = {**TUS, "Upload-Length": str(len(whole))}
            begun = client.post("/v1/uploads", headers=declared)
            location = begun.headers["Location"]
            part = whole[: MEBIBYTE // 2]
            sent = client.patch(location, content=part, headers={**PIECE, "Upload-Offset": "0"})
            assert sent.status_code == 204, sent.text
            kept = api.stored()

            # What announces too much is refused at once, what does not while it arrives.
            large = file_of(40)
            full(submit(client, {"measurements": ("w.npy", large)}))
            full(client.put(f"/v1/uploads/{new_job_id()}?name=w.npy", content=large))
            announced = {**TUS, "Upload-Length": str(len(large))}
            full(client.post("/v1/uploads", headers=announced))
            pieces = (large[i : i + MEBIBYTE] for i in range(0, len(large), MEBIBYTE))
            full(client.put(f"/v1/uploads/{new_job_id()}?name=w.npy", content=pieces))
            assert api.stored() == kept

            ballast = fill(small_disk, 20 * MEBIBYTE)
            full(submit(client, {"measurements": ("w.npy", tracks)}))
            again = {**PIECE, "Upload-Offset": str(len(part))}
            full(client.patch(location, content=b"0" * 1000, headers=again))
            assert api.stored() == kept
            ready = client.get("/readyz")
            assert ready.status_code == 200
            assert ready.json()["checks"]["disk"] == "nearly full: uploads are refused"
            found = dict(
                line.split() for line in client.get("/metrics").text.splitlines() if "disk" in line
                and not line.startswith("#")
            )  # fmt: skip
            assert 0 < float(found["smsr_disk_free_bytes"]) < 21 * MEBIBYTE
            assert float(found["smsr_disk_reserve_bytes"]) == 32 * MEBIBYTE
            with WorkerPool(settings, 1):  # what was accepted is done
                assert finished(client, waiting)["status"] == "succeeded"
            result = client.get(f"{waiting.headers['Location']}/result.npz")
            assert result.status_code == 200

            ballast.unlink()
            assert client.get("/readyz").json()["checks"]["disk"] == "ok"
            more = client.patch(location, content=b"0" * 1000, headers=again)
            assert more.status_code == 204
            assert more.headers["Upload-Offset"] == str(len(part) + 1000)


def test_a_disk_that_is_full_all_the_same(small_disk: Path, tmp_path: Path) -> None:
    with redis_running(tmp_path) as redis:
        settings = settings_for(
            tmp_path,
            redis,
            min_free_bytes=0,
            max_upload_bytes=128 * MEBIBYTE,
            max_array_bytes=256 * MEBIBYTE,
        )
        with api_running(settings, redis, tmp_path / "log") as api, api.client() as client:
            fill(small_disk, 4 * MEBIBYTE)
            full(submit(client, {"measurements": ("w.npy", file_of(8))}))
            full(client.put(f"/v1/uploads/{new_job_id()}?name=w.npy", content=file_of(8)))
            assert not api.stored()


def test_readiness_is_told_in_time_when_redis_hangs(idle_api: Api) -> None:
    process = idle_api.redis.process
    assert process is not None
    with idle_api.client() as client:
        process.send_signal(signal.SIGSTOP)
        try:
            for _ in range(3):
                began = time.monotonic()
                answer = client.get("/readyz")
                assert time.monotonic() - began < 2.5
                checks = problem(answer, "not-ready", 503)["checks"]
                assert checks == {"redis": "does not answer", "storage": "ok", "disk": "ok"}
        finally:
            process.send_signal(signal.SIGCONT)
        assert client.get("/readyz").status_code == 200
