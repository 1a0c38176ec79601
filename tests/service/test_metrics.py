"""What Prometheus reads, from two API processes that share a Redis server and a worker."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import httpx
import numpy as np
import pytest
from prometheus_client import parser
from prometheus_client.openmetrics.parser import text_string_to_metric_families as read_openmetrics

from service.metrics import JOB_STAGES, MeasuredRequests, RequestMetrics
from service.problems import JOB_PROBLEMS
from tests.conftest import redis_running
from tests.docker.test_monitoring import documented
from tests.service.conftest import (
    Api,
    api_running,
    finished,
    npy,
    settings_for,
    submit,
    wait_for,
)
from worker.counters import BOUNDS
from worker.pool import WorkerPool
from worker.records import FINAL, PRIORITIES, STATUSES, JobRecord, RecordStore, new_job_id

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from prometheus_client import Metric
    from starlette.types import Message, Receive, Scope, Send

    from smsr.synthetic import Example

OF_ONE_PROCESS = ("smsr_http_requests", "smsr_http_request_seconds", "smsr_upload_bytes",
                  "smsr_download_bytes", "smsr_disk_free_bytes",
                  "smsr_disk_reserve_bytes")  # fmt: skip


@dataclass(frozen=True)
class Scrape:
    """The samples of one answer."""

    families: Mapping[str, Metric]

    def value(self, sample: str, **labels: str) -> float:
        """The sum of all samples of a name that have the labels."""
        return sum(
            found.value
            for family in self.families.values()
            for found in family.samples
            if found.name == sample and labels.items() <= found.labels.items()
        )

    def series(self) -> set[tuple[str, tuple[tuple[str, str], ...]]]:
        return {
            (sample.name, tuple(sorted(sample.labels.items())))
            for family in self.families.values()
            for sample in family.samples
        }

    def of_jobs(self) -> dict[str, object]:
        return {
            name: [(s.name, s.labels, s.value) for s in family.samples]
            for name, family in self.families.items()
            if name not in OF_ONE_PROCESS
        }


def scrape(api: Api) -> Scrape:
    answer = httpx.get(f"{api.url}/metrics", timeout=30)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = list(parser.text_string_to_metric_families(answer.text))
    assert len({family.name for family in families}) == len(families)
    return Scrape({family.name: family for family in families})


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, Api]]:
    """Two API processes and one worker."""
    folder = tmp_path_factory.mktemp("pair")
    with redis_running(folder) as redis:
        settings = settings_for(folder, redis)
        with (
            WorkerPool(settings, 1),
            api_running(settings, redis, folder / "a.log") as first,
            api_running(settings, redis, folder / "b.log") as second,
        ):
            yield first, second


def test_a_success_and_a_failure_are_counted_once_and_by_all(
    pair: tuple[Api, Api], example: Example, tracks: bytes
) -> None:
    first, second = pair
    before = scrape(first)
    spoilt = example.measurements.copy()
    spoilt[-1, -1] = np.nan
    with first.client() as client:
        good = finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
        assert good["status"] == "succeeded"
        bad = finished(client, submit(client, {"measurements": ("w.npy", npy(spoilt))}))
        assert bad["problem"]["type"] == "/problems/not-finite"
    after, other = scrape(first), scrape(second)
    assert after.of_jobs() == other.of_jobs()

    def grown(sample: str, **labels: str) -> float:
        return after.value(sample, **labels) - before.value(sample, **labels)

    assert [grown("smsr_jobs_finished_total", status=status) for status in FINAL] == [1, 1, 0]
    assert [grown("smsr_jobs", status=status) for status in STATUSES] == [0, 0, 1, 1, 0]
    assert grown("smsr_failures_total") == grown("smsr_failures_total", type="not-finite") == 1
    assert grown("smsr_job_wait_seconds_count") == 2
    assert grown("smsr_job_run_seconds_count", size="small") == 2
    assert grown("smsr_attempts_lost_total") == 0
    assert after.value("smsr_workers_alive") == after.value("smsr_up") == 1
    for priority in PRIORITIES:
        depth = after.value("smsr_queue_depth", queue=first.settings.queue, priority=priority)
        assert depth == 0
    for stage, seconds in good["timings"].items():
        if stage not in ("queued", "total"):
            assert grown("smsr_stage_seconds_count", stage=stage) == 1
            assert grown("smsr_stage_seconds_sum", stage=stage) == pytest.approx(seconds, abs=1e-5)
    assert grown("smsr_stage_seconds_count") == len(good["timings"]) - 2
    assert 0 < grown("smsr_job_run_seconds_sum") < 60


def test_a_last_step_that_is_sent_twice_counts_once(idle_api: Api) -> None:
    store = RecordStore(idle_api.redis.client())
    for end in ("publish", "fail", "fail"):
        job_id = new_job_id()
        store.create(JobRecord.new(job_id, options={}, inputs={}))
        attempt = store.begin_attempt(job_id, worker="ann", ticket="t", lease=60)
        assert attempt is not None
        for _ in range(2):
            if end == "publish":
                store.publish(job_id, attempt, frames=3, points=4, timings={"cameras": 700.0})
            else:
                store.fail(job_id, attempt, {"type": "/problems/time-limit"})
    found = scrape(idle_api)
    ends = [found.value("smsr_jobs_finished_total", status=status) for status in FINAL]
    assert ends == [1, 2, 0]
    assert found.value("smsr_failures_total", type="time-limit") == 2
    assert found.value("smsr_job_run_seconds_count", size="small") == 1
    assert found.value("smsr_job_run_seconds_count", size="unknown") == 2
    assert found.value("smsr_stage_seconds_bucket", stage="cameras", le="500.0") == 0
    assert found.value("smsr_stage_seconds_bucket", stage="cameras", le="1000.0") == 1
    assert found.value("smsr_stage_seconds_sum") == 700


def test_histograms_are_consistent(pair: tuple[Api, Api], tracks: bytes) -> None:
    with pair[1].client() as client:
        finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
    families = scrape(pair[1]).families.values()
    histograms = [family for family in families if family.type == "histogram"]
    assert len(histograms) == 4
    seen = 0
    for family in histograms:
        buckets: dict[tuple[str, ...], list[tuple[float, float]]] = {}
        rest: dict[tuple[str, ...], dict[str, float]] = {}
        for sample in family.samples:
            labels = tuple(v for k, v in sorted(sample.labels.items()) if k != "le")
            if sample.name.endswith("_bucket"):
                limit = float(sample.labels["le"])
                buckets.setdefault(labels, []).append((limit, sample.value))
            else:
                part = sample.name.removeprefix(family.name)
                rest.setdefault(labels, {})[part] = sample.value
        assert buckets.keys() == rest.keys()
        for labels, found in buckets.items():
            limits, counts = zip(*found, strict=True)
            assert list(limits) == sorted(set(limits))
            assert limits[-1] == float("inf")
            assert list(counts) == sorted(counts)
            assert set(rest[labels]) == {"_count", "_sum"}
            assert rest[labels]["_count"] == counts[-1]
            lows = [0.0, *limits[:-1]]
            each = np.diff([0.0, *counts])
            assert rest[labels]["_sum"] >= np.dot(each, lows) - 1e-6
            if each[-1] == 0:
                assert rest[labels]["_sum"] <= np.dot(each[:-1], limits[:-1]) + 1e-6
            seen += int(counts[-1])
    assert seen > 5


def test_what_is_told_is_what_is_documented(pair: tuple[Api, Api]) -> None:
    scrape(pair[0])
    found: dict[str, set[str]] = {}
    for family in scrape(pair[0]).families.values():
        assert family.documentation.endswith(".")
        for sample in family.samples:
            assert found.setdefault(sample.name, set(sample.labels)) == set(sample.labels)
    assert found == documented()


def test_series_begin_with_zero(idle_api: Api) -> None:
    """Prometheus sees no increase in a series that begins with 1."""
    found = scrape(idle_api)
    failures = {s.labels["type"] for s in found.families["smsr_failures"].samples}
    assert failures == JOB_PROBLEMS >= {"worker-lost", "internal", "not-finite"}
    stages = {s.labels["stage"] for s in found.families["smsr_stage_seconds"].samples}
    assert stages == set(JOB_STAGES)
    runs = found.families["smsr_job_run_seconds"].samples
    assert {s.labels["size"] for s in runs} == {"small", "medium", "large", "unknown"}
    assert len(runs) == 4 * (len(BOUNDS) + 3)
    assert found.value("smsr_jobs_finished_total") == found.value("smsr_failures_total") == 0


def test_labels_are_templates_and_their_number_does_not_grow(idle_api: Api) -> None:
    def ask_around(client: httpx.Client) -> None:
        job_id = new_job_id()
        for path in ("", "/result.npz", "/frames/17.ply", "/report.json", "/nothing", f"/{job_id}"):
            client.get(f"/v1/jobs/{job_id}{path}")
            client.head(f"/v1/jobs/{job_id}{path}?x={job_id}")
        client.get(f"/{job_id}")
        client.put("/v1/jobs")
        client.post(f"/v1/jobs/{job_id}/cancel")
        client.delete(f"/v1/jobs/{job_id}")
        client.get("/static-offline-docs/swagger-ui.css")

    with idle_api.client() as client:
        ask_around(client)
        scrape(idle_api)
        series = scrape(idle_api).series()
        before = scrape(idle_api)
        for _ in range(5):
            ask_around(client)
        after = scrape(idle_api)
        assert after.series() == series
        templates = set(client.get("/openapi.json").json()["paths"])
    labels = {s.labels["route"] for s in after.families["smsr_http_requests"].samples}
    assert labels <= templates | {"/openapi.json", "other"}
    assert "/v1/jobs/{job_id}/frames/{frame}.ply" in labels
    for route, method, status, count in (
        ("/v1/jobs/{job_id}", "HEAD", "422", 5),
        ("/v1/jobs/{job_id}", "DELETE", "404", 5),
        ("/v1/jobs", "PUT", "405", 5),
        ("other", "GET", "404", 15),
        ("other", "GET", "200", 5),
    ):
        which = {"route": route, "method": method, "status": status}
        grown = [s.value("smsr_http_requests_total", **which) for s in (before, after)]
        assert grown[1] - grown[0] == count, which


def test_bytes_are_counted_either_way(pair: tuple[Api, Api], tracks: bytes) -> None:
    api, other = pair
    elsewhere = scrape(other)
    before = scrape(api)
    with api.client() as client:
        job = finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
        wanted = [client.get(job["links"][which]) for which in ("result", "frames", "report")]
        client.head(job["links"]["result"])
        client.get(f"/v1/jobs/{job['id']}/frames/999.ply")  # an error is no result
        answer = client.get(job["links"]["result"], headers={"If-None-Match": "*"})
        assert answer.status_code == 304
    after = scrape(api)
    sent = [s.value("smsr_download_bytes_total") for s in (before, after)]
    assert sent[1] - sent[0] == sum(len(answer.content) for answer in wanted)
    taken = [s.value("smsr_upload_bytes_total") for s in (before, after)]
    assert len(tracks) < taken[1] - taken[0] < len(tracks) + 2000
    assert scrape(other).value("smsr_upload_bytes_total") == elsewhere.value(
        "smsr_upload_bytes_total"
    )


def test_openmetrics_for_who_asks(idle_api: Api) -> None:
    accept = "application/openmetrics-text;version=1.0.0,text/plain;version=0.0.4;q=0.5"
    with idle_api.client() as client:
        answer = client.get("/metrics", headers={"Accept": accept})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    families = read_openmetrics(answer.text)  # type: ignore[no-untyped-call]
    names = {family.name for family in families}
    assert names == set(scrape(idle_api).families)


def test_counts_outlive_redis_and_are_left_out_while_it_is_away(idle_api: Api) -> None:
    store = RecordStore(idle_api.redis.client())
    job_id = new_job_id()
    store.create(JobRecord.new(job_id, options={}, inputs={}))
    store.cancel(job_id)
    before = scrape(idle_api)
    idle_api.redis.kill()
    try:
        started = time.monotonic()
        away = scrape(idle_api)
        assert time.monotonic() - started < 10  # the usual time that Prometheus waits
        assert away.value("smsr_up") == 0
        assert set(away.families) == {"smsr_up", *OF_ONE_PROCESS}
        assert away.value("smsr_http_requests_total") > 0
    finally:
        idle_api.redis.start()
    wait_for(lambda: scrape(idle_api).value("smsr_up") == 1)
    assert scrape(idle_api).of_jobs() == before.of_jobs()
    assert before.value("smsr_jobs_finished_total", status="cancelled") == 1


def counted_by(app: object, method: str = "GET") -> RequestMetrics:
    """Send one request through the middleware alone."""
    metrics = RequestMetrics()
    measured = MeasuredRequests(app, metrics, ["/result"])  # type: ignore[arg-type]
    scope = {"type": "http", "method": method, "path": "/x"}
    messages = [{"type": "http.request", "body": b"12345", "more_body": False}]

    async def receive() -> Message:
        return messages.pop()

    async def send(message: Message) -> None:
        pass

    with contextlib.suppress(ZeroDivisionError):
        asyncio.run(measured(scope, receive, send))
    return metrics


def samples(metrics: RequestMetrics) -> list[tuple[dict[str, str], float]]:
    return [(s.labels, s.value) for s in next(iter(metrics.collect())).samples]


def test_a_request_that_breaks_the_application_is_a_server_error() -> None:
    async def broken(scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        raise ZeroDivisionError

    metrics = counted_by(broken)
    assert samples(metrics) == [({"route": "other", "method": "GET", "status": "500"}, 1)]
    uploaded = [s.value for family in metrics.uploaded.collect() for s in family.samples]
    assert uploaded[0] == 5


def test_methods_that_clients_invent_are_one_label() -> None:
    async def refusing(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 405, "headers": []})

    expected = [({"route": "other", "method": "other", "status": "405"}, 1)]
    assert samples(counted_by(refusing, "BREW")) == expected
