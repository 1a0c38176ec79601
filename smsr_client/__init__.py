"""Client of the service: submit point tracks, follow the job, fetch the moving surface.

    from smsr_client import Client

    with Client("http://127.0.0.1:8000") as client:
        result = client.reconstruct("tracks.npy")
        result.shapes  # (T, N, 3)

`AsyncClient` does the same with ``await``. What the network or a busy server makes fail is tried
again, with growing pauses and as long as ``Retry-After`` asks; what the server refuses is raised as
the problem document it sent (RFC 9457).
"""

from smsr_client.asynchronous import AsyncClient
from smsr_client.client import Client
from smsr_client.documents import (
    FINAL,
    BatchCancelled,
    BatchDocument,
    BatchRetried,
    Info,
    Job,
    JobStatus,
)
from smsr_client.errors import (
    ClientError,
    JobFailed,
    ServerUnreachable,
    ServiceError,
    WrongAddress,
    require_success,
)
from smsr_client.result import Result

__all__ = [
    "FINAL",
    "AsyncClient",
    "BatchCancelled",
    "BatchDocument",
    "BatchRetried",
    "Client",
    "ClientError",
    "Info",
    "Job",
    "JobFailed",
    "JobStatus",
    "Result",
    "ServerUnreachable",
    "ServiceError",
    "WrongAddress",
    "require_success",
]
