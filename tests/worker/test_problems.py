from __future__ import annotations

import json

import pytest

from smsr.errors import NotFinite, SmsrError
from worker.problems import (
    InternalError,
    OutOfMemory,
    StorageUnavailable,
    TimeLimitExceeded,
    WorkerLost,
    problem_document,
)


@pytest.mark.parametrize(
    ("error", "slug", "status"),
    [
        (NotFinite("Row 3 has a NaN.", row=3), "not-finite", 422),
        (TimeLimitExceeded(2.5), "time-limit", 422),
        (OutOfMemory("Too little."), "out-of-memory", 500),
        (WorkerLost(12), "worker-lost", 500),
        (InternalError("ab12"), "internal", 500),
        (StorageUnavailable("Down."), "storage-unavailable", 503),
    ],
)
def test_documents(error: SmsrError, slug: str, status: int) -> None:
    document = problem_document(error)
    assert document == {
        **error.context,
        "type": f"/problems/{slug}",
        "title": error.title,
        "status": status,
        "detail": error.detail,
    }
    assert json.loads(json.dumps(document)) == document


def test_facts_cannot_replace_what_the_standard_names() -> None:
    document = problem_document(NotFinite("Row 3.", status=1, type="x", row=3))
    assert (document["status"], document["type"]) == (422, "/problems/not-finite")
    assert document["row"] == 3
