from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, get_args

import numpy as np
import pytest

from smsr.errors import AmbiguousArray, NotFinite, SmsrError
from smsr.files import Role, open_array
from worker.options import JobOptions
from worker.problems import (
    InternalError,
    OutOfMemory,
    StorageUnavailable,
    TimeLimitExceeded,
    WorkerLost,
    problem_document,
)

if TYPE_CHECKING:
    from pathlib import Path


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


@pytest.mark.parametrize("role", get_args(Role))
def test_the_option_that_tells_arrays_apart_is_named(tmp_path: Path, role: Role) -> None:
    np.savez(tmp_path / "f.npz", one=np.zeros((6, 3)), two=np.zeros((6, 3)))
    with pytest.raises(AmbiguousArray) as caught:
        open_array(tmp_path / "f.npz", role=role)
    document = problem_document(caught.value)
    assert document["option"] in {field.name for field in dataclasses.fields(JobOptions)}
    assert document["option"].startswith(role)
    assert repr(document["option"]) in document["detail"]
    assert "option" not in caught.value.context
