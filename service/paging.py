"""Listings in pages: their parameters, and the link to the next one (RFC 8288)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias
from urllib.parse import urlencode

from fastapi import Query

from service.problems import Problem, example_responses

if TYPE_CHECKING:
    from starlette.responses import Response

PAGE_SIZE = 200
"""Largest `limit` of a listing."""

Cursor: TypeAlias = Annotated[
    str | None, Query(max_length=100, description="From `next` of the page before.")
]

RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "headers": {
            "Link": {
                "schema": {"type": "string"},
                "description": 'The next page, rel="next" (RFC 8288), where there is one.',
            }
        }
    },
    **example_responses("invalid-request", "queue-unavailable"),
}
"""Of a route that lists, in the OpenAPI document."""


def foreign_cursor(cursor: str | None) -> Problem:
    """Return the refusal of a cursor that no page gave."""
    return Problem("invalid-request", f"query cursor: {cursor!r} was not given by a page before.")


def link_next(response: Response, path: str, cursor: str | None, **query: object) -> str | None:
    """Name the next page in the Link header of an answer and return its path, None for the last.

    Parameters
    ----------
    response : Response
    path : str
        Of the listing, with the prefix under which the service is reached.
    cursor : str or None
        Where the next page begins; None where there is none.
    **query
        The other parameters of the request; those that are None were not given.
    """
    if cursor is None:
        return None
    given = {name: value for name, value in query.items() if value is not None}
    following = f"{path}?{urlencode(given | {'cursor': cursor})}"
    response.headers["Link"] = f'<{following}>; rel="next"'
    return following
