"""The HTTP application."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from anyio import to_thread
from fastapi import APIRouter
from fastapi.routing import APIRoute
from fastapi_offline import FastAPIOffline
from starlette.middleware.cors import CORSMiddleware

import smsr
from service import documentation, problems, query
from service.access import KEY_SCHEMES, Access, Gate, policy_for
from service.context import Context
from service.downloads import OpenResults
from service.lingering import LingeringClose
from service.metrics import MeasuredRequests, Metrics
from service.readiness import Probe
from service.requests import TrackedRequests
from service.routes import batches, events, health, info, jobs, metrics, page, results, uploads
from service.routes import problems as problem_pages
from service.security import SecurityHeaders
from service.webhooks import Deliverer
from worker.changes import ChangeFeed
from worker.connections import connect_async
from worker.disk import Disk
from worker.logs import configure_logging
from worker.maintenance import Maintenance
from worker.queue import JobQueue
from worker.settings import Settings, read_settings
from worker.tracing import Tracing
from worker.uploads import Digests, UploadStore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from fastapi import FastAPI
_log = logging.getLogger(__name__)

CORS_REQUEST_HEADERS = (
    "Authorization",
    "Content-Digest",
    "Content-Type",
    "Idempotency-Key",
    "If-Match",
    "If-None-Match",
    "If-Range",
    "Last-Event-ID",
    "Prefer",
    "Range",
    "Tus-Resumable",
    "Upload-Checksum",
    "Upload-Concat",
    "Upload-Defer-Length",
    "Upload-Length",
    "Upload-Metadata",
    "Upload-Offset",
    "X-API-Key",
    "X-Request-ID",
    "traceparent",
)
CORS_ANSWER_HEADERS = (
    "Accept-Ranges",
    "Content-Disposition",
    "Content-Range",
    "ETag",
    "Link",
    "Location",
    "Preference-Applied",
    "RateLimit",
    "RateLimit-Policy",
    "Retry-After",
    "Tus-Checksum-Algorithm",
    "Tus-Extension",
    "Tus-Max-Size",
    "Tus-Resumable",
    "Tus-Version",
    "Upload-Expires",
    "Upload-Length",
    "Upload-Metadata",
    "Upload-Offset",
    "X-Request-ID",
)
"""What pages of other origins may send and read, where they may at all."""

_DESCRIPTION = """
Send the 2D point tracks of a deforming object, filmed by one camera; get back the moving 3D
surface.

1. `POST /v1/jobs` with the measurement file, and ground truth and faces where there are some.
2. `GET /v1/jobs/{id}` with `Prefer: wait=30` until `status` is `succeeded`.
3. Download `result.npz`, single frames as PLY or all of them as a ZIP.

Every error is a problem document (RFC 9457) with a stable `type`; `/problems` documents all types.
"""


def create_app(settings: Settings, *, address: str | None = None) -> FastAPI:
    """Return the application; it connects when its lifespan begins.

    Redis need not answer by then: until it does, requests get 503 and /readyz says why. No workers
    are started here.

    Parameters
    ----------
    settings : Settings
        `redis_url` must be set.
    address : str, optional
        IP address at which the application will be reached. Unless it is given and is a loopback
        address, `access` 'auto' means that API keys are needed.

    Raises
    ------
    ValueError
        The settings name no Redis server.
    """
    if settings.redis_url is None:
        raise ValueError("the service needs the address of a Redis server")
    redis_url = settings.redis_url
    disk = Disk(settings)
    measured = Metrics(settings, disk)
    policy = policy_for(settings, address)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        queue = JobQueue(settings)
        async with connect_async(redis_url) as redis, ChangeFeed(redis) as feed:
            opened = OpenResults(queue.storage)
            uploaded = UploadStore(queue.redis, ttl=settings.upload_ttl_seconds)
            app.state.gate = Gate(settings, policy, redis)
            app.state.tracing = tracing = Tracing("smsr-api")
            app.state.context = Context(
                settings, queue, feed, opened, measured, uploaded, Digests(), tracing, disk
            )
            app.state.probe = probe = Probe(settings, queue.storage, disk)
            beside = [asyncio.create_task(_keep_order(queue), name="maintenance")]
            if settings.webhook_secret:
                deliverer = Deliverer(settings, queue.redis)
                beside.append(asyncio.create_task(deliverer.run(), name="webhooks"))
            try:
                yield
            finally:
                for task in beside:
                    task.cancel()
                await asyncio.gather(*beside, return_exceptions=True)
                queue.redis.close()
                measured.close()
                probe.close()
                await to_thread.run_sync(tracing.close)

    app = FastAPIOffline(
        docs_url=None,
        redoc_url=None,
        title="SMSR",
        summary="Moving 3D surfaces from 2D point tracks of one camera.",
        description=_DESCRIPTION,
        version=smsr.__version__,
        license_info={"name": "MIT", "identifier": "MIT"},
        lifespan=lifespan,
        responses={
            "default": {
                "description": "A problem document; see /problems for all types.",
                "content": {problems.MEDIA_TYPE: {"schema": problems.SCHEMA}},
            }
        },
    )
    app.router.redirect_slashes = False
    problems.install(app)
    documentation.install(app)
    ours = (page, jobs, batches, events, results, uploads, info, health, metrics, problem_pages)
    for routes in ours:
        versioned = routes.router.prefix.startswith("/v1")
        checks = [query.CHECKED] if versioned else []
        keys = KEY_SCHEMES if versioned and routes is not info else ()
        app.include_router(
            routes.router,
            dependencies=[*keys, *checks],
            responses=query.RESPONSES if versioned else None,
        )
        app.include_router(_heads_of(routes.router), dependencies=checks)
    app.add_middleware(Access)
    app.add_middleware(uploads.TusHeaders)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=[origin.strip() for origin in settings.cors_origins.split(",")],
            allow_methods=["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"],
            allow_headers=CORS_REQUEST_HEADERS,
            expose_headers=CORS_ANSWER_HEADERS,
            max_age=3600,
        )
    app.add_middleware(SecurityHeaders)
    app.add_middleware(
        MeasuredRequests,
        metrics=measured.requests,
        results={route.path for route in results.router.routes if isinstance(route, APIRoute)}
        | {batches.RESULTS},
    )
    app.add_middleware(TrackedRequests)
    app.add_middleware(LingeringClose)
    return app


def _heads_of(router: APIRouter) -> APIRouter:
    """Return HEAD routes for the GET routes of a router (RFC 9110, section 9.1)."""
    heads = APIRouter()
    for route in router.routes:
        if isinstance(route, APIRoute) and "GET" in (route.methods or ()):
            heads.add_api_route(
                route.path, route.endpoint, methods=["HEAD"], include_in_schema=False
            )
    return heads


def app_from_environment() -> FastAPI:
    """Return the application with the settings of the environment.

    For servers that take a factory, as in ``uvicorn --factory service.app:app_from_environment``.
    Such a server does not say where it listens, so API keys are needed unless ``SMSR_ACCESS=open``.
    """
    settings = read_settings()
    configure_logging(settings.log_level)
    return create_app(settings)


async def _keep_order(queue: JobQueue) -> None:
    """Repair and tidy at start and ever after; the interval is that of the settings."""
    keeper = Maintenance(queue)
    while True:
        try:
            await to_thread.run_sync(keeper.run_once)
        except Exception:  # noqa: BLE001  (a bug there must not end the service's care for jobs)
            _log.exception("maintenance failed")
        await asyncio.sleep(queue.settings.maintenance_interval_seconds)
