"""What the client raises."""

from __future__ import annotations

from contextlib import suppress
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    import httpx

    from smsr_client.documents import Job

_REFUSALS: Final = frozenset(
    {
        HTTPStatus.BAD_REQUEST,
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
        HTTPStatus.UNPROCESSABLE_ENTITY,
    }
)


class ClientError(Exception):
    """Base of what this client raises."""


class WrongAddress(ClientError, ValueError):
    """What was given as a server's address is none."""


class ServerUnreachable(ClientError):
    """No answer from the server, however often it was asked."""


class ServiceError(ClientError):
    """The server refused, and said why.

    Parameters
    ----------
    status : int
        HTTP status.
    problem : mapping
        The problem document (RFC 9457), or what could be made of another answer.
    """

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        title, detail = problem.get("title"), problem.get("detail")
        super().__init__(": ".join(str(part) for part in (title, detail) if part))
        self.status = status
        self.problem = dict(problem)

    @property
    def slug(self) -> str:
        """Name of the problem type, as in ``/problems/<slug>``."""
        return str(self.problem.get("type", "")).rpartition("/")[2]

    @property
    def refused_input(self) -> bool:
        """Whether the input or the options were at fault."""
        return self.status in _REFUSALS


class JobFailed(ClientError):
    """A job ended without a result.

    Parameters
    ----------
    job : Job
        The job; its `problem` says why.
    """

    def __init__(self, job: Job) -> None:
        why = ""
        if job.problem is not None:
            why = ": " + " ".join(f"{job.problem.title}. {job.problem.detail or ''}".split())
        outcome = "was cancelled" if job.status == "cancelled" else "failed"
        super().__init__(f"Job {job.id} {outcome}{why}")
        self.job = job


def require_success(job: Job) -> Job:
    """Return a job that succeeded.

    Parameters
    ----------
    job : Job
        One that has ended.

    Raises
    ------
    JobFailed
        It failed or was cancelled.
    """
    if job.status in ("failed", "cancelled"):
        raise JobFailed(job)
    return job


def refusal_of(response: httpx.Response) -> ServiceError:
    """Return the error that an answer tells of."""
    problem: dict[str, Any] = {}
    with suppress(ValueError):
        document = response.json()
        if isinstance(document, dict):
            problem = document
    if "title" not in problem:
        problem = {"title": f"The server answered {response.status_code} {response.reason_phrase}"}
    return ServiceError(response.status_code, problem)
