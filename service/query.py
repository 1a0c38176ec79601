"""Queries of requests: a parameter that a route does not know is refused, not ignored."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

from fastapi import Depends, Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Query

from service.problems import Problem, example_responses
from smsr.errors import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fastapi.routing import APIRoute

RESPONSES = example_responses("invalid-request")
"""Of a route whose queries are checked, in the OpenAPI document."""

_NAME_LENGTH = 60
_MOST = 10
"""Parameters that one answer is about."""


async def _check(request: Request) -> None:
    """Refuse a query with a parameter that its route does not declare, or with one of them twice.

    A misspelt filter would give more than was asked for, and of two values one would be lost.
    """
    if not request.scope["query_string"]:
        return
    given = [name for name, _ in request.query_params.multi_items()]
    known = parameters_of(request.scope["route"])
    wrong = list(islice(_wrong(given, known), _MOST))
    if wrong:
        found = " ".join(detail for _, detail in wrong)
        listed = f"Parameters here are {', '.join(known)}." if known else "Here are no parameters."
        raise Problem(
            "invalid-request",
            f"{found} {listed}",
            errors=[{"in": "query", "name": name, "detail": detail} for name, detail in wrong],
            parameters=known,
        )


CHECKED = Depends(_check)
"""Makes routes check their queries."""


def parameters_of(route: APIRoute) -> list[str]:
    """Return the names of the query parameters that a route and its dependencies declare."""
    fields = get_flat_params(route.dependant)
    return [field.alias for field in fields if isinstance(field.field_info, Query)]


def _wrong(given: Sequence[str], known: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each name that is wrong in a query, and what is wrong."""
    for name in dict.fromkeys(given):
        shown = name[:_NAME_LENGTH]
        if name not in known:
            yield shown, f"There is no parameter {shown!r}.{did_you_mean(shown, known)}"
        elif given.count(name) > 1:
            yield shown, f"The parameter {name!r} takes one value and was given several."
