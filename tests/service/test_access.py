from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from fastapi.routing import iter_route_contexts
from starlette.routing import Mount

from service.access import PUBLIC, policy_for
from service.app import create_app
from smsr_client import Client
from tests.conftest import clean_environment, redis_running, serving
from tests.service.conftest import (
    Api,
    api_running,
    npy,
    problem,
    settings_for,
    submit,
    wait_for,
)
from worker.keys import KeyStore
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from tests.conftest import Served


@dataclass(frozen=True)
class Guarded:
    """An API that needs keys, without workers."""

    api: Api

    @property
    def keys(self) -> KeyStore:
        return KeyStore(self.api.redis.client())

    def client(self, owner: str, **limits: Any) -> httpx.Client:
        """A client with a new key."""
        _, key = self.keys.create(owner, **limits)
        return self.api.client(headers={"Authorization": f"Bearer {key}"})


@pytest.fixture(scope="module")
def guarded_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    folder = tmp_path_factory.mktemp("guarded")
    with redis_running(folder) as redis:
        settings = settings_for(
            folder,
            redis,
            access="keys",
            event_heartbeat_seconds=0.3,
            metrics_token="a-token-for-metrics",
            cors_origins="https://app.example.org, https://b.example.org",
        )
        with api_running(settings, redis, folder / "api.log") as api:
            yield api


@pytest.fixture
def guarded(guarded_server: Api) -> Guarded:
    guarded_server.redis.client().flushall()
    for folder in ("uploads", "results"):
        shutil.rmtree(guarded_server.objects / folder, ignore_errors=True)
    return Guarded(guarded_server)


@pytest.fixture
def files() -> dict[str, tuple[str, bytes]]:
    return {"measurements": ("t.npy", npy(np.random.default_rng(0).normal(size=(12, 9))))}


@pytest.fixture
def anyone(guarded: Guarded) -> Iterator[httpx.Client]:
    with guarded.api.client() as client:
        yield client


def test_without_a_key_nothing_is_told(anyone: httpx.Client) -> None:
    for path in ("/v1/jobs", "/v1/jobs/" + "0" * 32, "/v1/nothing", "/v1"):
        document = problem(answer := anyone.get(path), "unauthorized", 401)
        assert answer.headers["www-authenticate"] == 'Bearer realm="smsr"'
        assert "smsr_" in document["detail"]
    answer = anyone.post("/v1/jobs", content=b"x" * 1_000_000)
    problem(answer, "unauthorized", 401)


def test_a_key_is_given_in_either_header(guarded: Guarded, anyone: httpx.Client) -> None:
    _, key = guarded.keys.create("ann")
    for headers in (
        {"Authorization": f"Bearer {key}"},
        {"Authorization": f"bearer {key}"},
        {"X-API-Key": key},
    ):
        assert anyone.get("/v1/jobs", headers=headers).json() == {"jobs": [], "next": None}
    for headers in (
        {"Authorization": f"Basic {key}"},
        {"Authorization": f"Bearer {key[:-1]}"},
        {"Authorization": "Bearer x"},
        {"X-API-Key": "smsr_0_1"},
    ):
        problem(anyone.get("/v1/jobs", headers=headers), "unauthorized", 401)
    answer = anyone.get(f"/v1/jobs?api_key={key}")
    problem(answer, "unauthorized", 401)


def test_a_revoked_key_is_refused_at_once(guarded: Guarded) -> None:
    made, key = guarded.keys.create("ann")
    with guarded.api.client(headers={"X-API-Key": key}) as client:
        assert client.get("/v1/jobs").status_code == 200
        guarded.keys.revoke(made.id)
        answer = client.get("/v1/jobs")
        problem(answer, "unauthorized", 401)
        assert answer.headers["www-authenticate"] == 'Bearer realm="smsr", error="invalid_token"'


