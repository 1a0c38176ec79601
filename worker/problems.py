"""What can go wrong with a job besides its input, as problem documents (RFC 9457)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Self

from smsr.errors import AmbiguousArray, InputError, NumericalFailure, SmsrError

if TYPE_CHECKING:
    from collections.abc import Mapping


class TimeLimitExceeded(SmsrError):
    """The job ran longer than it may."""

    slug = "time-limit"
    title = "The job ran longer than its time limit"

    def __init__(self, seconds: float) -> None:
        super().__init__(
            f"The job was stopped after its time limit of {seconds:g} seconds. Raise the option "
            "'time_limit' up to what the server allows, or give fewer frames or points.",
            limit_seconds=seconds,
        )


class OutOfMemory(SmsrError):
    """The machine has too little memory for the job."""

    slug = "out-of-memory"
    title = "The job needs more memory than there is"

    @classmethod
    def budget(cls, limit: int | None) -> Self:
        """Return the error of a job that went beyond its budget of `limit` bytes."""
        if limit is None:
            return cls("The worker has too little memory for these measurements.")
        return cls(
            f"A job may take {limit >> 20} MiB of memory here, and this one needs more. "
            "Give fewer frames or points, or ask for workers with more memory.",
            limit_bytes=limit,
        )


class WorkerLost(SmsrError):
    """The workers that ran the job kept dying."""

    slug = "worker-lost"
    title = "The workers that ran the job died"

    def __init__(self, attempts: int) -> None:
        super().__init__(
            f"The job was started {attempts} times, and each time its worker died or fell silent. "
            "Often the machine has too little memory for it.",
            attempts=attempts,
        )


class StorageUnavailable(SmsrError):
    """The object storage kept failing."""

    slug = "storage-unavailable"
    title = "The object storage does not work"

    status: ClassVar[int] = 503


class InputMissing(SmsrError):
    """An uploaded file is no longer in the storage."""

    slug = "input-missing"
    title = "An uploaded file is gone"


class InternalError(SmsrError):
    """Something unexpected; the log has more under the reference."""

    slug = "internal"
    title = "Something went wrong in the server"

    def __init__(self, reference: str) -> None:
        super().__init__(
            f"An unexpected error ended the job. Its reference in the server's log is {reference}.",
            reference=reference,
        )


_CLIENT_ERRORS = (InputError, NumericalFailure, TimeLimitExceeded)


def problem_document(error: SmsrError, status: int | None = None) -> Mapping[str, Any]:
    """Return the problem document of an error, without its instance.

    Parameters
    ----------
    error : SmsrError
    status : int, optional
        HTTP status code; by default 422 for what a client can mend, 503 for a failing storage and
        500 for the rest.
    """
    if status is None:
        status = 422 if isinstance(error, _CLIENT_ERRORS) else getattr(error, "status", 500)
    detail, context = error.detail, error.context
    if isinstance(error, AmbiguousArray):
        # The library takes a key with each file; which option of a job that is, it cannot know.
        option = f"{context['role']}_key"
        detail, context = f"{detail} The option for it is {option!r}.", context | {"option": option}
    return {
        **context,
        "type": f"/problems/{error.slug}",
        "title": error.title,
        "status": status,
        "detail": detail,
    }
