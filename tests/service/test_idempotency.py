"""Submissions that are sent again under one Idempotency-Key."""

from __future__ import annotations

import json
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from service.idempotency import CLAIM_SECONDS, read_key
from service.problems import Problem
from smsr_client import Client
from tests.service.conftest import (
    Api,
    Files,
    api_running,
    finished,
    npy,
    problem,
    settings_for,
    wait_for,
)
from worker.records import IdempotencyKey, JobRecord, KeyTaken, RecordStore, new_job_id

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import RedisProcess

KEY = "8e03978e-40d5-43e8-bc93-6894a57f9324"


def send(
    client: httpx.Client, tracks: bytes, key: str = KEY, name: str = "w.npy", **data: str
) -> httpx.Response:
    files = {"measurements": (name, tracks)}
    return client.post("/v1/jobs", files=files, data=data, headers={"Idempotency-Key": key})


def jobs(client: httpx.Client) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/v1/jobs").json()["jobs"]
    return found


def test_a_repetition_gets_the_first_job_and_leaves_nothing(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        first = send(client, tracks, batch="b", options=json.dumps({"layout": "auto"}))
        stored = idle_api.left_behind()
        again = send(client, tracks, batch="b", options=json.dumps({"layout": "auto"}))
        assert (first.status_code, again.status_code) == (201, 201)
        assert again.headers["Location"] == first.headers["Location"]
        assert again.json()["id"] == first.json()["id"]
        assert "Idempotent-Replayed" not in first.headers
        assert again.headers["Idempotent-Replayed"] == "true"
        assert idle_api.left_behind() == stored
        assert len(jobs(client)) == 1


@pytest.mark.parametrize(
    "change",
    [{"batch": "c"}, {"options": '{"preset": "paper"}'}, {"name": "v.npy"}, {"priority": "low"}],
)
def test_another_submission_under_the_same_key(
    idle_api: Api, tracks: bytes, change: dict[str, str]
) -> None:
    with idle_api.client() as client:
        assert send(client, tracks).status_code == 201
        stored = idle_api.left_behind()
        problem(send(client, tracks, **change), "idempotency-key-reused", 422)
        problem(send(client, tracks[:-4] + b"\0\0\0\0"), "idempotency-key-reused", 422)
        assert send(client, tracks, key="another", **change).status_code == 201
        assert idle_api.left_behind() > stored


@pytest.mark.parametrize(
    "files",
    [
        {"measurements": ("w.npy", npy(np.zeros((7, 9))))},
        {"measurements": ("w.npy", b"\x89PNG\r\n\x1a\n" + bytes(100))},
        {"measurements": ("w.npy", b"")},
        {"ground_truth": ("s.npy", npy(np.zeros((3, 5, 3))))},
        {"faces": ("f.npy", b"no array")},
    ],
    ids=["odd rows", "an image", "empty", "truth of other frames", "faces that are none"],
)
def test_an_unusable_file_under_the_same_key_is_another_submission(
    idle_api: Api, tracks: bytes, files: Files
) -> None:
    with idle_api.client() as client:
        assert send(client, tracks).status_code == 201
        stored = idle_api.left_behind()
        both: Files = {"measurements": ("w.npy", tracks)} | files
        answer = client.post("/v1/jobs", files=both, headers={"Idempotency-Key": KEY})
        problem(answer, "idempotency-key-reused", 422)
        assert idle_api.left_behind() == stored
        refused = client.post("/v1/jobs", files=both, headers={"Idempotency-Key": "another"})
        assert refused.status_code in (415, 422)
        assert "idempotency" not in refused.json()["type"]


def test_a_job_that_is_gone_is_not_made_again(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        job = send(client, tracks).json()
        client.delete(job["links"]["self"])
        gone = problem(send(client, tracks), "submission-gone", 410)
        assert gone["job"] == job["id"]
        assert jobs(client) == []
        wait_for(lambda: not idle_api.left_behind())


def test_what_was_refused_is_not_remembered(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        assert send(client, b"no array", name="w.npy").status_code in (415, 422)
        problem(send(client, tracks, ttl="-1"), "invalid-setting", 422)
        assert send(client, tracks).status_code == 201


@pytest.mark.parametrize("key", ["", '""', "a" * 256, "two\twords", "k\u00e9y".encode()])
def test_keys_that_are_none(idle_api: Api, tracks: bytes, key: str | bytes) -> None:
    with idle_api.client() as client:
        headers = {b"Idempotency-Key": key if isinstance(key, bytes) else key.encode()}
        answer = client.post("/v1/jobs", files={"measurements": ("w.npy", tracks)}, headers=headers)
        problem(answer, "invalid-idempotency-key", 400)


def test_quotes_are_no_part_of_a_key() -> None:
    assert read_key('"a b"') == read_key("a b") == "a b"
    assert read_key(r'"a \"b\" \\"') == 'a "b" \\'
    with pytest.raises(Problem):
        read_key("a\x7f")


def test_twenty_at_once_make_one_job(idle_api: Api, tracks: bytes) -> None:
    def insist(_: int) -> str:
        with idle_api.client() as client:
            for _attempt in range(60):
                answer = send(client, tracks)
                if answer.status_code == 201:
                    return answer.headers["Location"]
                problem(answer, "submission-in-progress", 409)
                assert 1 <= int(answer.headers["Retry-After"]) <= 10
                time.sleep(0.1)
        raise AssertionError("always in progress")

    with ThreadPoolExecutor(20) as pool:
        assert len(set(pool.map(insist, range(20)))) == 1
    with idle_api.client() as client:
        (job,) = jobs(client)
    assert {path.split("/")[-2] for path in idle_api.stored()} == {job["id"]}


def test_a_process_that_dies_in_between_neither_loses_nor_doubles_a_job(
    tmp_path: Path, redis_process: RedisProcess, redis_url: str, tracks: bytes
) -> None:
    assert redis_url
    settings = settings_for(tmp_path, redis_process, orphan_grace_seconds=0.5)
    boundary = b"--x\r\nContent-Disposition: form-data; name=%b\r\n\r\n"
    part = boundary.replace(b"%b", b'"measurements"; filename="w.npy"')

    def halting() -> Iterator[bytes]:
        yield part + tracks[:5000]
        wait_for(lambda: redis_process.client().keys("smsr:idempotency:*"))
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        yield tracks[5000:]

    headers = {"Idempotency-Key": KEY, "Content-Type": "multipart/form-data; boundary=x"}
    with (
        api_running(settings, redis_process, tmp_path / "a.log") as first,
        api_running(settings, redis_process, tmp_path / "b.log") as second,
        second.client() as client,
    ):
        killed = first.process
        with first.client() as doomed, pytest.raises(httpx.TransportError):
            doomed.post("/v1/jobs", content=halting(), headers=headers)
        body = part + tracks + b"\r\n--x--\r\n"
        answer = client.post("/v1/jobs", content=body, headers=headers)
        problem(answer, "submission-in-progress", 409)
        deadline = time.monotonic() + 3 * CLAIM_SECONDS
        while answer.status_code == 409:
            assert time.monotonic() < deadline
            time.sleep(float(answer.headers["Retry-After"]))
            answer = client.post("/v1/jobs", content=body, headers=headers)
        assert answer.status_code == 201
        assert "Idempotent-Replayed" not in answer.headers
        assert len(jobs(client)) == 1


class LosingAnswers(httpx.BaseTransport):
    """Loses the answers to the first submissions, after they have had their effect."""

    def __init__(self, lost: int) -> None:
        self.lost = lost
        self.sent = 0
        self._inner = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self._inner.handle_request(request)
        if request.method == "POST" and request.url.path == "/v1/jobs":
            self.sent += 1
            if self.sent <= self.lost:
                answer.read()
                raise httpx.ReadError("the connection broke", request=request)
        return answer


def test_the_client_submits_once_whatever_answers_are_lost(
    api: Api, tracks: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "w.npy"
    path.write_bytes(tracks)
    transport = LosingAnswers(2)
    with Client(api.url, transport=transport) as client:
        before = {job.id for job in client.list()}
        job = client.submit(path)
        assert transport.sent == 3
        assert {found.id for found in client.list()} - before == {job.id}
        assert client.wait(job.id).status == "succeeded"


def test_a_replayed_answer_shows_the_job_as_it_is(client: httpx.Client, tracks: bytes) -> None:
    key = new_job_id()
    first = send(client, tracks, key=key)
    done = finished(client, first)
    again = send(client, tracks, key=key)
    assert (again.json()["status"], again.json()["id"]) == ("succeeded", done["id"])


# The steps in Redis


@pytest.fixture
def store(redis_process: RedisProcess, redis_url: str) -> RecordStore:
    assert redis_url
    return RecordStore(redis_process.client(), result_ttl=3600)


def bound(name: str = "k", fingerprint: str = "f", seconds: float = 60) -> IdempotencyKey:
    return IdempotencyKey(name, fingerprint, seconds)


def test_a_claim_is_one_submission_s(store: RecordStore) -> None:
    first, second = JobRecord.new(options={}, inputs={}), JobRecord.new(options={}, inputs={})
    assert store.claim("k", first.id, 60).state == "ok"
    assert store.claim("k", first.id, 60).state == "ok"
    busy = store.claim("k", second.id, 60)
    assert busy.state == "busy"
    assert 0 < busy.seconds <= 60
    store.unclaim("k", second.id)  # not its own
    with pytest.raises(KeyTaken):
        store.create(second, key=bound())
    assert store.get(second.id) is None
    store.create(first, key=bound())
    found = store.claim("k", second.id, 60)
    assert (found.state, found.job, found.fingerprint) == ("bound", first.id, "f")
    store.unclaim("k", first.id)  # too late
    assert store.claim("k", second.id, 60).state == "bound"


def test_a_claim_that_lapsed_may_be_taken_or_bound(store: RecordStore) -> None:
    first, second = JobRecord.new(options={}, inputs={}), JobRecord.new(options={}, inputs={})
    store.claim("k", first.id, 0.01)
    store.claim("l", first.id, 0.01)
    time.sleep(0.03)
    assert store.claim("k", second.id, 60).state == "ok"
    with pytest.raises(KeyTaken):
        store.create(first, key=bound())
    store.create(first, key=bound("l"))
    assert store.claim("l", second.id, 60).state == "bound"


def test_a_key_is_forgotten_in_time(store: RecordStore) -> None:
    record = JobRecord.new(options={}, inputs={})
    store.create(record, key=bound(seconds=0.05))
    time.sleep(0.08)
    assert store.claim("k", new_job_id(), 60).state == "ok"


def test_giving_up_a_claim_frees_the_key(store: RecordStore) -> None:
    job_id = new_job_id()
    store.claim("k", job_id, 60)
    store.unclaim("k", job_id)
    assert store.redis.keys("*") == []
