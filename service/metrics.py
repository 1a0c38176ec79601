"""What Prometheus is told: the jobs of all workers, and the requests of this process.

Jobs are counted in Redis (`worker.counters`), so every API process tells the same of them; requests
are counted where they are answered, by `MeasuredRequests`. Nothing is kept of a single request.
"""

from __future__ import annotations

import itertools
import logging
import time
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter
from prometheus_client import Histogram as ClientHistogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from redis.exceptions import RedisError

from service.problems import JOB_PROBLEMS
from smsr import STAGES
from worker.connections import connect
from worker.counters import BOUNDS, REMOVED, SIZES, UNKNOWN_SIZE, Counters, Histogram
from worker.outbox import OUTCOMES
from worker.records import FINAL, RecordStore

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from prometheus_client.metrics_core import Metric
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from worker.disk import Disk
    from worker.records import Survey
    from worker.settings import Settings

JOB_STAGES = ("opening", *STAGES, "evaluating", "publishing")
"""What a worker measures: the solver's stages, and its own around them."""

REDIS_TIMEOUT = 1.0
"""Seconds for which Redis may be silent; with the repetitions, a scrape still ends in time."""

REQUEST_BOUNDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300)
"""Upper bounds, in seconds, of buckets; long polls take up to a minute, uploads any time."""

NO_ROUTE = "other"
"""Route label of addresses that do not exist, and of the files of the documentation's pages."""

_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_LIMITS = (*(str(float(bound)) for bound in BOUNDS), "+Inf")

_log = logging.getLogger(__name__)


class Metrics:
    """All metrics of one application.

    Parameters
    ----------
    settings : Settings
        With a `redis_url`.
    disk : Disk
    """

    def __init__(self, settings: Settings, disk: Disk) -> None:
        self._jobs = JobMetrics(settings)
        self.requests = RequestMetrics()
        self._registry = CollectorRegistry()
        self._registry.register(self._jobs)
        self._registry.register(self.requests)
        self._registry.register(DiskMetrics(disk))

    def expose(self, accept: str) -> tuple[bytes, str]:
        """Return all metrics as text, and its media type.

        Blocks while Redis is asked.

        Parameters
        ----------
        accept : str
            Header of the request; OpenMetrics is given to who asks for it.
        """
        encode, media_type = choose_encoder(accept)
        return encode(self._registry), media_type

    def close(self) -> None:
        """Close the connection to Redis."""
        self._jobs.close()


