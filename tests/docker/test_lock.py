"""What goes into the image is locked: versions and hashes of all that pyproject.toml asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

REPOSITORY = Path(__file__).parents[2]
LOCKS = {
    "docker/requirements.lock": tomllib.loads((REPOSITORY / "pyproject.toml").read_text())[
        "project"
    ]["dependencies"],
    "docker/build.lock": [
        line
        for line in (REPOSITORY / "docker" / "build.in").read_text().splitlines()
        if not line.startswith("#")
    ],
}
IMAGE = {"python_full_version": "3.11.9", "python_version": "3.11", "sys_platform": "linux"}


def entries(lock: str) -> list[tuple[Requirement, list[str]]]:
    """Each locked requirement with its hashes."""
    text = (REPOSITORY / lock).read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [
        (Requirement(line.split("--hash=")[0]), re.findall(r"--hash=sha256:([0-9a-f]{64})", line))
        for line in lines
    ]


def versions(lock: str) -> dict[str, Version]:
    """The version of each package that the image gets."""
    return {
        canonicalize_name(requirement.name): Version(str(requirement.specifier).removeprefix("=="))
        for requirement, _ in entries(lock)
        if requirement.marker is None or requirement.marker.evaluate(IMAGE)
    }


@pytest.mark.parametrize("lock", LOCKS)
def test_every_entry_has_one_version_and_hashes(lock: str) -> None:
    assert entries(lock)
    for requirement, hashes in entries(lock):
        assert [s.operator for s in requirement.specifier] == ["=="], requirement
        assert hashes, requirement


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_fits_what_is_asked_for(lock: str) -> None:
    """`scripts/lock` mends it."""
    locked = versions(lock)
    for line in LOCKS[lock]:
        wanted = Requirement(line)
        if wanted.marker is None or wanted.marker.evaluate(IMAGE):
            version = locked.get(canonicalize_name(wanted.name))
            assert version is not None, f"{lock} lacks {wanted.name}"
            assert wanted.specifier.contains(version), f"{lock} has {wanted.name} {version}"


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_names_no_index(lock: str) -> None:
    text = (REPOSITORY / lock).read_text()
    assert not re.search(r"://|--index-url|--extra-index-url|--find-links", text)
