"""The OpenAPI document tells the errors that are really answered: problem details, and what every route may answer."""

from __future__ import annotations

from typing import Any, Final

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.guard import ALWAYS_ANSWERED

PROBLEM: Final = {"application/problem+json": {}}
EVERYWHERE: Final = {
    "401": "the service wants a key",
    "429": "one client asks for too much; `retry-after` says when to try again",
    "503": "the service is at its limit, or stops; `retry-after` says when to try again",
}
"""Of all routes but the probes."""


def describe_errors(app: FastAPI) -> None:
    """Make the document of ``app`` tell them."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = get_openapi(title=app.title, version=app.version, routes=app.routes)
            for path, methods in app.openapi_schema["paths"].items():
                for operation in methods.values():
                    _tell(path, operation["responses"])
        return app.openapi_schema

    app.openapi = document


def _tell(path: str, responses: dict[str, Any]) -> None:
    """Correct what the framework says of its own, and add what middleware answers."""
    protocol = path == "/v2" or path.startswith("/v2/")
    if "application/json" in responses.get("422", {}).get("content", {}):
        if protocol:  # which is answered with 400 there
            del responses["422"]
        else:
            responses["422"] = {"description": "the request cannot be used; `detail` says why", "content": PROBLEM}
    if path in ALWAYS_ANSWERED:
        return
    for status, text in EVERYWHERE.items():
        content = {"application/json": {}} if protocol else PROBLEM
        responses.setdefault(status, {"description": text, "content": content})
