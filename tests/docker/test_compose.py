"""The compose files: closed, limited and watched; settings that the code reads."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from worker.settings import Settings

DOCKER = Path(__file__).parents[2] / "docker"
FILES = ("compose.yaml", "compose.s3.yaml")
OURS = ("api", "worker")

Service = dict[str, Any]


def services(name: str) -> dict[str, Service]:
    loaded: dict[str, Service] = yaml.safe_load((DOCKER / name).read_text())["services"]
    return loaded


def all_services() -> list[tuple[str, str]]:
    return [(file, name) for file in FILES for name in services(file)]


@pytest.mark.parametrize(("file", "name"), all_services())
def test_each_service_is_limited_and_watched(file: str, name: str) -> None:
    base = services("compose.yaml")
    service = {**base.get(name, {}), **services(file)[name]}
    limits = service["deploy"]["resources"]["limits"]
    assert {"cpus", "memory"} == limits.keys()
    assert service["restart"] == "unless-stopped"
    assert "no-new-privileges:true" in service["security_opt"]
    assert "pull_policy" not in service
    # The image of the application brings its own.
    assert name in OURS or {"test", "interval", "timeout"} <= service["healthcheck"].keys()


@pytest.mark.parametrize("name", ["redis", *OURS])
def test_containers_are_closed(name: str) -> None:
    service = services("compose.yaml")[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]


def test_only_this_machine_is_served_unless_asked() -> None:
    for file, name in all_services():
        for port in services(file)[name].get("ports", []):
            assert port.startswith(("127.0.0.1:", "${SMSR_ADDRESS:-127.0.0.1}:"))


def test_redis_keeps_what_it_accepted() -> None:
    command = services("compose.yaml")["redis"]["command"]
    for words in ("--appendonly yes", "--appendfsync always", "--maxmemory-policy noeviction"):
        assert words in command


@pytest.mark.parametrize("file", FILES)
def test_settings_are_ones_that_the_code_reads(file: str) -> None:
    known = {f"SMSR_{name.upper()}" for name in Settings.model_fields}
    for name in OURS:
        environment = services(file)[name]["environment"]
        ours = {key: value for key, value in environment.items() if key.startswith("SMSR_")}
        assert ours.keys() <= known
        defaults = {
            key.removeprefix("SMSR_").lower(): re.sub(r"^\$\{\w+:-(.*)\}$", r"\1", value)
            for key, value in ours.items()
        }
        Settings.model_validate(defaults)


def test_system_units_set_what_the_code_reads() -> None:
    known = {f"SMSR_{name.upper()}" for name in Settings.model_fields} | {"REDIS_URL"}
    text = "\n".join(path.read_text() for path in (DOCKER / "systemd").iterdir())
    assert set(re.findall(r"\b(?:SMSR_[A-Z_]+|REDIS_URL)(?==)", text)) <= known


def test_who_may_use_the_service_is_said_by_name() -> None:
    environment = services("compose.yaml")["api"]["environment"]
    assert environment["SMSR_ACCESS"] == "${SMSR_ACCESS:-open}"
    example = (DOCKER / "systemd" / "smsr.env.example").read_text()
    assert re.search("^SMSR_ACCESS=keys$", example, re.MULTILINE)


def test_images_are_pinned() -> None:
    for file, name in all_services():
        image = services(file)[name].get("image", "")
        if image and not image.startswith("${SMSR_IMAGE"):
            assert re.search(r":v?\d+[\w.-]*$", image), image


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_system_units_are_well_formed(tmp_path: Path) -> None:
    for unit in (DOCKER / "systemd").glob("*.service"):
        copy = tmp_path / unit.name.replace("@", "@1")
        # It looks for the command too, which is not installed here.
        copy.write_text(
            re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", unit.read_text(), flags=re.M)
        )
        found = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", copy], capture_output=True, text=True
        )
        complaints = [line for line in found.stderr.splitlines() if copy.name in line]
        assert complaints == []
