"""Errors on the wire: JSON problem details (RFC 9457), never a traceback."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from caphy.errors import CaphyError
from service.errors import Problem


def problem_response(
    status: int, detail: str, headers: Mapping[str, str] | None = None, path: str = "/"
) -> JSONResponse:
    """The body of an error; under ``/v2`` the Open Inference Protocol asks for another, and for 400 instead of 422."""
    if path == "/v2" or path.startswith("/v2/"):
        return JSONResponse({"error": detail}, 400 if status == 422 else status, headers=headers)
    title = HTTPStatus(status).phrase
    content = {"type": "about:blank", "title": title, "status": status, "detail": detail}
    return JSONResponse(content, status, headers=headers, media_type="application/problem+json")


def install(app: FastAPI) -> None:
    """Answer every error that ``app`` knows as problem details; service/observe.py answers those it does not."""

    @app.exception_handler(Problem)
    async def _(request: Request, error: Problem) -> JSONResponse:
        return problem_response(error.status, str(error), error.headers, request.url.path)

    @app.exception_handler(CaphyError)
    async def _(request: Request, error: CaphyError) -> JSONResponse:
        return problem_response(422, str(error), path=request.url.path)

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> JSONResponse:
        return problem_response(error.status_code, str(error.detail), error.headers, request.url.path)

    @app.exception_handler(RequestValidationError)
    async def _(request: Request, error: RequestValidationError) -> JSONResponse:
        detail = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        return problem_response(422, detail, path=request.url.path)
