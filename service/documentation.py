"""The interactive documentation of the API, whose inline script is named in its policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fastapi.openapi.docs import get_swagger_ui_html

from service.context import root_of
from service.security import policy_of_document

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.requests import Request
    from starlette.responses import HTMLResponse

_FILES = "/static-offline-docs"
"""Where fastapi-offline serves what the page is made of."""


def install(app: FastAPI) -> None:
    """Serve the documentation of an application at ``/docs``."""

    async def page(request: Request) -> HTMLResponse:
        root = root_of(request)
        answer = get_swagger_ui_html(
            openapi_url=f"{root}{app.openapi_url}",
            title=f"{app.title}: API",
            swagger_js_url=f"{root}{_FILES}/swagger-ui-bundle.js",
            swagger_css_url=f"{root}{_FILES}/swagger-ui.css",
            swagger_favicon_url=f"{root}{_FILES}/favicon.png",
        )
        # Swagger UI sets styles on elements; its script is a file and the few lines of the page.
        policy = policy_of_document(bytes(answer.body).decode()).replace(
            "style-src 'self'", "style-src 'self' 'unsafe-inline'"
        )
        answer.headers["Content-Security-Policy"] = policy
        return answer

    app.add_route("/docs", page, methods=["GET"], include_in_schema=False)
