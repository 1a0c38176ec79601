from __future__ import annotations

import asyncio
import re
import threading
import time
from datetime import datetime
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np

import smsr
from tests.service.conftest import Api, finished, npy, problem, submit, wait_for

if TYPE_CHECKING:
    from smsr.synthetic import Example

UNKNOWN = "0" * 32


def test_a_job_runs_from_upload_to_report(
    client: httpx.Client, example: Example, tracks: bytes
) -> None:
    submitted = submit(
        client,
        {
            "ground_truth": ("truth.npy", npy(example.ground_truth)),
            "faces": ("faces.npy", npy(example.faces)),
            "measurements": ("my tracks.npy", tracks),
        },
        {"layout": "interleaved"},
    )
    assert submitted.status_code == 201
    accepted = submitted.json()
    assert submitted.headers["Location"] == f"/v1/jobs/{accepted['id']}"
    assert re.fullmatch(r"[0-9a-f]{32}", accepted["id"])
    assert accepted["links"]["cancel"] == f"/v1/jobs/{accepted['id']}/cancel"
    assert accepted["links"]["result"] is None

    job = finished(client, submitted)
    assert job["status"] == "succeeded", job
    assert (job["frames"], job["points"]) == (20, 64)
    assert job["options"]["layout"] == "interleaved"
    assert job["inputs"]["measurements"]["name"] == job["name"] == "my tracks.npy"
    assert job["inputs"]["measurements"]["bytes"] == len(tracks)
    assert set(job["inputs"]) == {"measurements", "ground_truth", "faces"}
    assert job["progress"]["fraction"] == 1.0
    assert job["timings"]["total"] > 0
    times = [datetime.fromisoformat(job[f"{step}_at"]) for step in ("created", "started")]
    assert times == sorted(times)
    assert job["diagnostics"]["basis_size"] >= 1
    assert job["problem"] is None
    assert job["links"]["cancel"] is None

    expected = smsr.evaluate(
        example.ground_truth,
        smsr.reconstruct(example.measurements.astype(np.float32), layout="interleaved"),
    )
    assert job["metrics"]["e3d"] == expected.e3d
    report = client.get(job["links"]["report"])
    assert report.headers["content-type"] == "application/json"
    assert report.json()["metrics"]["e3d"] == expected.e3d
    assert report.json()["camera_model"] == job["diagnostics"]["camera_model"]


def test_parts_come_in_any_order(client: httpx.Client, example: Example, tracks: bytes) -> None:
    """The options behind the file they are for."""
    boundary = b"limit"
    parts = [
        b'--limit\r\nContent-Disposition: form-data; name="measurements"; filename="w.npy"\r\n\r\n',
        npy(np.concatenate([example.measurements[::2], example.measurements[1::2]])),
        b'\r\n--limit\r\nContent-Disposition: form-data; name="options"\r\n\r\n',
        b'{"layout": "stacked"}',
        b"\r\n--limit--\r\n",
    ]
    kind = f"multipart/form-data; boundary={boundary.decode()}"
    submitted = client.post("/v1/jobs", content=b"".join(parts), headers={"Content-Type": kind})
    job = finished(client, submitted)
    assert job["status"] == "succeeded", job
    assert job["options"]["layout"] == "stacked"
    assert job["frames"] == 20


