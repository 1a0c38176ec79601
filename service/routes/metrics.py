"""For Prometheus: how the service fares."""

from anyio import to_thread
from fastapi import APIRouter, Request, Response

from service.context import Shared

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(request: Request, shared: Shared) -> Response:
    """Return what is counted, in the text format of Prometheus, or as OpenMetrics if asked so.

    Jobs are those of the whole service, requests those of the process that answers. While Redis is
    away, `smsr_up` is 0 and nothing is said of jobs.
    """
    accept = request.headers.get("accept", "")
    body, media_type = await to_thread.run_sync(shared.metrics.expose, accept)
    return Response(body, headers={"Content-Type": media_type, "Vary": "Accept"})
