"""A real server with the built page, and a headless Chromium that looks at it."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import sync_playwright

from service.routes.page import BUILT
from tests.conftest import ROOT, redis_running
from tests.service.conftest import Api, api_running, settings_for
from worker.pool import WorkerPool

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request

    from tests.conftest import RedisProcess

# Playwright keeps an event loop running, in which tests of other modules could start none of their
# own: each module opens a browser and closes it.

PATIENCE = 60_000
"""Milliseconds for what takes one on a machine that does nothing else."""

FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
]
"""Everything drawn by the processor, and no connections that the page did not ask for."""


def find_chromium() -> str | None:
    """Return the path of a Chromium; SMSR_CHROMIUM names another one."""
    named = os.environ.get("SMSR_CHROMIUM")
    names = [named] if named else ["chromium", "chromium-browser", "google-chrome"]
    return next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="session")
def page_built() -> Path:
    """The page, built from the sources as they are."""
    if shutil.which("npm"):
        subprocess.run([ROOT / "scripts" / "page"], check=True, capture_output=True, timeout=600)
    elif not (BUILT / "index.html").is_file():
        pytest.skip("the page has not been built, and there is no npm to build it")
    return BUILT


@pytest.fixture(scope="module")
def api_redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RedisProcess]:
    with redis_running(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture(scope="module")
def site(
    page_built: Path, tmp_path_factory: pytest.TempPathFactory, api_redis: RedisProcess
) -> Iterator[Api]:
    """An API with the page, and one worker."""
    folder = tmp_path_factory.mktemp("site")
    settings = settings_for(folder, api_redis)
    with WorkerPool(settings, 1), api_running(settings, api_redis, folder / "api.log") as running:
        yield running


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = find_chromium()
    if found is None:
        pytest.skip("there is no Chromium (Debian's package chromium, or SMSR_CHROMIUM)")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield opened
        opened.close()


@dataclass
class Visit:
    """A page that is looked at, and what went wrong on it."""

    page: Page
    api: Api
    refusals_expected: bool = False
    troubles: list[str] = field(default_factory=list)

    def on_console(self, message: ConsoleMessage) -> None:
        refused = "Failed to load resource" in message.text
        expected = refused and self.refusals_expected
        expected |= "GPU stall due to ReadPixels" in message.text  # a screenshot, by the processor
        if message.type in ("error", "warning") and not expected:
            self.troubles.append(message.text)

    def on_request(self, request: Request) -> None:
        if not request.url.startswith((self.api.url, "blob:" + self.api.url)):
            self.troubles.append(f"request to {request.url}")

    def open(self, path: str = "/") -> Page:
        self.page.goto(self.api.url + path)
        return self.page


@contextlib.contextmanager
def visiting(browser: Browser, api: Api, **context: Any) -> Iterator[Visit]:
    """Open a page, and see at the end that nothing was refused to it and nothing came from afar."""
    given = {"viewport": {"width": 1360, "height": 860}, "accept_downloads": True}
    opened: BrowserContext = browser.new_context(**{**given, **context})
    opened.set_default_timeout(PATIENCE)
    page = opened.new_page()
    visit = Visit(page, api)
    page.on("console", visit.on_console)
    page.on("request", visit.on_request)
    page.on("pageerror", lambda error: visit.troubles.append(str(error)))
    page.add_init_script(
        "document.addEventListener('securitypolicyviolation',"
        " e => console.error('policy: ' + e.violatedDirective + ' ' + e.blockedURI));"
    )
    try:
        yield visit
        assert visit.troubles == []
    finally:
        opened.close()


@pytest.fixture
def visit(browser: Browser, site: Api) -> Iterator[Visit]:
    with visiting(browser, site) as opened:
        yield opened
