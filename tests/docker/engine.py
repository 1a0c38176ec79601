"""Docker and Compose as the tests use them: the same commands that a person types."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

REPOSITORY = Path(__file__).parents[2]


class CommandFailed(AssertionError):
    """A command ended with an error; the message holds its output."""


def docker(*arguments: str, check: bool = True, timeout: float = 600) -> str:
    """Run ``docker`` and return its standard output without the last line's end."""
    return _run(["docker", *arguments], {}, check=check, timeout=timeout)


def logs(name: str) -> str:
    """Return the last lines that a container wrote, to either output."""
    done = subprocess.run(["docker", "logs", "--tail", "50", name], capture_output=True, text=True)
    return done.stdout + done.stderr


def inspect(name: str) -> dict[str, Any]:
    """Return what the engine knows of a container or an image."""
    described: dict[str, Any] = json.loads(docker("inspect", name))[0]
    return described


@dataclass(frozen=True)
class Compose:
    """A project of docker/compose.yaml.

    Attributes
    ----------
    project : str
        Its name, so that it does not touch another one on this engine.
    settings : mapping
        Variables of the file.
    files : tuple of Path
        Compose files, the later ones over the earlier.
    """

    project: str
    settings: Mapping[str, str]
    files: tuple[Path, ...] = (REPOSITORY / "docker" / "compose.yaml",)

    def __call__(self, *arguments: str, check: bool = True, timeout: float = 600) -> str:
        """Run ``docker compose``."""
        files = [word for file in self.files for word in ("--file", str(file))]
        return _run(
            ["docker", "compose", "--project-name", self.project, *files, *arguments],
            self.settings,
            check=check,
            timeout=timeout,
        )

    def up(self, workers: int) -> None:
        """Bring every service up, or back, and wait until all are healthy."""
        self("up", "--detach", "--wait", "--no-build", "--scale", f"worker={workers}")

    def containers(self, service: str) -> list[str]:
        """Return the ids of the running containers of a service."""
        return self("ps", "--quiet", "--status", "running", service).split()

    def container(self, service: str) -> str:
        """Return the id of the only running container of a service."""
        (found,) = self.containers(service)
        return found

    def leftovers(self) -> dict[str, list[str]]:
        """Return what the engine still has of this project."""
        label = f"label=com.docker.compose.project={self.project}"
        return {
            "containers": docker("ps", "--all", "--quiet", "--filter", label).split(),
            "volumes": docker("volume", "ls", "--quiet", "--filter", label).split(),
            "networks": docker("network", "ls", "--quiet", "--filter", label).split(),
        }


def _run(command: list[str], more: Mapping[str, str], *, check: bool, timeout: float) -> str:
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=os.environ | dict(more),
        stdin=subprocess.DEVNULL,
    )
    if check and done.returncode:
        raise CommandFailed(f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout.rstrip("\n")