def test_a_key_is_good_until_its_time_is_over(guarded: Guarded) -> None:
    _, key = guarded.keys.create("ann", expires_at=time.time() + 1.5)
    with guarded.api.client(headers={"X-API-Key": key}) as client:
        assert client.get("/v1/jobs").status_code == 200
        wait_for(lambda: client.get("/v1/jobs").status_code == 401)
        document = problem(client.get("/v1/jobs"), "unauthorized", 401)
        assert "is over" in document["detail"]
        # Who does not know the key learns nothing of it.
        other = client.get("/v1/jobs", headers={"X-API-Key": key[:-1] + "x"})
        assert "is over" not in problem(other, "unauthorized", 401)["detail"]
    assert guarded.keys.list()[0].expired(time.time())


@pytest.mark.parametrize("how", ["revoked", "expired"])
def test_a_stream_ends_with_its_key(guarded: Guarded, how: str) -> None:
    made, key = guarded.keys.create("ann", expires_at=time.time() + 2 if how == "expired" else None)
    began = time.monotonic()
    with (
        guarded.api.client(headers={"X-API-Key": key}) as client,
        client.stream("GET", "/v1/events") as answer,
    ):
        lines = answer.iter_lines()
        assert any("refresh" in line for line in lines)
        if how == "revoked":
            guarded.keys.revoke(made.id)
        assert all(line.startswith((":", "data")) for line in lines if line)
    assert time.monotonic() - began < 10


def test_streams_are_limited_key_by_key(guarded: Guarded) -> None:
    with (
        guarded.client("ann", streams=2) as ann,
        guarded.client("ann") as other,
        contextlib.ExitStack() as open_,
    ):
        for _ in range(2):
            answer = open_.enter_context(ann.stream("GET", "/v1/events"))
            assert answer.status_code == 200
        refused = ann.get("/v1/events")
        assert problem(refused, "too-many-streams", 429)["limit"] == 2
        assert int(refused.headers["Retry-After"]) > 0
        with other.stream("GET", "/v1/events") as answer:
            assert answer.status_code == 200
        assert other.head("/v1/events").status_code == 200
        assert "never awaited" not in guarded.api.log.read_text()
        open_.close()

        def again() -> bool:
            with ann.stream("GET", "/v1/events") as answer:
                return answer.status_code == 200

        wait_for(again)


def test_all_keys_of_an_owner_see_its_jobs(
    guarded: Guarded, files: dict[str, tuple[str, bytes]]
) -> None:
    with guarded.client("ann") as one, guarded.client("ann") as two, guarded.client("bob") as other:
        job = submit(one, files).json()
        assert two.get(f"/v1/jobs/{job['id']}").json()["id"] == job["id"]
        assert [j["id"] for j in two.get("/v1/jobs").json()["jobs"]] == [job["id"]]
        assert other.get("/v1/jobs").json()["jobs"] == []
        problem(other.get(f"/v1/jobs/{job['id']}"), "unknown-job", 404)


# Every route, with the ids of another owner

Files = dict[str, tuple[str, bytes]]
NEVER = "f" * 32
FREE = {
    "frame": "0",
    "slug": "internal",
    "array": "shapes",
    "role": "measurements",
    "name": "cameras",
    "form": "png",
}
"""Parameters of paths that name nothing of an owner."""

TUS = {
    "Tus-Resumable": "1.0.0",
    "Upload-Offset": "0",
    "Upload-Length": "8",
    "Content-Type": "application/offset+octet-stream",
    "X-HTTP-Method-Override": "PATCH",
}


def make_job(client: httpx.Client, files: Files) -> str:
    return str(submit(client, files).json()["id"])


