"""For the one that keeps the service running: is it alive, is it ready."""

from fastapi import APIRouter, Request

from service.problems import RETRY_SECONDS, Problem, example_responses
from service.readiness import ESSENTIAL, Probe
from smsr_client.documents import Health, Readiness

router = APIRouter(tags=["health"])


@router.get("/healthz", summary="Whether the process lives")
async def alive() -> Health:
    """Answer without looking at anything else; an answer is the news."""
    return Health()


@router.get(
    "/readyz",
    summary="Whether jobs can be taken",
    responses=example_responses("not-ready"),
)
async def ready(request: Request) -> Readiness:
    """Check Redis and the storage, and tell of the disk, the workers and the maintenance.

    Without Redis or the storage the answer is 503. Where the disk is nearly full, no worker lives
    or the maintenance is late, `checks` says so and the service is ready: what can be served is.
    """
    probe: Probe = request.app.state.probe
    checks, survey = await probe.look()
    wrong = "; ".join(f"{name} {checks[name]}" for name in ESSENTIAL if checks[name] != "ok")
    if wrong or survey is None:
        raise Problem(
            "not-ready",
            f"The service cannot take jobs: {wrong}.",
            headers={"Retry-After": str(RETRY_SECONDS)},
            checks=checks,
        )
    # Who may not see a job may not see that there is one either.
    secret = request.app.state.gate.policy == "keys"
    return Readiness(
        checks=dict(checks),
        workers=survey.workers,
        queued=None if secret else survey.jobs["queued"],
    )
