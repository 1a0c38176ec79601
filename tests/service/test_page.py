"""How the built page is served, and what is said where there is none."""

from __future__ import annotations

import gzip
from typing import TYPE_CHECKING

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service import problems
from service.routes import page

if TYPE_CHECKING:
    from pathlib import Path

    from tests.service.conftest import Api

SCRIPT = "console.log('the page')\n" * 100


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    assets = tmp_path / "assets"
    assets.mkdir()
    (tmp_path / "index.html").write_text("<!doctype html><title>SMSR</title>")
    (assets / "index-abc123.js").write_text(SCRIPT)
    (tmp_path / "secret").write_text("secret")
    monkeypatch.setattr(page, "BUILT", tmp_path)
    return tmp_path


@pytest.fixture
def browser() -> TestClient:
    app = FastAPI()
    problems.install(app)
    app.include_router(page.router)
    return TestClient(app)


def directives(answer: httpx.Response) -> dict[str, str]:
    policy = answer.headers["content-security-policy"]
    return dict(part.split(" ", 1) for part in policy.split("; "))


@pytest.mark.usefixtures("built")
def test_the_page_is_asked_for_again_and_its_parts_never(browser: TestClient) -> None:
    index = browser.get("/")
    assert index.headers["content-type"] == "text/html; charset=utf-8"
    assert index.headers["cache-control"] == "no-cache"
    script = browser.get("/assets/index-abc123.js")
    assert script.text == SCRIPT
    assert script.headers["content-type"] == "text/javascript; charset=utf-8"
    assert script.headers["cache-control"] == "public, max-age=31536000, immutable"


@pytest.mark.usefixtures("built")
def test_what_the_browser_has_is_not_sent_again(browser: TestClient) -> None:
    tag = browser.get("/").headers["etag"]
    again = browser.get("/", headers={"If-None-Match": f'"other", W/{tag}'})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == tag


def test_a_page_built_anew_is_served_at_once(built: Path, browser: TestClient) -> None:
    tag = browser.get("/").headers["etag"]
    (built / "index.html").write_text("<!doctype html><title>newer</title>")
    newer = browser.get("/", headers={"If-None-Match": tag})
    assert newer.status_code == 200
    assert "newer" in newer.text


@pytest.mark.usefixtures("built")
def test_scripts_are_compressed_for_those_who_take_it(browser: TestClient) -> None:
    plain = browser.get("/assets/index-abc123.js", headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    with browser.stream(
        "GET", "/assets/index-abc123.js", headers={"Accept-Encoding": "gzip"}
    ) as answer:
        raw = b"".join(answer.iter_raw())
    assert gzip.decompress(raw).decode() == SCRIPT
    assert len(raw) < len(plain.content) / 4
    assert answer.headers["vary"] == "Accept-Encoding"
    assert answer.headers["etag"] != plain.headers["etag"]


@pytest.mark.usefixtures("built")
def test_nothing_inline_and_nothing_from_elsewhere_is_allowed(browser: TestClient) -> None:
    for path in ("/", "/assets/index-abc123.js"):
        policy = directives(browser.get(path))
        assert policy["default-src"] == "'none'"
        assert policy["frame-ancestors"] == "'none'"
        assert {policy[f"{kind}-src"] for kind in ("script", "style", "img", "connect")} == {
            "'self'"
        }


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("name", ["absent.js", "..%2Fsecret", "..%2findex.html", "%2e%2e"])
def test_only_files_of_the_page_are_served(browser: TestClient, name: str) -> None:
    answer = browser.get(f"/assets/{name}")
    assert answer.status_code == 404
    assert "secret" not in answer.text.replace(name, "").replace("../secret", "")


def test_without_a_page_the_service_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, browser: TestClient
) -> None:
    monkeypatch.setattr(page, "BUILT", tmp_path)
    answer = browser.get("/")
    assert answer.status_code == 200
    assert "has not been built" in answer.text
    assert "make page" in answer.text
    assert 'href="docs"' in answer.text
    assert directives(answer)["default-src"] == "'none'"
    assert browser.get("/assets/index-abc123.js").status_code == 404


def test_the_service_answers_at_its_root(api: Api) -> None:
    """Built or not: the root is a page for people, and HEAD is answered as GET is."""
    answer = httpx.get(f"{api.url}/")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    head = httpx.head(f"{api.url}/")
    assert (head.status_code, head.content) == (200, b"")
