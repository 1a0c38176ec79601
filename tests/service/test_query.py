from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pytest

from service.app import create_app
from tests.service.conftest import problem
from worker.records import new_job_id
from worker.settings import Settings

if TYPE_CHECKING:
    import httpx


def operations() -> list[tuple[str, str]]:
    document = create_app(Settings(redis_url="redis://localhost")).openapi()
    return [
        (method.upper(), path)
        for path, methods in document["paths"].items()
        for method in methods
        if path.startswith("/v1")
    ]


def test_a_misspelt_parameter_is_named_with_the_one_that_is_meant(client: httpx.Client) -> None:
    document = problem(client.get("/v1/jobs?stauts=failed&page=2"), "invalid-request", 422)
    assert "no parameter 'stauts'. Did you mean 'status'?" in document["detail"]
    assert "Parameters here are status, batch, limit, cursor." in document["detail"]
    assert document["parameters"] == ["status", "batch", "limit", "cursor"]
    assert [(e["in"], e["name"]) for e in document["errors"]] == [
        ("query", "stauts"),
        ("query", "page"),
    ]
    assert "mean" not in document["errors"][1]["detail"]


@pytest.mark.parametrize(
    "query", ["status=succeeded&status=failed", "limit=3&limit=3", "batch=&limit=1&batch=b"]
)
def test_a_parameter_has_one_value(client: httpx.Client, query: str) -> None:
    document = problem(client.get(f"/v1/jobs?{query}"), "invalid-request", 422)
    (error,) = document["errors"]
    assert error["name"] == query.partition("=")[0]
    assert "takes one value" in document["detail"]


@pytest.mark.parametrize(("method", "path"), operations())
def test_every_route_of_the_api_checks_its_query(
    client: httpx.Client, method: str, path: str
) -> None:
    names = {"frame": "0", "array": "shapes", "name": "shapes", "form": "png"}
    filled = re.sub(r"\{(\w+)\}", lambda found: names.get(found[1], new_job_id()), path)
    for asked in (method, "HEAD") if method == "GET" else (method,):
        with client.stream(asked, f"{filled}?nope=1") as answer:
            assert answer.status_code == 422, asked  # a stream of events would not end
            answer.read()
        if asked != "HEAD":
            document = problem(answer, "invalid-request", 422)
            assert document["errors"][0]["name"] == "nope"


def test_routes_that_the_document_leaves_out_check_theirs(client: httpx.Client) -> None:
    headers = {"X-HTTP-Method-Override": "DELETE"}
    answer = client.post(f"/v1/uploads/{new_job_id()}?nope=1", headers=headers)
    document = problem(answer, "invalid-request", 422)
    assert "Here are no parameters." in document["detail"]
    assert answer.headers["Tus-Resumable"] == "1.0.0"


def test_long_and_many_parameters_are_not_all_repeated(client: httpx.Client) -> None:
    query = urlencode({f"{i}" + "x" * 400: "" for i in range(50)})
    document: dict[str, Any] = problem(client.get(f"/v1/jobs?{query}"), "invalid-request", 422)
    assert len(document["errors"]) == 10
    assert len(document["detail"]) < 2000


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics", "/problems", "/", "/docs"])
def test_what_is_not_the_api_takes_any_query(client: httpx.Client, path: str) -> None:
    assert client.get(f"{path}?t=1&t=2").status_code == 200
