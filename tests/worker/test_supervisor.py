"""The supervisor's connection to Redis."""

from __future__ import annotations

from typing import TYPE_CHECKING

from worker.connections import COMMAND_TIMEOUT, connect
from worker.supervisor import Supervisor

if TYPE_CHECKING:
    from worker.queue import JobQueue


def test_client_is_patient_enough_to_wait_for_a_job(queue: JobQueue, redis_url: str) -> None:
    """The wait for the next job lasts longer than any other command may."""
    supervisor = Supervisor(queue, connect(redis_url), "idle", lambda: None)
    connection = supervisor.connection.connection_pool.get_connection()
    assert supervisor.dequeue_timeout > COMMAND_TIMEOUT
    assert connection.socket_timeout is not None
    assert connection.socket_timeout > supervisor.dequeue_timeout
