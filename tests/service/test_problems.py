from __future__ import annotations

import asyncio
import inspect
from typing import TYPE_CHECKING

import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from service import problems
from service.problems import CATALOGUE
from smsr import errors
from tests.service.conftest import npy, problem
from worker import problems as worker_problems

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType


def errors_of(module: ModuleType) -> Iterator[type[errors.SmsrError]]:
    for error in vars(module).values():
        if not inspect.isclass(error) or error is errors.SmsrError:
            continue
        if issubclass(error, errors.SmsrError):
            yield error


@pytest.mark.parametrize("module", [errors, worker_problems], ids=["smsr", "worker"])
def test_every_problem_of_the_lower_floors_is_documented(module: ModuleType) -> None:
    for error in errors_of(module):
        assert CATALOGUE[error.slug].title == error.title


def test_every_problem_type_says_what_to_do() -> None:
    for kind in CATALOGUE.values():
        assert kind.title
        assert kind.meaning.endswith(".")
        assert kind.remedy.endswith((".", "`"))
        assert 400 <= kind.status < 600


def test_problem_pages_are_for_people_and_for_programs(client: httpx.Client) -> None:
    listed = client.get("/problems").json()
    assert {kind["type"] for kind in listed} == {kind.uri for kind in CATALOGUE.values()}
    for kind in listed:
        assert client.get(kind["type"]).json() == kind
    browser = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}
    page = client.get("/problems/odd-row-count", headers=browser)
    assert page.headers["content-type"].startswith("text/html")
    assert "odd number of rows" in page.text
    assert "/problems/odd-row-count" in client.get("/problems", headers=browser).text
    for path in ("/problems", "/problems/odd-row-count"):
        for headers in (browser, {"Accept": "application/json"}, {}):
            assert client.get(path, headers=headers).headers["vary"] == "Accept"
    problem(client.get("/problems/<script>"), "unknown-problem", 404)


def test_addresses_and_methods_that_do_not_exist(client: httpx.Client) -> None:
    for path in ("/v1", "/v1/jobs/", "/v2/jobs", "/v1/jobs/1/2/3"):
        problem(client.get(path), "not-found", 404)
    answer = client.put("/v1/jobs")
    problem(answer, "method-not-allowed", 405)
    assert {method.strip() for method in answer.headers["Allow"].split(",")} == {
        "GET",
        "HEAD",
        "POST",
    }
    problem(client.delete("/v1/info"), "method-not-allowed", 405)


def test_an_unexpected_error_is_answered_without_its_trace() -> None:
    app = FastAPI()
    problems.install(app)

    @app.get("/broken")
    def broken() -> None:
        raise RuntimeError("/secret/path")

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
            return await client.get("/broken")

    answer = asyncio.run(ask())
    problem(answer, "internal", 500)
    assert "secret" not in answer.text


def test_context_cannot_replace_the_members_of_the_standard() -> None:
    document = problems.document(
        CATALOGUE["internal"], "detail", "/here", {"status": 200, "type": "x", "limit": 3}
    )
    assert (document["status"], document["type"], document["limit"]) == (
        500,
        "/problems/internal",
        3,
    )


def test_file_names_in_problems_are_those_of_the_client(client: httpx.Client) -> None:
    files = {"measurements": ('a"<b>.npy', npy(np.zeros((5, 9))))}
    document = problem(client.post("/v1/jobs", files=files), "odd-row-count", 422)
    assert "<b>.npy" in document["detail"]