def make_upload(client: httpx.Client, files: Files) -> str:
    answer = client.post("/v1/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "800"})
    assert answer.status_code == 201, answer.text
    return answer.headers["Location"].rpartition("/")[2]


def make_batch(client: httpx.Client, files: Files) -> str:
    answer = client.post("/v1/jobs", files=files, data={"batch": "a-batch-of-ann"})
    assert answer.status_code == 201, answer.text
    return "a-batch-of-ann"


OWNED = {"job_id": make_job, "upload_id": make_upload, "label": make_batch}
"""Parameters of paths that name something of an owner, and how one is made."""

UNSEEN = {"job_id": NEVER, "upload_id": NEVER, "label": "never"}
OWN_NAMES = frozenset({("PUT", "/v1/uploads/{upload_id}")})
"""What makes a thing under a name of the client's own, which others may use as well."""
BLIND = frozenset({"OPTIONS"})
"""Methods that may answer alike whether there is anything or not."""


@dataclass(frozen=True)
class Operation:
    method: str
    template: str
    parameters: tuple[str, ...]

    @property
    def owned(self) -> tuple[str, ...]:
        return tuple(name for name in self.parameters if name not in FREE)

    def url(self, values: Mapping[str, str]) -> str:
        return self.template.format(**{**FREE, **values})


def operations() -> list[Operation]:
    """Every method of every route of the application, with nothing left out."""
    found = []
    routes = create_app(Settings(redis_url="redis://localhost")).routes
    for context in iter_route_contexts(routes):
        if isinstance(context.route, Mount):
            assert context.path == "/static-offline-docs"
            continue
        template = re.sub(r":\w+\}", "}", context.path or "")
        names = tuple(re.findall(r"\{(\w+)\}", template))
        unknown = set(names) - FREE.keys() - OWNED.keys()
        assert not unknown, f"{template}: say in this file how {unknown} are filled"
        assert context.methods, context
        found += [Operation(method, template, names) for method in sorted(context.methods)]
    return found


def reduced(answer: httpx.Response, values: Mapping[str, str]) -> tuple[object, ...]:
    """What an answer says, without the ids and what differs from one request to the next."""
    text = answer.text
    for value in values.values():
        text = text.replace(value, "ID")
    volatile = ("date", "ratelimit", "content-length", "x-request-id")
    headers = {k: v for k, v in answer.headers.items() if k not in volatile}
    return answer.status_code, text, headers


def ask(client: httpx.Client, operation: Operation, values: Mapping[str, str]) -> httpx.Response:
    """Make a request that would do all it can; of an endless stream take the beginning."""
    headers = TUS if "upload_id" in operation.parameters else {}
    body = b"x" * 8 if operation.method in ("PUT", "PATCH", "POST") else None
    url = operation.url(values)
    endless = operation.template.endswith("/events")
    began, text = time.monotonic(), bytearray()
    with client.stream(operation.method, url, headers=headers, content=body) as answer:
        for chunk in answer.iter_raw():
            text += chunk
            if endless and time.monotonic() - began > 1.0:  # signs of life come all the time
                break
    return httpx.Response(
        answer.status_code, headers=answer.headers, content=bytes(text), request=answer.request
    )


def state_of(api: Api) -> dict[bytes, object]:
    """All that is stored, but for what counts requests and times."""
    redis = api.redis.client()
    kept: dict[bytes, object] = {name.encode(): None for name in api.stored()}
    for key in redis.scan_iter():
        if not key.startswith((b"smsr:rate", b"smsr:looking", b"smsr:orphans", b"smsr:maintained")):
            # The dump of a hash has its fields in any order.
            kept[key] = redis.hgetall(key) if redis.type(key) == b"hash" else redis.dump(key)
    return kept


def test_no_route_shows_or_changes_what_is_anothers(guarded: Guarded, files: Files) -> None:
    walked = 0
    unlimited = {"requests_per_minute": 0}
    with guarded.client("ann", **unlimited) as ann, guarded.client("bob", **unlimited) as bob:
        every = operations()
        needed = {name for operation in every for name in operation.owned}
        values = {name: OWNED[name](ann, files) for name in needed}
        before = state_of(guarded.api)
        for operation in every:
            if (operation.method, operation.template) in OWN_NAMES:
                continue
            if operation.owned:
                answer = ask(bob, operation, values)
                never = ask(bob, operation, UNSEEN)
                assert reduced(answer, values) == reduced(never, UNSEEN), operation
                if operation.method not in BLIND:
                    assert answer.status_code == 404, (operation, answer.text)
                walked += 1
            else:
                answer = ask(bob, operation, values)
                for value in values.values():
                    assert value not in answer.text, operation
            assert answer.status_code < 500, operation
        assert state_of(guarded.api) == before
        assert walked >= 18
        # That the ids were good ones:
        for operation in every:
            if operation.owned and operation.method == "GET":
                own = ask(ann, operation, values)
                assert own.status_code != 404 or "unknown-job" not in own.text, operation


def test_one_id_of_two_owners_is_two_uploads(guarded: Guarded, files: Files) -> None:
    name, content = files["measurements"]
    with guarded.client("ann") as ann, guarded.client("bob") as bob:
        place = f"/v1/uploads/{make_upload(ann, files)}"
        before = ann.get(place).json()
        put = bob.put(place, content=content, params={"name": name})
        assert put.status_code == 201
        assert bob.delete(place).status_code == 204
        assert ann.get(place).json() == before
        body = {"measurements": {"upload": place.rpartition("/")[2]}}
        problem(bob.post("/v1/jobs", json=body), "unknown-upload", 404)


def test_without_a_key_only_what_is_public_answers(guarded: Guarded, files: Files) -> None:
    public = {"/", "/docs", "/healthz", "/openapi.json", "/problems", "/problems/{slug}", "/readyz"}
    public |= {"/assets/{name}", *PUBLIC}
    with guarded.client("ann") as ann, guarded.api.client() as anyone:
        values = {name: OWNED[name](ann, files) for o in operations() for name in o.owned}
        before = state_of(guarded.api)
        for operation in operations():
            answer = ask(anyone, operation, values)
            if operation.template in public:
                assert answer.status_code not in (401, 500), operation
            else:
                assert answer.status_code == 401, operation
        assert state_of(guarded.api) == before


# Limits


def test_requests_are_limited_key_by_key(guarded: Guarded) -> None:
    with guarded.client("ann", requests_per_minute=3) as one, guarded.client("ann") as other:
        left = []
        for _ in range(3):
            answer = one.get("/v1/jobs")
            assert answer.status_code == 200
            assert answer.headers["RateLimit-Policy"] == '"requests";q=3;w=60'
            found = re.fullmatch(r'"requests";r=(\d+);t=(\d+)', answer.headers["RateLimit"])
            assert found
            left.append(int(found[1]))
            assert 1 <= int(found[2]) <= 60
        assert left == [2, 1, 0]
        answer = one.get("/v1/jobs/" + NEVER)
        document = problem(answer, "too-many-requests", 429)
        assert document["limit"] == 3
        assert 1 <= int(answer.headers["Retry-After"]) <= 60
        assert answer.headers["RateLimit"].startswith('"requests";r=0;')
        assert other.get("/v1/jobs").headers["RateLimit-Policy"] == '"requests";q=600;w=60'
        assert one.get("/v1/info").status_code == 200
    with guarded.client("ann", requests_per_minute=0) as unlimited:
        assert "RateLimit" not in unlimited.get("/v1/jobs").headers


def test_jobs_are_limited_owner_by_owner(guarded: Guarded, files: Files) -> None:
    with guarded.client("ann", jobs=1) as ann, guarded.client("bob", jobs=1) as bob:
        job = submit(ann, files).json()
        answer = submit(ann, files)
        assert problem(answer, "too-many-jobs", 429)["limit"] == 1
        assert int(answer.headers["Retry-After"]) > 0
        assert submit(bob, files).status_code == 201
        ann.post(f"/v1/jobs/{job['id']}/cancel")
        assert submit(ann, files).status_code == 201
        answer = ann.post(f"/v1/jobs/{job['id']}/retry")
        problem(answer, "too-many-jobs", 429)
        assert len(guarded.api.stored()) == 3


def test_bytes_are_limited_owner_by_owner(guarded: Guarded) -> None:
    big = {"measurements": ("t.npy", npy(np.random.default_rng(0).normal(size=(100, 1000))))}
    records_of = guarded.api.redis.client()
    with guarded.client("ann", stored_bytes=2_000_000) as ann, guarded.client("bob") as bob:
        first = submit(ann, big)
        assert first.status_code == 201
        assert submit(ann, big).status_code == 201
        answer = submit(ann, big)
        assert problem(answer, "too-many-bytes", 507)["limit"] == 2_000_000
        assert int(answer.headers["Retry-After"]) > 0
        assert submit(bob, big).status_code == 201
        assert ann.delete(first.headers["Location"]).status_code == 204
        assert submit(ann, big).status_code == 201
        stored = int(records_of.hget("smsr:stored", "ann") or 0)
        assert stored == 2 * len(big["measurements"][1])
        assert not list(records_of.scan_iter("smsr:hold:*"))


def test_an_upload_of_unknown_length_is_limited_too(guarded: Guarded) -> None:
    head = npy(np.zeros((100, 40_000)))[:128]
    sent = 0

    def body() -> Iterator[bytes]:
        nonlocal sent
        yield (
            b'--xx\r\nContent-Disposition: form-data; name="measurements"; filename="t.npy"\r\n\r\n'
        ) + head
        for _ in range(28):
            time.sleep(0.01)
            sent += 1
            yield b"\0" * (1 << 20)
        yield b"\r\n--xx--\r\n"

    with guarded.client("ann", stored_bytes=4 << 20) as ann:
        kind = {"Content-Type": "multipart/form-data; boundary=xx"}
        problem(ann.post("/v1/jobs", content=body(), headers=kind), "too-many-bytes", 507)
    assert not guarded.api.stored()
    assert not guarded.api.redis.client().hgetall("smsr:stored")


def test_uploads_on_their_own_are_held_until_they_are_a_job(guarded: Guarded) -> None:
    redis = guarded.api.redis.client()
    content = npy(np.random.default_rng(0).normal(size=(100, 1000)))
    size = len(content)
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": str(size)}

    def stored() -> int:
        return int(redis.hget("smsr:stored", "ann") or 0)

    with guarded.client("ann", stored_bytes=2 * size + 1000, jobs=1) as ann:
        put = f"/v1/uploads/{NEVER}"
        assert ann.put(put, content=content, params={"name": "t.npy"}).status_code == 201
        assert ann.put(put, content=content, params={"name": "t.npy"}).status_code == 200
        first = ann.post("/v1/uploads", headers=tus).headers["Location"]
        assert stored() == 2 * size
        problem(ann.post("/v1/uploads", headers=tus), "too-many-bytes", 507)
        other = "/v1/uploads/" + "e" * 32
        problem(ann.put(other, content=content), "too-many-bytes", 507)
        problem(ann.put(other, content=iter([content])), "too-many-bytes", 507)
        assert stored() == 2 * size
        assert ann.delete(first).status_code == 204
        assert stored() == size
        body = {"measurements": {"upload": NEVER}}
        job = ann.post("/v1/jobs", json=body)
        assert job.status_code == 201, job.text
        assert stored() == size
        assert not list(redis.scan_iter("smsr:hold:*"))
        assert ann.delete(job.headers["Location"]).status_code == 204
        assert stored() == 0


def test_uploads_of_a_refused_job_are_not_lost(guarded: Guarded, files: Files) -> None:
    name, content = files["measurements"]
    with guarded.client("ann", stored_bytes=0) as ann, guarded.client("ann", jobs=1) as limited:
        submit(ann, files)
        place = "/v1/uploads/" + "e" * 32
        assert ann.put(place, content=content, params={"name": name}).status_code == 201
        body = {"measurements": {"upload": "e" * 32}}
        problem(limited.post("/v1/jobs", json=body), "too-many-jobs", 429)
        assert ann.post("/v1/jobs", json=body).status_code == 201


def test_a_refused_upload_is_held_no_longer(guarded: Guarded) -> None:
    with guarded.client("ann") as ann:
        refused = submit(ann, {"measurements": ("t.npy", npy(np.zeros((5, 9))))})
        problem(refused, "odd-row-count", 422)
    assert not guarded.api.redis.client().hgetall("smsr:stored")


# What is told to whom


def test_metrics_and_readiness_tell_nothing_of_jobs(guarded: Guarded, files: Files) -> None:
    with guarded.client("ann") as ann, guarded.api.client() as anyone:
        submit(ann, files)
        assert anyone.get("/readyz").json()["queued"] is None
        for client in (ann, anyone):
            answer = client.get("/metrics")
            problem(answer, "unauthorized", 401)
        for method in ("POST", "TRACE"):
            problem(anyone.request(method, "/metrics"), "method-not-allowed", 405)
        token = {"Authorization": "Bearer a-token-for-metrics"}
        assert 'smsr_jobs{status="queued"} 1.0' in anyone.get("/metrics", headers=token).text


def test_what_redis_holds_opens_nothing(guarded: Guarded, files: Files) -> None:
    _, key = guarded.keys.create("ann")
    with guarded.api.client(headers={"X-API-Key": key}) as client:
        submit(client, files)
    secret = key.split("_")[2].encode()
    assert secret not in (guarded.api.redis.folder / "redis.log").read_bytes()
    for path in guarded.api.redis.folder.rglob("*.aof"):
        assert secret not in path.read_bytes()
    assert secret.decode() not in guarded.api.log.read_text()


# The open mode


@pytest.mark.parametrize(
    ("access", "address", "policy"),
    [
        ("auto", "127.0.0.1", "loopback"),
        ("auto", "127.8.8.8", "loopback"),
        ("auto", "::1", "loopback"),
        ("auto", "0.0.0.0", "keys"),
        ("auto", "::", "keys"),
        ("auto", "10.0.0.1", "keys"),
        ("auto", None, "keys"),
        ("open", "0.0.0.0", "open"),
        ("open", None, "open"),
        ("keys", "127.0.0.1", "keys"),
    ],
)
def test_who_may_come(access: str, address: str | None, policy: str) -> None:
    settings = Settings(redis_url="redis://localhost", access=access)  # type: ignore[arg-type]
    assert policy_for(settings, address) == policy


@pytest.fixture(scope="module")
def local_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """``smsr serve`` on loopback, as it comes."""
    folder = tmp_path_factory.mktemp("local")
    with serving(folder, "--workers", "1", environment=clean_environment()) as served:
        yield served


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example.org"},
        {"Host": "localhost.evil.example.org"},
        {"X-Forwarded-For": "203.0.113.7"},
        {"Forwarded": "for=203.0.113.7"},
        {"Via": "1.1 proxy"},
        {"Sec-Fetch-Site": "cross-site", "Origin": "https://evil.example.org"},
    ],
)
def test_on_loopback_only_this_machine_needs_no_key(
    local_server: Served, headers: dict[str, str]
) -> None:
    jobs = f"{local_server.url}/v1/jobs"
    assert httpx.get(jobs).status_code == 200
    assert httpx.get(jobs, headers={"Host": "localhost:1234"}).status_code == 200
    assert httpx.get(jobs, headers={"Authorization": "Basic YTpi"}).status_code == 200
    problem(httpx.get(jobs, headers=headers), "unauthorized", 401)


