#!/opt/smsr/bin/python
"""Healthy when what process 1 runs does its work: the API is ready, or a worker is registered."""

import os
import socket
import sys
import urllib.request
from pathlib import Path

PORT = os.environ.get("SMSR_PORT", "8000")


def api_is_ready() -> bool:
    """Ask the API of this container."""
    with urllib.request.urlopen(f"http://127.0.0.1:{PORT}/readyz", timeout=4) as answer:
        return bool(answer.status == 200)


def worker_is_registered() -> bool:
    """Look in Redis for a worker of this container; its entry there goes when it falls silent."""
    from rq.worker_registration import get_keys

    from worker.queue import JobQueue
    from worker.settings import Settings

    queue = JobQueue(Settings())
    here = socket.gethostname().encode()
    return any(queue.redis.hget(key, "hostname") == here for key in get_keys(queue=queue.rq))


def healthy() -> bool:
    """Look after what this container was started for."""
    command = Path("/proc/1/cmdline").read_bytes().split(b"\0")
    return worker_is_registered() if b"worker" in command else api_is_ready()


if __name__ == "__main__":
    try:
        sys.exit(0 if healthy() else 1)
    except OSError as error:
        sys.exit(f"{type(error).__name__}: {error}")
