"""For the one that keeps the service running: is it alive, is it ready."""

from collections.abc import Callable

from anyio import to_thread
from fastapi import APIRouter, Request
from redis.exceptions import RedisError

from service.context import Context, Shared
from service.problems import RETRY_SECONDS, Problem, example_responses
from smsr_client.documents import Health, Readiness
from worker.storage import StorageError

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
async def ready(request: Request, shared: Shared) -> Readiness:
    """Check that Redis answers and that the storage can be written, and count the workers."""
    found = await to_thread.run_sync(_look, shared)
    # Who may not see a job may not see that there is one either.
    secret = request.app.state.gate.policy == "keys"
    return found.model_copy(update={"queued": None}) if secret else found


def _look(shared: Context) -> Readiness:
    queue = shared.queue
    checks = {
        "redis": _outcome(queue.redis.ping, "does not answer"),
        "storage": _outcome(lambda: shared.storage.check(), "cannot be written and read"),
    }
    if set(checks.values()) != {"ok"}:
        wrong = "; ".join(f"{name} {found}" for name, found in checks.items() if found != "ok")
        raise Problem(
            "not-ready",
            f"The service cannot take jobs: {wrong}.",
            headers={"Retry-After": str(RETRY_SECONDS)},
            checks=checks,
        )
    return Readiness(checks=checks, workers=queue.workers(), queued=queue.length())


def _outcome(check: Callable[[], object], failure: str) -> str:
    try:
        check()
    except (RedisError, StorageError):
        # What exactly failed may name hosts and folders, which are nobody else's business.
        return failure
    return "ok"