def smsr(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *arguments],
        capture_output=True,
        text=True,
        env=clean_environment(**environment),
        timeout=120,
        check=False,
    )


def test_keys_are_made_while_the_service_runs(local_server: Served) -> None:
    folder = ("--data-dir", str(local_server.data_dir))
    made = smsr(
        *("keys", "create", "ann", "--note", "x", "--storage", "20GiB", "--expires", "2d"), *folder
    )
    assert made.returncode == 0, made.stderr
    key = made.stdout.strip()
    key_id = key.split("_")[1]
    assert key_id in made.stderr
    listed = smsr("keys", "list", "--json", *folder).stdout
    (known,) = json.loads(listed)
    assert known["stored_bytes"] == 20 << 30
    assert known["expires_at"] - known["created_at"] == pytest.approx(2 * 86400, abs=60)
    for when in ("yesterday", "2020-01-01", "0d"):
        assert smsr("keys", "create", "ann", "--expires", when, *folder).returncode == 2
    assert key.split("_")[2] not in listed
    elsewhere = {"Host": "smsr.example.org"}
    with Client(local_server.url, api_key=key) as client:
        assert list(client.list()) == []
    given = httpx.get(
        f"{local_server.url}/v1/jobs", headers=elsewhere | {"Authorization": f"Bearer {key}"}
    )
    assert given.status_code == 200
    assert smsr("keys", "revoke", key_id, *folder).returncode == 0
    listing = smsr("jobs", "list", "--server", local_server.url, SMSR_API_KEY=key)
    assert listing.returncode == 1
    assert "may have been revoked" in listing.stderr
    assert smsr("keys", "revoke", key_id, *folder).returncode == 1


