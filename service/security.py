"""Headers that keep browsers from doing more with an answer than was meant."""

from __future__ import annotations

import base64
import hashlib
import re
from typing import TYPE_CHECKING

from starlette.datastructures import Headers, MutableHeaders

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_FRAME = "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"

NOTHING = f"default-src 'none'; {_FRAME}"
"""Policy of answers that are data: a browser that shows one loads and runs nothing."""

PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "font-src 'self'; connect-src 'self' blob:; worker-src 'self' blob:; manifest-src 'self'; "
    f"{_FRAME}"
)
"""Policy of pages and of what they are made of: files of this service, no inline scripts. Scripts
have it too, for one that is started as a worker is bound by its own answer's policy."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""On every answer."""

_OF_PAGES = ("text/html", "text/css", "text/javascript", "application/javascript")
_INLINE = re.compile(r"<(script|style)>(.*?)</\1>", re.DOTALL)


def policy_of_document(html: str) -> str:
    """Return the policy of a page whose inline scripts and styles are all meant to be there.

    Parameters
    ----------
    html : str
        What is sent, made from nothing that a request says.
    """
    hashes: dict[str, list[str]] = {"script": [], "style": []}
    for kind, text in _INLINE.findall(html):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        hashes[kind].append(f" 'sha256-{digest}'")
    script, style = "".join(hashes["script"]), "".join(hashes["style"])
    return (
        f"default-src 'none'; script-src 'self'{script}; style-src 'self'{style}; "
        f"img-src 'self' data:; connect-src 'self'; {_FRAME}"
    )


class SecurityHeaders:
    """Adds `HEADERS`, a content security policy, and who may keep a copy, where they are missing.

    Parameters
    ----------
    app : ASGIApp
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""

        async def send_marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                message.setdefault("headers", [])
                protect(MutableHeaders(scope=message), scope["path"])
            await send(message)

        await self.app(scope, receive, send_marked if scope["type"] == "http" else send)


def protect(headers: MutableHeaders, path: str) -> None:
    """Complete the headers of an answer.

    Parameters
    ----------
    headers : MutableHeaders
    path : str
        Of the request.
    """
    for name, value in HEADERS.items():
        headers.setdefault(name, value)
    kind = headers.get("content-type", "").partition(";")[0].strip()
    of_api = "/v1/" in f"{path}/"
    headers.setdefault(
        "Content-Security-Policy", PAGE if kind in _OF_PAGES and not of_api else NOTHING
    )
    if of_api or kind == "application/problem+json":
        # What has a validator may be kept by the one who asked; other documents go stale at once.
        headers.setdefault("Cache-Control", _cache_control(headers, kind))


def _cache_control(headers: Headers, kind: str) -> str:
    if "etag" in headers or not kind.endswith("json"):
        return "private"
    return "no-store"
