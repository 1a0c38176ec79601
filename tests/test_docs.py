"""The documentation builds without a warning, its notebook runs, and all of it is its own."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import pytest

from tests.conftest import ROOT, clean_environment

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.slow


class _Page(HTMLParser):
    """What a page loads, where it leads, and the anchors that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = {name: value or "" for name, value in attrs}
        if "id" in known:
            self.anchors.add(known["id"])
        if tag == "a":
            self.links.append(known.get("href", ""))
        elif tag == "link":
            self.loads.append(known.get("href", ""))
        elif "src" in known:
            self.loads.append(known["src"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built from nothing with the notebook run."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"]
    run = subprocess.run(
        [*command, "-D", "nb_execution_mode=force", "docs", str(folder)],
        cwd=ROOT,
        env=clean_environment(),
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, _Page]:
    found = {path: _Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    assert len(found) > 15
    return found


def test_the_notebook_ran_and_shows_what_came_of_it(site: Path) -> None:
    page = (site / "notebooks" / "first-steps.html").read_text(encoding="utf-8")
    errors = [float(number) for number in re.findall(r"e3D (\d\.\d+)", page)]
    assert len(errors) == 2, "one of the library, one of the service"
    assert errors[0] == pytest.approx(errors[1], abs=1e-3)
    assert max(errors) < 0.1
    assert len(list((site / "_images").glob("*.png"))) >= 3 + page.count("../images/")
    assert page.count("<img") >= 3


def test_the_notebook_is_kept_without_its_output() -> None:
    for path in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = [cell for cell in cells if cell["cell_type"] == "code"]
        assert code
        assert [cell for cell in code if cell["outputs"] or cell["execution_count"]] == [], path


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, _Page]) -> None:
    for path, page in pages.items():
        foreign = [one for one in page.loads if urlsplit(one).netloc]
        assert foreign == [], path
    for path in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", path.read_text()), path


def test_links_lead_somewhere(pages: dict[Path, _Page]) -> None:
    lost = []
    for path, page in pages.items():
        for link in (*page.links, *page.loads):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            known = pages.get(target)
            anchor = unquote(parts.fragment)
            if not target.exists() or (known and anchor and anchor not in known.anchors):
                lost.append(f"{path.name}: {link}")
    assert lost == []


def test_formulas_are_mathml(site: Path) -> None:
    page = (site / "solver.html").read_text(encoding="utf-8")
    assert page.count("<math") > 30
    assert "MathJax" not in page


def test_generated_pages_are_of_the_program(site: Path) -> None:
    http = (site / "generated" / "http.html").read_text(encoding="utf-8")
    commands = (site / "generated" / "command-line.html").read_text(encoding="utf-8")
    assert "POST /v1/jobs" in http
    assert 'id="problem-odd-row-count"' in http
    for name in ("reconstruct", "jobs list", "keys create"):
        assert f"smsr {name}" in commands