def test_wait_answers_as_soon_as_the_job_has_ended(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        url = submit(client, {"measurements": ("w.npy", tracks)}).headers["Location"]

        def cancel_soon() -> None:
            time.sleep(0.5)
            idle_api.client().post(f"{url}/cancel")

        started = time.monotonic()
        canceller = threading.Thread(target=cancel_soon)
        canceller.start()
        answer = client.get(url, headers={"Prefer": "wait=30"})
        waited = time.monotonic() - started
        canceller.join()
        assert answer.json()["status"] == "cancelled"
        assert answer.headers["Preference-Applied"] == "wait=30"
        assert 0.4 < waited < 3


def test_wait_answers_after_its_time_and_needs_no_thread(idle_api: Api, tracks: bytes) -> None:
    """More waiters than the server has threads for blocking calls."""

    async def crowd(url: str) -> list[httpx.Response]:
        limits = httpx.Limits(max_connections=100)
        async with httpx.AsyncClient(base_url=idle_api.url, limits=limits, timeout=30) as client:
            waiting = [
                asyncio.create_task(client.get(url, headers={"Prefer": "wait=2"}))
                for _ in range(60)
            ]
            await asyncio.sleep(0.7)
            started = time.monotonic()
            assert (await client.get("/v1/jobs")).status_code == 200
            assert (await client.get("/readyz")).status_code == 200
            assert time.monotonic() - started < 1
            return await asyncio.gather(*waiting)

    with idle_api.client() as client:
        url = submit(client, {"measurements": ("w.npy", tracks)}).headers["Location"]
    answers = asyncio.run(crowd(url))
    assert {answer.json()["status"] for answer in answers} == {"queued"}
    assert {answer.headers["Preference-Applied"] for answer in answers} == {"wait=2"}


def test_pages_hold_every_job_once_newest_first(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        ids = [submit(client, {"measurements": ("w.npy", tracks)}).json()["id"] for _ in range(7)]
        client.post(f"/v1/jobs/{ids[3]}/cancel")

        def walk(url: str) -> list[str]:
            found: list[str] = []
            while url:
                answer = client.get(url)
                assert answer.status_code == 200
                page = answer.json()
                assert len(page["jobs"]) <= 3
                found += [job["id"] for job in page["jobs"]]
                url = answer.links.get("next", {}).get("url", "")
                assert page["next"] == (url or None)
            return found

        assert walk("/v1/jobs?limit=3") == ids[::-1]
        queued = [job_id for job_id in ids[::-1] if job_id != ids[3]]
        assert walk("/v1/jobs?limit=3&status=queued") == queued
        assert walk("/v1/jobs?limit=3&status=cancelled") == [ids[3]]
        assert walk("/v1/jobs?limit=3&status=failed") == []


def test_a_list_refuses_parameters_that_make_no_sense(client: httpx.Client) -> None:
    for query, name in (("limit=0", "limit"), ("limit=x", "limit"), ("status=done", "status")):
        document = problem(client.get(f"/v1/jobs?{query}"), "invalid-request", 422)
        assert document["errors"][0]["in"] == "query"
        assert document["errors"][0]["name"] == name
    problem(client.get("/v1/jobs?cursor=somewhere"), "invalid-request", 422)


def test_a_queued_job_says_its_place_and_is_cancelled_once(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        urls = [
            submit(client, {"measurements": ("w.npy", tracks)}).headers["Location"]
            for _ in range(2)
        ]
        assert [client.get(url).json()["queue_position"] for url in urls] == [0, 1]
        first = client.post(f"{urls[0]}/cancel")
        assert (first.status_code, first.json()["status"]) == (200, "cancelled")
        problem(client.post(f"{urls[0]}/cancel"), "job-finished", 409)
        assert client.get(urls[1]).json()["queue_position"] == 0
        problem(client.get(f"{urls[0]}/result.npz"), "job-cancelled", 410)


def test_a_running_job_is_cancelled_and_can_be_run_again(api: Api, client: httpx.Client) -> None:
    slow = smsr.synthetic.make_example(frames=150, side=140).measurements.astype(np.float32)
    url = submit(client, {"measurements": ("w.npy", npy(slow))}).headers["Location"]
    wait_for(lambda: client.get(url).json()["status"] == "running")
    asked = client.post(f"{url}/cancel")
    assert asked.status_code == 202
    assert asked.json()["cancel_requested"]
    assert client.get(url, headers={"Prefer": "wait=20"}).json()["status"] == "cancelled"
    again = client.post(client.get(url).json()["links"]["retry"])
    assert (again.status_code, again.json()["status"]) == (202, "queued")
    problem(client.post(f"{url}/retry"), "job-unfinished", 409)
    assert client.delete(url).status_code == 204


def test_deleting_removes_every_trace(api: Api, client: httpx.Client, tracks: bytes) -> None:
    before = api.left_behind()
    submitted = submit(client, {"measurements": ("w.npy", tracks)})
    assert finished(client, submitted)["status"] == "succeeded"
    url = submitted.headers["Location"]
    assert api.left_behind() > before
    deleted = client.delete(url)
    assert (deleted.status_code, deleted.content) == (204, b"")
    wait_for(lambda: api.left_behind() <= before)  # the worker may be about to drop its ticket
    problem(client.delete(url), "unknown-job", 404)


def test_jobs_that_do_not_exist(client: httpx.Client) -> None:
    for job_id in (UNKNOWN, "1", "..%5c..", "%00", "*", UNKNOWN.upper() + "0"):
        for path in ("", "/result.npz", "/frames.zip", "/frames/0.ply", "/report.json"):
            problem(client.get(f"/v1/jobs/{job_id}{path}"), "unknown-job", 404)
    problem(client.delete(f"/v1/jobs/{UNKNOWN}"), "unknown-job", 404)
    problem(client.post(f"/v1/jobs/{UNKNOWN}/cancel"), "unknown-job", 404)
    problem(client.post(f"/v1/jobs/{UNKNOWN}/retry"), "unknown-job", 404)
    waited: Any = client.get(f"/v1/jobs/{UNKNOWN}", headers={"Prefer": "wait=20"})
    problem(waited, "unknown-job", 404)


def test_a_redis_that_cannot_write_is_as_good_as_away(idle_api: Api, tracks: bytes) -> None:
    """As with a full disk: what is stored can be read, and nothing new is accepted."""
    redis = idle_api.redis.client()
    files = {"measurements": ("t.npy", tracks)}
    with idle_api.client() as client:
        job = submit(client, files).headers["Location"]
        redis.config_set("min-replicas-to-write", 1)
        try:
            refused = submit(client, files)
            problem(refused, "queue-unavailable", 503)
            assert int(refused.headers["Retry-After"]) > 0
            problem(client.delete(job), "queue-unavailable", 503)
            assert client.get(job).json()["status"] == "queued"
        finally:
            redis.config_set("min-replicas-to-write", 0)
        assert client.delete(job).status_code == 204
    assert not idle_api.stored()
