"""The address of a server, checked before anything is asked of it."""

from __future__ import annotations

import re

import httpx

from smsr_client.errors import WrongAddress

_WITHOUT_SCHEME = re.compile(r"(?:[\w.-]+|\[[\da-fA-F:.]+\])(?::\d+)?(?:/\S*)?")


def server_address(server: str) -> str:
    """Return an address without a slash at its end.

    Parameters
    ----------
    server : str
        An http:// or https:// address, which may have a path.

    Raises
    ------
    WrongAddress
        It is none; the message says how it is written, where that can be guessed.
    """
    if _usable(server):
        return server.rstrip("/")
    likely = f"http://{server}"
    if _WITHOUT_SCHEME.fullmatch(server) and _usable(likely):
        right = f"write {likely}"
    else:
        right = (
            "write http:// or https://, a host, and where needed a port of 1 to 65535, as "
            "http://127.0.0.1:8000"
        )
    raise WrongAddress(f"{server!r} is no address of a server: {right}.")


def _usable(address: str) -> bool:
    try:
        url = httpx.URL(address)
        # A blank in a host would only be escaped.
        named = bool(url.host) and "%" not in url.host
    except (httpx.InvalidURL, ValueError):  # the latter where a name cannot be encoded (IDNA)
        return False
    port = 80 if url.port is None else url.port
    return url.scheme in ("http", "https") and named and 0 < port < 1 << 16