class JobMetrics(Collector):
    """The queue, its workers and its jobs, read from Redis in one round trip at each scrape.

    Series exist, as zero, before there is something to count: Prometheus sees no increase in a
    series that begins with 1.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._redis = connect(str(settings.redis_url), timeout=REDIS_TIMEOUT)
        self._records = RecordStore(self._redis)
        self._queue = settings.queue
        self._silence = 2 * settings.lease_seconds

    def close(self) -> None:
        """Close the connection."""
        self._redis.close()

    def collect(self) -> Iterator[Metric]:
        """Yield what is known; without Redis, that it is away."""
        try:
            survey = self._records.survey(self._silence)
        except RedisError as error:
            _log.warning("Redis does not answer: %s", error)
            survey = None
        up = float(survey is not None)
        yield GaugeMetricFamily("smsr_up", "Whether this API process reaches Redis.", up)
        if survey is not None:
            yield from self._now(survey)
            yield from _ends(survey.counters)
            yield from _durations(survey.counters)

    def _now(self, survey: Survey) -> Iterator[Metric]:
        depth = GaugeMetricFamily(
            "smsr_queue_depth", "Jobs that wait.", labels=["queue", "priority"]
        )
        for priority, count in survey.queued.items():
            depth.add_metric([self._queue, priority], count)
        yield depth
        jobs = GaugeMetricFamily("smsr_jobs", "Records of jobs.", labels=["status"])
        for status, count in survey.jobs.items():
            jobs.add_metric([status], count)
        yield jobs
        alive = "Workers with a recent sign of life."
        yield GaugeMetricFamily("smsr_workers_alive", alive, survey.workers)


def _ends(counters: Counters) -> Iterator[Metric]:
    finished = CounterMetricFamily(
        "smsr_jobs_finished", "Ends of jobs; a retried one ends again.", labels=["status"]
    )
    for status in FINAL:
        finished.add_metric([status], counters.ended.get(status, 0))
    yield finished
    reused = "Jobs that were not run, but took the result of an equal one."
    yield CounterMetricFamily("smsr_jobs_reused", reused, counters.reused)
    failures = CounterMetricFamily(
        "smsr_failures", "Failures of jobs by problem type.", labels=["type"]
    )
    for slug in sorted(JOB_PROBLEMS | counters.failures.keys()):
        failures.add_metric([slug], counters.failures.get(slug, 0))
    yield failures
    removed = CounterMetricFamily(
        "smsr_removed", "What the maintenance has removed.", labels=["kind"]
    )
    for kind in REMOVED:
        removed.add_metric([kind], counters.removed.get(kind, 0))
    yield removed
    lost = "Attempts that ended with their worker."
    yield CounterMetricFamily("smsr_attempts_lost", lost, counters.lost)
    webhooks = CounterMetricFamily(
        "smsr_webhook_attempts", "Attempts to deliver webhooks.", labels=["outcome"]
    )
    for outcome in OUTCOMES:
        webhooks.add_metric([outcome], counters.webhooks.get(outcome, 0))
    yield webhooks


def _durations(counters: Counters) -> Iterator[Metric]:
    waits = HistogramMetricFamily("smsr_job_wait_seconds", "From being queued to a start.")
    _add(waits, (), counters.waits)
    yield waits
    runs = HistogramMetricFamily(
        "smsr_job_run_seconds", "From the last start to the end.", labels=["size"]
    )
    for size in dict.fromkeys([*SIZES, UNKNOWN_SIZE, *counters.runs]):
        _add(runs, [size], counters.runs.get(size, Histogram()))
    yield runs
    stages = HistogramMetricFamily(
        "smsr_stage_seconds", "Stages of jobs that succeeded.", labels=["stage"]
    )
    for stage in dict.fromkeys([*JOB_STAGES, *counters.stages]):
        _add(stages, [stage], counters.stages.get(stage, Histogram()))
    yield stages


def _add(family: HistogramMetricFamily, labels: Sequence[str], histogram: Histogram) -> None:
    """Add a histogram to a family; the buckets of Prometheus contain those below them."""
    counts = itertools.accumulate(histogram.buckets)
    family.add_metric(labels, list(zip(_LIMITS, counts, strict=True)), histogram.sum)


class DiskMetrics(Collector):
    """How much room there is, as this process sees it.

    Parameters
    ----------
    disk : Disk
    """

    def __init__(self, disk: Disk) -> None:
        self._disk = disk

    def collect(self) -> Iterator[Metric]:
        """Yield what is known; nothing of a bucket."""
        free = self._disk.free()
        if free is not None:
            about = "Free bytes of the disk with the least, of storage and scratch."
            yield GaugeMetricFamily("smsr_disk_free_bytes", about, free)
            about = "Below so many free bytes uploads are refused."
            yield GaugeMetricFamily("smsr_disk_reserve_bytes", about, self._disk.reserve)


class RequestMetrics(Collector):
    """What this process answered, and how many bytes went either way."""

    def __init__(self) -> None:
        self.count = Counter(
            "smsr_http_requests",
            "Answered requests.",
            ["route", "method", "status"],
            registry=None,
        )
        self.seconds = ClientHistogram(
            "smsr_http_request_seconds",
            "From the head of a request to the end of its answer.",
            ["route", "method"],
            buckets=REQUEST_BOUNDS,
            registry=None,
        )
        self.uploaded = Counter("smsr_upload_bytes", "Bytes of requests.", registry=None)
        self.downloaded = Counter("smsr_download_bytes", "Bytes of results.", registry=None)

    def collect(self) -> Iterator[Metric]:
        """Yield all, without the times at which series began, which nobody asks for."""
        for metric in (self.count, self.seconds, self.uploaded, self.downloaded):
            for family in metric.collect():
                family.samples = [s for s in family.samples if not s.name.endswith("_created")]
                yield family


class MeasuredRequests:
    """Counts requests and bytes; streams pass through as they are.

    Parameters
    ----------
    app : ASGIApp
    metrics : RequestMetrics
    results : collection of str
        Route templates whose answers are results.
    """

    def __init__(self, app: ASGIApp, metrics: RequestMetrics, results: Collection[str]) -> None:
        self.app = app
        self.metrics = metrics
        self.results = results

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.perf_counter()
        status = 500  # what the server answers when the application does not

        async def counted_receive() -> Message:
            message = await receive()
            if message["type"] == "http.request":
                self.metrics.uploaded.inc(len(message.get("body", b"")))
            return message

        async def counted_send(message: Message) -> None:
            nonlocal status
            await send(message)
            if message["type"] == "http.response.start":
                status = message["status"]
            elif _route(scope) in self.results and status < 300:
                self.metrics.downloaded.inc(len(message.get("body", b"")))

        try:
            await self.app(scope, counted_receive, counted_send)
        finally:
            seconds = time.perf_counter() - started
            method = scope["method"] if scope["method"] in _METHODS else "other"
            route = _route(scope)
            self.metrics.count.labels(route, method, str(status)).inc()
            self.metrics.seconds.labels(route, method).observe(seconds)


def _route(scope: Scope) -> str:
    """Return the template of the path, which the router has noted."""
    path: str = getattr(scope.get("route"), "path", NO_ROUTE)
    return path
