from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from tests.conftest import clean_environment, redis_running, serving
from tests.service.conftest import npy
from worker.connections import connect
from worker.records import RecordStore, new_job_id

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def test_an_upload_under_way_is_finished_and_waiting_ends(tmp_path: Path) -> None:
    """SIGTERM in the middle of an upload, of a slow download and of a long poll."""
    body = npy(np.random.default_rng(0).normal(size=(20, 100_000)))
    half, told = threading.Event(), threading.Event()

    def pieces() -> Iterator[bytes]:
        yield body[: len(body) // 2]
        half.set()
        assert told.wait(20)
        time.sleep(1.0)  # the server is stopping by now
        yield body[len(body) // 2 :]

    found: dict[str, Any] = {}
    with redis_running(tmp_path) as redis:
        environment = clean_environment(REDIS_URL=redis.url)
        with serving(tmp_path, "--workers", "0", environment=environment) as server:
            upload_id = new_job_id()
            put = f"{server.url}/v1/uploads/{upload_id}?name=w.npy"
            asked = httpx.post(f"{server.url}/v1/jobs", files={"measurements": ("w.npy", body)})
            job = asked.headers["Location"]

            def upload() -> None:
                found["upload"] = httpx.put(put, content=pieces(), timeout=60)

            def wait() -> None:
                began = time.monotonic()
                headers = {"Prefer": "wait=60"}
                found["wait"] = httpx.get(server.url + job, headers=headers, timeout=70)
                found["waited"] = time.monotonic() - began

            threads = [threading.Thread(target=task) for task in (upload, wait)]
            file = f"{server.url}{job}/inputs/measurements"
            with httpx.stream("GET", file, timeout=60) as download:
                for thread in threads:
                    thread.start()
                assert half.wait(20)
                time.sleep(0.3)
                began = time.monotonic()
                server.process.send_signal(signal.SIGTERM)
                told.set()
                got = download.read()
            for thread in threads:
                thread.join(30)
            server.process.wait(30)
            assert time.monotonic() - began < 15
            with pytest.raises(httpx.ConnectError):
                httpx.get(f"{server.url}/healthz")
        assert got == body  # more than the sockets hold: most of it came after the signal
        assert found["upload"].status_code == 201
        assert found["upload"].json()["bytes"] == len(body)
        assert found["wait"].status_code == 200
        assert found["wait"].json()["status"] == "queued"
        assert found["waited"] < 10
        record = RecordStore(connect(redis.url)).get(job.rpartition("/")[2])
        assert record is not None
        assert record.status == "queued"
        assert "Traceback" not in server.log.read_text()