def test_off_loopback_keys_are_needed_and_it_says_how(tmp_path: Path) -> None:
    folder = ("--data-dir", str(tmp_path / "data"))
    key = ""
    for turn in range(2):
        with serving(
            tmp_path, "--workers", "0", "--host", "0.0.0.0", environment=clean_environment()
        ) as served:
            problem(httpx.get(f"{served.url}/v1/jobs"), "unauthorized", 401)
            assert ("smsr keys create" in served.log.read_text()) == (turn == 0)
            if key:
                answer = httpx.get(f"{served.url}/v1/jobs", headers={"X-API-Key": key})
                assert answer.status_code == 200
        if not key:  # nothing serves the folder now
            key = smsr("keys", "create", "ann", *folder).stdout.strip()


# Headers


def check_headers(answer: httpx.Response) -> None:
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["x-frame-options"] == "DENY"
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "frame-ancestors 'none'" in policy
    script = re.search(r"script-src ([^;]*)", policy)
    assert "unsafe" not in (script[1] if script else "")
    for name in ("x-content-type-options", "content-security-policy", "cache-control"):
        assert len(answer.headers.get_list(name)) <= 1


def test_every_kind_of_answer_has_the_headers(guarded: Guarded, files: Files) -> None:
    with guarded.client("ann", requests_per_minute=0) as ann, guarded.api.client() as anyone:
        values = {name: OWNED[name](ann, files) for o in operations() for name in o.owned}
        statuses = set()
        for client in (ann, anyone):
            for operation in operations():
                answer = ask(client, operation, values)
                check_headers(answer)
                statuses.add(answer.status_code)
                if operation.template.startswith("/v1"):
                    assert answer.headers["cache-control"], operation
        assert {200, 401, 404} <= statuses
        assert ann.get("/v1/jobs").headers["cache-control"] == "no-store"
        for path in ("/nothing", "/v1/nothing", "/static-offline-docs/swagger-ui.css"):
            check_headers(ann.get(path))


