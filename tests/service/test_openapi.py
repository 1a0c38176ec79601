from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pytest
from openapi_spec_validator import OpenAPIV31SpecValidator

from service.app import create_app
from service.problems import CATALOGUE, MEDIA_TYPE
from smsr import figures
from smsr_client.documents import Job
from worker.settings import Settings

if TYPE_CHECKING:
    import httpx


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    schema: dict[str, Any] = create_app(Settings(redis_url="redis://localhost")).openapi()
    return schema


def test_the_document_is_valid(document: dict[str, Any]) -> None:
    assert document["openapi"].startswith("3.1")
    OpenAPIV31SpecValidator(json.loads(json.dumps(document))).validate()


def test_the_served_document_is_the_same(client: httpx.Client, document: dict[str, Any]) -> None:
    assert client.get("/openapi.json").json() == document


def operations(document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        (path, method, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


def test_every_operation_is_explained(document: dict[str, Any]) -> None:
    found = operations(document)
    assert len(found) >= 14
    for path, method, operation in found:
        assert operation["summary"], (path, method)
        assert operation["description"].endswith("."), (path, method)
        assert "default" in operation["responses"]
    assert len({operation["operationId"] for _, _, operation in found}) == len(found)


def test_documented_problems_are_those_of_the_catalogue(document: dict[str, Any]) -> None:
    examples = 0
    for path, _, operation in operations(document):
        for status, response in operation["responses"].items():
            content = response.get("content", {}).get(MEDIA_TYPE, {})
            for slug, example in content.get("examples", {}).items():
                examples += 1
                assert CATALOGUE[slug].status == int(status), (path, slug)
                assert example["value"]["type"] == CATALOGUE[slug].uri
    assert examples > 30


def test_problems_are_promised_in_their_own_media_type(document: dict[str, Any]) -> None:
    for path, method, operation in operations(document):
        for status, response in operation["responses"].items():
            if status == "default" or int(status) >= 400:
                assert set(response["content"]) == {MEDIA_TYPE}, (path, method, status)


def test_every_route_of_the_api_says_that_its_query_may_be_refused(
    document: dict[str, Any],
) -> None:
    for path, method, operation in operations(document):
        if path.startswith("/v1"):
            content = operation["responses"]["422"]["content"][MEDIA_TYPE]
            assert "invalid-request" in content["examples"], (path, method)


def test_a_part_of_a_file_is_of_the_type_of_the_file(document: dict[str, Any]) -> None:
    found = 0
    for path, method, operation in operations(document):
        if "206" in operation["responses"]:
            found += 1
            whole, part = (operation["responses"][status]["content"] for status in ("200", "206"))
            assert set(part) == set(whole), (path, method)
    assert found >= 8


def test_names_of_files_are_listed(document: dict[str, Any]) -> None:
    listed = {
        (path.rpartition("/")[2], parameter["name"]): parameter["schema"].get("enum")
        for path, _, operation in operations(document)
        for parameter in operation.get("parameters", ())
        if parameter["in"] == "path"
    }
    assert listed["{array}.npy", "array"] == ["shapes", "cameras", "translations", "faces"]
    assert listed["{name}.{form}", "name"] == list(figures.NAMES)
    assert listed["{name}.{form}", "form"] == list(figures.FORMATS)


def test_pages_about_problems_are_promised_in_both_types(
    client: httpx.Client, document: dict[str, Any]
) -> None:
    for path in ("/problems", "/problems/{slug}"):
        content = document["paths"][path]["get"]["responses"]["200"]["content"]
        for accept in ("text/html", "application/json"):
            asked = path.replace("{slug}", "not-found")
            answer = client.get(asked, headers={"Accept": accept})
            assert answer.headers["content-type"].partition(";")[0] == accept
            assert accept in content
        assert len(content) == 2


def test_a_submission_is_described_with_every_option(
    client: httpx.Client, document: dict[str, Any]
) -> None:
    body = document["paths"]["/v1/jobs"]["post"]["requestBody"]
    schema = body["content"]["multipart/form-data"]["schema"]
    assert schema["required"] == ["measurements"]
    options = schema["properties"]["options"]["properties"]
    info = client.get("/v1/info").json()
    assert [option["name"] for option in info["options"]] == list(options)
    for option in info["options"]:
        assert options[option["name"]].get("default") == option["default"]
        assert option["help"]


def test_the_example_of_a_job_is_a_job() -> None:
    (example,) = Job.model_json_schema()["examples"]
    assert Job.model_validate(example).model_dump(mode="json").keys() == example.keys()


def test_the_documentation_needs_nothing_from_elsewhere(client: httpx.Client) -> None:
    page = client.get("/docs")
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    sources = re.findall(r"(?:src|href)=\"([^\"]+)\"", page.text)
    assert sources
    for source in sources:
        assert source.startswith("/"), source
        assert client.get(source).status_code == 200
    assert "https://" not in page.text
