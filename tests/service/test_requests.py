from __future__ import annotations

import gzip
import itertools
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from tests.conftest import clean_environment, serving
from tests.service.conftest import Api, finished, npy, problem, submit, wait_for

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from smsr.synthetic import Example


def lines_of(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]


def test_an_id_is_kept_or_made_and_is_in_every_answer(idle_api: Api) -> None:
    with idle_api.client() as client:
        for given in ("abc-1.2:3", "a" * 128):
            headers = {"X-Request-ID": given}
            for path in ("/v1/jobs", "/healthz", "/nothing", "/docs", "/v1/jobs/" + "0" * 32):
                assert client.get(path, headers=headers).headers["X-Request-ID"] == given
            assert (
                client.request("TRACE", "/v1/jobs", headers=headers).headers["X-Request-ID"]
                == given
            )
        made = set()
        for bad in (b"", b"a" * 129, b"a b", b"{}", b"-a", "ä".encode()):
            answer = client.get("/v1/jobs", headers=[(b"X-Request-ID", bad)])
            found = answer.headers["X-Request-ID"]
            assert len(found) == 32
            assert set(found) <= set("0123456789abcdef")
            made.add(found)
        assert len(made) == 6


def test_the_access_log(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        headers = {"X-Request-ID": "edge-7"}
        sent = client.post("/v1/jobs", files={"measurements": ("w.npy", tracks)}, headers=headers)
        assert sent.status_code == 201
        client.get("/v1/jobs/nonsense?secret=1", headers=headers)
        client.get("/healthz", headers=headers)
    found = [line for line in lines_of(idle_api.log) if line.get("request") == "edge-7"]
    accepted, first, second = found
    assert (accepted["event"], accepted["job"]) == ("job accepted", sent.json()["id"])
    assert (first["event"], first["method"], first["route"]) == ("request", "POST", "/v1/jobs")
    assert (first["status"], first["owner"]) == (201, None)
    assert len(tracks) < first["received"] < len(tracks) + 1000
    assert first["sent"] == len(sent.content)
    assert 0 < first["seconds"] < 60
    assert (second["status"], second["route"]) == (422, "/v1/jobs/{job_id}")
    assert "secret" not in idle_api.log.read_text()


def test_an_error_nobody_foresaw_is_in_the_log_and_not_in_the_answer(idle_api: Api) -> None:
    with idle_api.client() as client:
        sent = submit(client, {"measurements": ("w.npy", npy_of_nothing())})
        assert sent.status_code == 201
        redis, job_id = idle_api.redis.client(), sent.json()["id"]
        redis.hset(f"smsr:job:{job_id}", "options", "no json")
        answer = client.get(f"/v1/jobs/{job_id}", headers={"X-Request-ID": "bad-1"})
        redis.delete(f"smsr:job:{job_id}")
    problem(answer, "internal", 500)
    assert answer.headers["X-Request-ID"] == "bad-1"
    wait_for(lambda: any("exception" in line for line in lines_of(idle_api.log)))
    logged = [line for line in lines_of(idle_api.log) if line.get("request") == "bad-1"]
    assert {line["event"] for line in logged} >= {"request"}
    assert any("JSONDecodeError" in line.get("exception", "") for line in logged)


def npy_of_nothing() -> bytes:
    import numpy as np

    return npy(np.random.default_rng(0).normal(size=(20, 8)))


class Receiver:
    """Takes traces as an OpenTelemetry collector does."""

    def __init__(self) -> None:
        self.spans: list[tuple[str, Any]] = []
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import (
                    ExportTraceServiceRequest,
                )

                body = self.rfile.read(int(self.headers["Content-Length"]))
                if self.headers.get("Content-Encoding") == "gzip":
                    body = gzip.decompress(body)
                for resource in ExportTraceServiceRequest.FromString(body).resource_spans:
                    attributes = {a.key: a.value.string_value for a in resource.resource.attributes}
                    for scope in resource.scope_spans:
                        for span in scope.spans:
                            receiver.spans.append((attributes["service.name"], span))
                self.send_response(200)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def named(self, name: str) -> list[tuple[str, Any]]:
        return [found for found in self.spans if found[1].name == name]


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http", reason="needs smsr[otel]")
    found = Receiver()
    yield found
    found.server.shutdown()
    found.server.server_close()


def test_one_id_and_one_trace_follow_a_job_to_its_worker(
    tmp_path: Path, receiver: Receiver, example: Example, tracks: bytes
) -> None:
    environment = clean_environment(
        OTEL_EXPORTER_OTLP_ENDPOINT=receiver.url, OTEL_BSP_SCHEDULE_DELAY="100"
    )
    trace, parent = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
    with (
        serving(tmp_path, "--workers", "1", environment=environment) as server,
        httpx.Client(base_url=server.url, timeout=60) as client,
    ):
        sent = client.post(
            "/v1/jobs",
            files={
                "measurements": ("w.npy", tracks),
                "ground_truth": ("s.npy", npy(example.ground_truth)),
            },
            headers={"X-Request-ID": "edge-9", "traceparent": f"00-{trace}-{parent}-01"},
        )
        job = finished(client, sent)
        assert job["status"] == "succeeded"
        wait_for(lambda: receiver.named("run job") and receiver.named("POST /v1/jobs"))
    logged = [line for line in lines_of(server.log) if line.get("request") == "edge-9"]
    events = [line["event"] for line in logged]
    for event in ("job accepted", "request", "attempt began", "attempt ended"):
        assert event in events
    assert {line["trace"] for line in logged} == {trace}

    ((service, request),) = receiver.named("POST /v1/jobs")
    ((_, submission),) = receiver.named("submit job")
    ((worker, run),) = receiver.named("run job")
    assert (service, worker) == ("smsr-api", "smsr-worker")
    chain = [request, submission, run]
    assert {span.trace_id.hex() for span in chain} == {trace}
    assert [span.parent_span_id.hex() for span in chain] == [
        parent,
        request.span_id.hex(),
        submission.span_id.hex(),
    ]
    stages = [s for _, s in receiver.spans if s.parent_span_id == run.span_id]
    assert {span.name for span in stages} == set(job["timings"]) - {"queued", "total"}
    order = sorted(stages, key=lambda span: span.start_time_unix_nano)
    for before, after in itertools.pairwise(order):
        assert before.end_time_unix_nano <= after.start_time_unix_nano
    assert not receiver.named("GET /healthz")


def test_without_the_variables_nothing_of_opentelemetry_is_loaded() -> None:
    import subprocess
    import sys

    program = (
        "import sys\n"
        "from worker.tracing import Tracing, preload\n"
        "preload()\n"
        "tracing = Tracing('x')\n"
        "with tracing.span('a', job='b') as span:\n"
        "    assert span.traceparent is span.trace_id is None\n"
        "assert not any(name.startswith('opentelemetry') for name in sys.modules)\n"
    )
    kept = {k: v for k, v in clean_environment().items() if not k.startswith("OTEL_")}
    subprocess.run([sys.executable, "-c", program], check=True, env=kept)
