"""The web page, as Vite built it; the sources are in service/page."""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, Response

from service.problems import Problem

BUILT = Path(__file__).parents[1] / "page" / "dist"

SECURITY_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""Content-Security-Policy of the page: everything comes from here, and nothing stands inline."""

_HEADERS = {
    "Content-Security-Policy": SECURITY_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_NOT_BUILT = b"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>SMSR</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"></head>
<body><h1>SMSR</h1>
<p>The service runs. Its web page has not been built: <code>make page</code> does so, and needs
Node.js 20.19 or later.</p>
<p>All that the page does the API does too: <a href="docs">its documentation</a>.</p>
</body></html>
"""

_YEAR = 365 * 24 * 3600
_SMALL = 500
"""Bytes below which compression is not worth its headers."""

router = APIRouter(include_in_schema=False)


@dataclass(frozen=True, slots=True)
class _File:
    """A file of the page, ready to be sent."""

    content: bytes
    compressed: bytes | None
    media_type: str
    tag: str


@lru_cache(maxsize=64)
def _load(path: Path, changed: int) -> _File:  # noqa: ARG001  (a page that is built anew is read anew)
    content = path.read_bytes()
    media_type = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    if media_type.startswith("text/") or path.suffix == ".js":
        # RFC 9239 names text/javascript, which old tables of types lack.
        media_type = "text/javascript" if path.suffix == ".js" else media_type
        media_type += "; charset=utf-8"
    compressed = gzip.compress(content, mtime=0) if len(content) > _SMALL else None
    return _File(content, compressed, media_type, hashlib.sha256(content).hexdigest()[:32])


def _answer(path: Path, accepted: str, known: str, cached: str) -> Response:
    file = _load(path, path.stat().st_mtime_ns)
    zipped = file.compressed if "gzip" in accepted else None
    # Another encoding is another representation, with a tag of its own (RFC 9110, section 8.8.3).
    tag = f'"{file.tag}{"-gzip" if zipped else ""}"'
    headers = {**_HEADERS, "ETag": tag, "Cache-Control": cached, "Vary": "Accept-Encoding"}
    if tag in {part.strip().removeprefix("W/") for part in known.split(",")}:
        return Response(status_code=304, headers=headers)
    if zipped:
        headers["Content-Encoding"] = "gzip"
    return Response(zipped or file.content, headers=headers, media_type=file.media_type)


_Accepted = Annotated[str, Header(alias="accept-encoding")]
_Known = Annotated[str, Header(alias="if-none-match")]


@router.get("/")
def get_page(accepted: _Accepted = "", known: _Known = "") -> Response:
    """Return the page; where it has not been built, one that says so."""
    index = BUILT / "index.html"
    if not index.is_file():
        return Response(_NOT_BUILT, media_type="text/html; charset=utf-8", headers=_HEADERS)
    return _answer(index, accepted, known, "no-cache")


@router.get("/assets/{name}")
def get_asset(name: str, accepted: _Accepted = "", known: _Known = "") -> Response:
    """Return a script, a style sheet or an icon; their names hold a hash of what is in them."""
    folder = BUILT / "assets"
    known_names = {path.name: path for path in folder.iterdir()} if folder.is_dir() else {}
    path = known_names.get(name)  # looked up, so that no name leads elsewhere
    if path is None:
        raise Problem("not-found", f"The service has no /assets/{name}.")
    return _answer(path, accepted, known, f"public, max-age={_YEAR}, immutable")
