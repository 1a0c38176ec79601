"""What the types of problem documents mean, for a person who followed one."""

from html import escape
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from service.context import root_of
from service.problems import CATALOGUE, Problem, ProblemType, example_responses
from service.security import policy_of_document
from smsr_client.documents import ProblemTypeDocument

router = APIRouter(prefix="/problems", tags=["service"])

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>body{{font:1rem/1.5 system-ui,sans-serif;max-width:44rem;margin:2rem auto;padding:0 1rem;
color-scheme:light dark}}dt{{font-weight:600;margin-top:1rem}}dd{{margin:0}}</style></head>
<body>{body}</body></html>
"""

_NEGOTIATED = {"Vary": "Accept"}
_FOR_BROWSERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/html": {"schema": {"type": "string"}}}}
}


def _page(title: str, body: str) -> HTMLResponse:
    """Return a page whose only inline parts, by its policy, are those of the template."""
    policy = policy_of_document(_PAGE.format(title="", body=""))
    text = _PAGE.format(title=title, body=body)
    return HTMLResponse(text, headers=_NEGOTIATED | {"Content-Security-Policy": policy})


def _document(kind: ProblemType, root: str) -> ProblemTypeDocument:
    return ProblemTypeDocument(
        type=root + kind.uri,
        title=kind.title,
        status=kind.status,
        meaning=kind.meaning,
        remedy=kind.remedy,
    )


def _wants_html(request: Request) -> bool:
    return "text/html" in request.headers.get("accept", "")


@router.get(
    "",
    summary="All problem types",
    response_model=list[ProblemTypeDocument],
    responses=_FOR_BROWSERS,
    tags=["problems"],
)
async def all_problems(request: Request) -> Response:
    """List all types of problem documents: HTML for browsers, JSON otherwise."""
    root = root_of(request)
    kinds = sorted(CATALOGUE.values(), key=lambda kind: kind.slug)
    if not _wants_html(request):
        documents = [_document(kind, root).model_dump() for kind in kinds]
        return JSONResponse(documents, headers=_NEGOTIATED)
    entries = "".join(
        f'<dt><a href="{escape(root + kind.uri)}">{escape(kind.slug)}</a> ({kind.status})</dt>'
        f"<dd>{escape(kind.title)}</dd>"
        for kind in kinds
    )
    return _page("Problems", f"<h1>Problems</h1><dl>{entries}</dl>")


@router.get(
    "/{slug}",
    summary="A problem type",
    response_model=ProblemTypeDocument,
    responses=_FOR_BROWSERS | example_responses("unknown-problem"),
    tags=["problems"],
)
async def one_problem(request: Request, slug: str) -> Response:
    """Say when a problem happens and what to do: HTML for browsers, JSON otherwise."""
    kind = CATALOGUE.get(slug)
    if kind is None:
        raise Problem("unknown-problem", "There is no such problem type; see /problems.")
    root = root_of(request)
    if not _wants_html(request):
        return JSONResponse(_document(kind, root).model_dump(), headers=_NEGOTIATED)
    body = (
        f"<h1>{escape(kind.title)}</h1>"
        f"<dl><dt>Type</dt><dd><code>{escape(root + kind.uri)}</code></dd>"
        f"<dt>Status</dt><dd>{kind.status}</dd>"
        f"<dt>Meaning</dt><dd>{escape(kind.meaning)}</dd>"
        f"<dt>Remedy</dt><dd>{escape(kind.remedy)}</dd></dl>"
        f'<p><a href="{escape(root)}/problems">All problems</a></p>'
    )
    return _page(escape(kind.title), body)
