"""What the README tells newcomers to type does what it says."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from service.app import create_app
from service.cli.local import options_markdown
from smsr.options import describe
from tests.conftest import ROOT, clean_environment
from worker.options import JobOptions
from worker.settings import Settings

if TYPE_CHECKING:
    from tests.conftest import Served

README = (ROOT / "README.md").read_text(encoding="utf-8")
ADDRESS = "http://127.0.0.1:8000"


def blocks() -> list[tuple[str, str]]:
    """Language and text of each fenced block, but for the one that starts the server."""
    found = re.findall(r"(<!-- server -->\n)?```(\w+)\n(.*?)```", README, re.DOTALL)
    assert [text for server, _, text in found if server] == ["smsr serve\n"]
    return [(language, text) for server, language, text in found if not server]


@pytest.mark.slow
def test_the_examples_run_in_order_as_they_stand(served: Served, tmp_path: Path) -> None:
    """Only the address is another: the test's server listens on a free port."""
    commands = tmp_path / "bin"
    commands.mkdir()
    for name, code in (("smsr", '-m service.cli "$@"'), ("python3", '"$@"')):
        (commands / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {code}\n')
        (commands / name).chmod(0o755)
    environment = clean_environment()
    environment["PATH"] = f"{commands}:{environment['PATH']}"
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    ran = []
    for language, text in blocks():
        program = ["bash", "-euo", "pipefail"] if language == "bash" else [sys.executable]
        run = subprocess.run(
            [*program, "-c", text.replace(ADDRESS, served.url)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=240,
            check=False,
        )
        assert run.returncode == 0, f"{text}\n{run.stdout}{run.stderr}"
        ran.append(language)
    assert ran.count("bash") >= 3
    assert ran.count("python") >= 2

    for name in ("surface.npz", "fetched.npz", "results/measurements/result.npz"):
        with np.load(tmp_path / name) as arrays:
            assert arrays["shapes"].shape == (60, 1600, 3), name
    assert (tmp_path / "frame0.ply").read_bytes() == (
        tmp_path / "results/measurements/frames/frame_0000.ply"
    ).read_bytes()


def section(name: str) -> str:
    """Return what stands between the marks of a generated part."""
    found = re.search(rf"<!-- {name}: .*? -->\n(.*?)<!-- /{name} -->", README, re.DOTALL)
    assert found is not None, f"the marks of {name} are missing"
    return found.group(1).strip()


def test_the_table_of_options_is_current() -> None:
    assert section("options") == options_markdown(describe(JobOptions)).strip(), (
        "run scripts/fill_readme.py options"
    )


def test_the_table_of_routes_names_every_route() -> None:
    at_a_glance = README.partition("## API at a glance")[2].partition("\n## ")[0]
    named = at_a_glance.replace("`/", "`/v1/jobs/{id}/")  # short forms in the row of the results
    app = create_app(Settings(redis_url="redis://127.0.0.1:1"))
    for path in app.openapi()["paths"]:
        plain = path.replace("{job_id}", "{id}").replace("{frame}", "{t}")
        assert plain in at_a_glance or plain in named, f"{path} is not in the README"


def test_the_accuracy_table_is_filled_in() -> None:
    table = section("accuracy")
    for name in ("drink", "dinosaur", "dance", "facecap", "samba", "SMSR (paper)", "this code"):
        assert name in table


def test_pictures_and_pages_that_the_readme_names_are_there() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        page, _, anchor = target.partition("#")
        assert (ROOT / page).is_file(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", (ROOT / page).read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in headings}
    for folder in re.findall(r"`(docker/[\w./]+)`", README):
        assert (ROOT / folder).exists(), folder
    assert Path(ROOT / "docs/images/reconstruction.png").read_bytes().startswith(b"\x89PNG")


def test_all_who_build_the_page_are_told_the_same_version_of_node() -> None:
    package = json.loads((ROOT / "service" / "page" / "package.json").read_text(encoding="utf-8"))
    wanted = package["engines"]["node"].removeprefix(">=")
    for name in ("README.md", "CONTRIBUTING.md", "scripts/page", "service/routes/page.py"):
        told = re.findall(
            r"Node\.js (?:>= )?(\d[\d.]*\d)", (ROOT / name).read_text(encoding="utf-8")
        )
        assert told, name
        assert set(told) == {wanted}, name