def test_pages_name_their_inline_parts(guarded: Guarded) -> None:
    with guarded.api.client(headers={"Accept": "text/html"}) as anyone:
        for path in ("/docs", "/problems", "/problems/internal"):
            answer = anyone.get(path)
            check_headers(answer)
            inline = re.findall(r"<(script|style)>(.*?)</\1>", answer.text, re.DOTALL)
            assert inline
            for _, text in inline:
                digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
                assert f"'sha256-{digest}'" in answer.headers["content-security-policy"]


def test_an_unforeseen_error_has_them_too_and_no_trace(redis_url: str) -> None:
    app = create_app(Settings(redis_url=redis_url, access="open"))

    def broken() -> None:
        raise RuntimeError("/secret/path")

    app.add_api_route("/v1/broken", broken)

    async def answer() -> httpx.Response:
        async with app.router.lifespan_context(app):
            transport = httpx.ASGITransport(app, raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
                return await client.get("/v1/broken")

    failed = asyncio.run(answer())
    problem(failed, "internal", 500)
    check_headers(failed)
    assert failed.headers["cache-control"] == "no-store"
    assert "secret" not in failed.text


def test_other_origins_are_named_or_refused(guarded: Guarded, idle_api: Api) -> None:
    asked = {
        "Access-Control-Request-Method": "PATCH",
        "Access-Control-Request-Headers": "X-API-Key",
    }
    with guarded.api.client() as client:
        for origin in ("https://app.example.org", "https://b.example.org"):
            answer = client.options("/v1/jobs", headers={"Origin": origin, **asked})
            assert answer.status_code == 200
            assert answer.headers["access-control-allow-origin"] == origin
            assert "x-api-key" in answer.headers["access-control-allow-headers"].lower()
            check_headers(answer)
            # A page must be able to read why it was refused.
            assert (
                "access-control-allow-origin"
                in client.get("/v1/jobs", headers={"Origin": origin}).headers
            )
        evil = client.options("/v1/jobs", headers={"Origin": "https://evil.example.org", **asked})
        assert "access-control-allow-origin" not in evil.headers
    with idle_api.client() as client:
        answer = client.get("/v1/jobs", headers={"Origin": "https://app.example.org"})
        assert not [name for name in answer.headers if name.startswith("access-control")]
