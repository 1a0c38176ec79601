"""Batches, priorities and results that are used again, over HTTP."""

from __future__ import annotations

import io
import json
import time
import zipfile
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.service.conftest import Api, finished, npy, problem, wait_for
from worker.records import new_job_id

if TYPE_CHECKING:
    import httpx

    from smsr.synthetic import Example


JSON = {"Content-Type": "application/json"}


def send(client: httpx.Client, content: bytes, name: str = "w.npy", **data: str) -> httpx.Response:
    answer = client.post("/v1/jobs", files={"measurements": (name, content)}, data=data)
    assert answer.status_code == 201, answer.text
    return answer


def label() -> str:
    return f"t-{new_job_id()[:12]}"


def batch(client: httpx.Client, name: str) -> dict[str, Any]:
    answer = client.get(f"/v1/batches/{name}")
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def test_a_batch_from_submission_to_download(
    client: httpx.Client, example: Example, tracks: bytes
) -> None:
    name = label()
    truth = ("truth.npy", npy(example.ground_truth))
    answers = [
        client.post(
            "/v1/jobs",
            files={"measurements": (f"walk é {k}.npy", tracks), "ground_truth": truth},
            data={"batch": name},
        )
        for k in range(2)
    ]
    bad = tracks[:-4] + np.float32(np.nan).tobytes()
    answers.append(send(client, bad, batch=name))
    jobs = [finished(client, answer) for answer in answers]
    assert [job["status"] for job in jobs] == ["succeeded", "succeeded", "failed"]
    assert {job["batch"] for job in jobs} == {name}

    found = batch(client, name)
    assert found["jobs"] == {
        "queued": 0, "running": 0, "succeeded": 2, "failed": 1, "cancelled": 0,
    }  # fmt: skip
    assert (found["total"], found["progress"]) == (3, 1.0)
    assert found["finished_at"] is not None
    errors = sorted(job["metrics"]["e3d"] for job in jobs[:2])
    assert found["e3d"]["count"] == 2
    assert (found["e3d"]["min"], found["e3d"]["max"]) == (errors[0], errors[1])
    assert found["e3d"]["mean"] == pytest.approx(sum(errors) / 2)
    assert found["timings"]["run"]["count"] == 2
    assert found["timings"]["run_total"] > 0

    listed = client.get("/v1/jobs", params={"batch": name}).json()["jobs"]
    assert {job["id"] for job in listed} == {job["id"] for job in jobs}
    assert client.get(found["links"]["jobs"]).json()["jobs"] == listed
    labels = [entry["label"] for entry in client.get("/v1/batches?limit=200").json()["batches"]]
    assert name in labels

    archive = client.get(found["links"]["results"])
    assert archive.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(archive.content)) as zipped:
        assert zipped.testzip() is None
        names = zipped.namelist()
        assert len(names) == len(set(names)) == 5
        assert json.loads(zipped.read("batch.json"))["label"] == name
        for job in jobs[:2]:
            (folder,) = {n.split("/")[0] for n in names if job["id"][:16] in n}
            assert folder.startswith("walk")
            assert folder.isascii()
            result = client.get(job["links"]["result"]).content
            with np.load(io.BytesIO(zipped.read(f"{folder}/result.npz"))) as packed:
                np.testing.assert_array_equal(
                    packed["shapes"], np.load(io.BytesIO(result))["shapes"]
                )
            assert "frames" in json.loads(zipped.read(f"{folder}/report.json"))

    retried = client.post(found["links"]["retry"])
    assert retried.status_code == 202
    assert retried.json() == {"queued": 0, "inputs_gone": 1, "refused": 0}
    assert client.delete(found["links"]["self"]).status_code == 204
    problem(client.get(found["links"]["self"]), "unknown-batch", 404)
    assert client.get("/v1/jobs", params={"batch": name}).json()["jobs"] == []


