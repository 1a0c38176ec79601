"""Running the API with uvicorn on a socket that is bound already."""

from __future__ import annotations

from typing import TYPE_CHECKING

import uvicorn
from uvicorn.config import STARTUP_FAILURE

from service.app import create_app

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from worker.settings import Settings


class _Server(uvicorn.Server):
    """Uvicorn that tells when it is ready, and when it begins to stop."""

    def __init__(
        self, config: uvicorn.Config, ready: Callable[[], object], stopping: Callable[[], object]
    ) -> None:
        super().__init__(config)
        self._ready = ready
        self._stopping = stopping

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._stopping()
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._ready()


def run_server(settings: Settings, listener: socket.socket, ready: Callable[[], object]) -> bool:
    """Serve until SIGINT or SIGTERM, which uvicorn sends on to this process when it is done.

    Parameters
    ----------
    settings : Settings
        With a `redis_url`.
    listener : socket
        Bound.
    ready : callable
        Called once requests are answered.

    Returns
    -------
    bool
        False where the service could not start; the log says why.
    """
    app = create_app(settings, address=listener.getsockname()[0])
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=settings.drain_seconds,
    )
    server = _Server(config, ready, lambda: app.state.context.feed.release())
    try:
        server.run(sockets=[listener])
    except SystemExit as stop:
        # Uvicorn's own status, which among those of the command says that an input was refused.
        if stop.code != STARTUP_FAILURE:
            raise
    return server.started
