"""Damaged files of every format, sent as what a job can be made of."""

from __future__ import annotations

import logging
import random
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from service.problems import CATALOGUE
from smsr_client import Client, ServiceError
from tests.conftest import redis_running
from tests.damage import CASES, SOUND, mutated
from tests.service.conftest import api_running, settings_for
from worker.pool import WorkerPool

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.service.conftest import Api

log = logging.getLogger(__name__)

ROLES = ("measurements", "measurements", "ground_truth", "faces")
JOB_MEMORY = 256 << 20
ARRAY_LIMIT = 1 << 20
API_GROWTH = 64 << 20


def damaged(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield damaged files, each in a folder of its own, and what they are sent as."""
    random_ = random.Random(0)
    for number in range(CASES or 6):
        for name, sound in SOUND.items():
            path = folder / f"{number}-{name}" / name
            path.parent.mkdir()
            path.write_bytes(mutated(sound(), random_))
            yield path, random_.choice(ROLES)


def outcome(api: Api, sound: Path, path: Path, role: str) -> str:
    """Send a file; return how that ended."""
    files = {"measurements": sound} | {role: path}
    with Client(api.url, patience=0) as client:
        try:
            job = client.submit(files.pop("measurements"), **files)  # type: ignore[arg-type]
        except ServiceError as error:
            assert 400 <= error.status < 500, (path, error)
            assert error.slug in CATALOGUE, (path, error)
            return "refused"
        job = client.wait(job.id, timeout=120)
        assert job.attempt == 1, (path, "its work-horse died")
        if job.problem is not None:
            slug = job.problem.type.rpartition("/")[2]
            assert CATALOGUE[slug].status < 500, (path, job.problem)
        path.unlink()
        return job.status


@pytest.mark.slow
def test_damaged_files_are_refused_or_fail_and_hurt_nobody(tmp_path: Path) -> None:
    """Files with which this fails are kept in the test's folder."""
    with redis_running(tmp_path) as redis:
        settings = settings_for(
            tmp_path, redis, max_array_bytes=ARRAY_LIMIT, job_memory_bytes=JOB_MEMORY, workers=2
        )
        sound = tmp_path / "c.npy"
        sound.write_bytes(SOUND["c.npy"]())
        with (
            api_running(settings, redis, tmp_path / "log") as api,
            WorkerPool(settings, 2) as pool,
            ThreadPoolExecutor(4) as senders,
        ):
            with Client(api.url) as client:
                assert client.wait(client.submit(sound).id, timeout=60).status == "succeeded"
            workers, before = pool.pids, api.resident()
            made = damaged(tmp_path)

            def send(file: tuple[Path, str]) -> str:
                return outcome(api, sound, *file)

            ended = Counter(senders.map(send, made))
            log.info("%s", dict(ended))
            assert ended["refused"] > 0
            assert ended["failed"] > 0
            assert ended.total() == (CASES or 6) * len(SOUND)
            assert pool.pids == workers
            assert api.resident() - before < API_GROWTH
            assert "Traceback" not in api.log.read_text()