def test_a_batch_is_cancelled_and_run_again(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        for priority in ("low", "normal", "high"):
            send(client, tracks, batch="b", priority=priority)
        other = send(client, tracks, batch="c").json()
        answer = client.post("/v1/batches/b/cancel")
        assert answer.status_code == 202
        assert answer.json() == {"cancelled": 3, "stopping": 0}
        assert batch(client, "b")["jobs"]["cancelled"] == 3
        tickets = {key.decode() for key in idle_api.redis.client().scan_iter("rq:job:*")}
        assert {ticket.split(":")[2][:32] for ticket in tickets} == {other["id"]}

        assert client.post("/v1/batches/b/retry").json()["queued"] == 3
        assert batch(client, "b")["jobs"]["queued"] == 3
        redis = idle_api.redis.client()
        lengths = [redis.llen(f"rq:queue:smsr{suffix}") for suffix in ("-high", "", "-low")]
        assert lengths == [1, 2, 1]

        assert client.delete("/v1/batches/b").status_code == 204
        problem(client.delete("/v1/batches/b"), "unknown-batch", 404)
        assert [job["id"] for job in client.get("/v1/jobs").json()["jobs"]] == [other["id"]]


@pytest.mark.parametrize("path", ["", "/cancel", "/retry", "/results.zip"])
def test_labels_that_are_none(client: httpx.Client, path: str) -> None:
    method = "POST" if path in ("/cancel", "/retry") else "GET"
    problem(client.request(method, f"/v1/batches/no-such{path}"), "unknown-batch", 404)
    problem(client.request(method, f"/v1/batches/.hidden{path}"), "invalid-request", 422)


def test_jobs_wait_in_the_order_of_their_priorities(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        order = ["low", "normal", "high", "low", "high"]
        jobs = [send(client, tracks, priority=priority).json() for priority in order]
        places = [client.get(job["links"]["self"]).json()["queue_position"] for job in jobs]
        assert places == [3, 2, 0, 4, 1]
        client.delete(jobs[2]["links"]["self"])
        assert client.get(jobs[0]["links"]["self"]).json()["queue_position"] == 2


def test_an_equal_job_has_succeeded_at_once(api: Api, client: httpx.Client) -> None:
    tracks = npy(np.random.default_rng(time.time_ns()).normal(size=(40, 30)))
    first = finished(client, send(client, tracks, reuse="true"))
    assert first["reused_from"] is None
    again = send(client, tracks, "other.npy", reuse="true").json()
    assert (again["status"], again["reused_from"]) == ("succeeded", first["id"])
    assert again["id"] != first["id"]
    assert send(client, tracks, reuse="false").json()["status"] != "succeeded"
    changed = send(client, tracks, reuse="true", options='{"preset": "paper"}').json()
    assert changed["reused_from"] is None

    wanted = client.get(first["links"]["result"]).content
    assert client.delete(first["links"]["self"]).status_code == 204
    document = client.get(again["links"]["self"]).json()
    assert document["diagnostics"] is not None
    got = client.get(again["links"]["result"])
    with np.load(io.BytesIO(wanted)) as expected, np.load(io.BytesIO(got.content)) as found:
        np.testing.assert_array_equal(found["shapes"], expected["shapes"])
    assert client.delete(again["links"]["self"]).status_code == 204
    ids = (first["id"], again["id"])
    wait_for(lambda: not any(i in path for i in ids for path in api.stored()))


def test_a_job_is_kept_for_its_own_time(api: Api, client: httpx.Client, tracks: bytes) -> None:
    job = finished(client, send(client, tracks, ttl="0.5"))
    assert job["ttl"] == 0.5
    wait_for(lambda: client.get(job["links"]["self"]).status_code == 404)
    wait_for(lambda: not any(job["id"] in path for path in api.stored()))


def test_a_job_is_kept_longer_or_shorter(api: Api, client: httpx.Client, tracks: bytes) -> None:
    job = finished(client, send(client, tracks))
    here = job["links"]["self"]
    kept = client.patch(here, json={"ttl": 86400}).json()
    assert kept["ttl"] == 86400
    ended, due = (datetime.fromisoformat(kept[name]) for name in ("finished_at", "expires_at"))
    assert (due - ended).total_seconds() == pytest.approx(86400)
    merge = {"Content-Type": "application/merge-patch+json"}
    usual = client.patch(here, content=b'{"ttl": null}', headers=merge).json()
    assert (usual["ttl"], usual["expires_at"]) == (None, job["expires_at"])

    assert client.patch(here, json={"ttl": 0.01}).status_code == 200
    wait_for(lambda: client.get(here).status_code == 404)
    wait_for(lambda: not any(job["id"] in path for path in api.stored()))
    problem(client.patch(here, json={"ttl": 1}), "unknown-job", 404)


def test_a_change_that_is_none_is_refused(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        here = send(client, tracks, ttl="60").headers["Location"]
        before = client.get(here).json()
        for document in ({}, {"name": "x"}, {"ttl": 1, "name": "x"}):
            problem(client.patch(here, json=document), "unknown-part", 422)
        for ttl in (-1, "60", True, 1e12, 0, [1]):  # 0: for ever, which the settings do not allow
            answer = client.patch(here, json={"ttl": ttl})
            assert problem(answer, "invalid-setting", 422)["setting"] == "ttl"
        for ttl in (0, 1e12):
            refused = problem(client.patch(here, json={"ttl": ttl}), "invalid-setting", 422)
            assert "keeps jobs for at most 2592000 s." in refused["detail"]
            assert ("0 would keep the job for ever" in refused["detail"]) == (ttl == 0)
        problem(client.patch(here, content=b"{", headers=JSON), "malformed-json", 400)
        long = b'{"ttl": ' + b" " * 200_000 + b"1}"
        problem(client.patch(here, content=long, headers=JSON), "malformed-json", 400)
        answer = client.patch(here, content=b"ttl=1", headers={"Content-Type": "text/plain"})
        problem(answer, "unsupported-media-type", 415)
        assert "merge-patch" in answer.headers["accept-patch"]
        assert client.get(here).json() == before
        waiting = client.patch(here, json={"ttl": 90}).json()
        assert (waiting["ttl"], waiting["expires_at"]) == (90, None)
