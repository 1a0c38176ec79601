#!/opt/smsr/bin/python
"""Healthy when what process 1 runs does its work: the API is ready, or the worker is alive."""

import os
import re
import socket
import sys
import urllib.request
from pathlib import Path

WORKERS = "smsr:workers"
"""Sorted set of the names of workers, each begun with its host's, by their last sign of life."""


def api_is_ready(port: str) -> bool:
    """Ask the API of this container."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=4) as answer:
        return bool(answer.status == 200)


def worker_is_alive(silence: float = 15.0) -> bool:
    """Look in Redis for a worker of this container."""
    from redis import Redis  # half a second of work, and the API's check needs none of it

    url = os.environ.get("SMSR_REDIS_URL") or os.environ["REDIS_URL"]
    redis = Redis.from_url(url, socket_timeout=4, socket_connect_timeout=4, decode_responses=True)
    seconds, _ = redis.time()
    names = redis.zrange(WORKERS, seconds - silence, "+inf", byscore=True)
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname())
    return any(str(name).startswith(f"{host}-") for name in names)


def healthy() -> bool:
    """Look after what this container was started for."""
    command = Path("/proc/1/cmdline").read_text().split("\0")
    if "serve" not in command:
        return worker_is_alive()
    return api_is_ready(command[command.index("--port") + 1] if "--port" in command else "8000")


if __name__ == "__main__":
    try:
        sys.exit(0 if healthy() else 1)
    except OSError as error:
        sys.exit(f"{type(error).__name__}: {error}")
