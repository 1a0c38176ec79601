from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import smsr
from smsr.files import SUFFIXES
from tests.service.conftest import ARRAY_LIMIT, UPLOAD_LIMIT, Api
from worker.options import JobOptions

if TYPE_CHECKING:
    import httpx


def test_info_tells_version_limits_formats_and_options(client: httpx.Client) -> None:
    info = client.get("/v1/info").json()
    assert info["version"] == smsr.__version__
    assert info["limits"]["upload_bytes"] == UPLOAD_LIMIT
    assert info["limits"]["array_bytes"] == ARRAY_LIMIT
    for role in ("measurements", "ground_truth", "faces"):
        assert [f".{name}" for name in info["formats"][role]] == list(SUFFIXES)
    options = {option["name"]: option for option in info["options"]}
    assert set(options) == {option.name for option in fields(JobOptions)}
    layout = options["layout"]
    assert layout["type"] == "string"
    assert layout["default"] in layout["choices"]
    assert options["time_limit"]["nullable"]
    assert options["time_limit"]["minimum"] == 1


def test_alive_and_ready(client: httpx.Client, api: Api, idle_api: Api) -> None:
    assert client.get("/healthz").json() == {"status": "alive"}
    ready = client.get("/readyz").json()
    assert ready["status"] == "ready"
    parts = ("redis", "storage", "disk", "workers", "maintenance")
    assert ready["checks"] == dict.fromkeys(parts, "ok")
    assert ready["workers"] == api.settings.workers
    with idle_api.client() as idle:
        ready = idle.get("/readyz").json()
        assert (ready["status"], ready["workers"]) == ("ready", 0)
        assert ready["checks"]["workers"] == "none lives: jobs wait"
    assert client.get("/healthz").headers["x-content-type-options"] == "nosniff"
