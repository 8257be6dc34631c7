"""Middleware around everything: gives each request an id, logs it, counts it, times it, and answers its failure."""

from __future__ import annotations

import asyncio
import logging
import re
from time import perf_counter
from typing import Any, Final
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs import request_id
from service.metrics import Metrics
from service.problem import problem_response

log = logging.getLogger("caphy.service.requests")
ID_HEADER: Final = "x-request-id"
ID_PATTERN: Final = re.compile(r"[A-Za-z0-9._:+/=-]{1,128}")
METHODS: Final = frozenset({"GET", "POST", "HEAD", "OPTIONS", "PUT", "PATCH", "DELETE"})


class Observed:
    """Takes ``x-request-id`` where the client sends a usable one, else makes one; every answer carries it.

    Answers are logged at level debug below status 400, info below 500, and error from there.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        sent = Headers(scope=scope).get(ID_HEADER, "")
        identifier = sent if ID_PATTERN.fullmatch(sent) else uuid4().hex
        token = request_id.set(identifier)
        try:
            if scope["type"] == "http":
                await self._observe(scope, receive, send, identifier)
            else:
                await self._app(scope, receive, send)
        finally:
            request_id.reset(token)

    async def _observe(self, scope: Scope, receive: Receive, send: Send, identifier: str) -> None:
        status, answering, started = 500, False, perf_counter()

        async def noting(message: Message) -> None:
            nonlocal status, answering
            if message["type"] == "http.response.start":
                status, answering = message["status"], True
                MutableHeaders(scope=message)[ID_HEADER] = identifier
            await send(message)

        try:
            await self._app(scope, receive, noting)
        except asyncio.CancelledError:  # the time that a stop leaves to what is in flight is over
            if not answering:
                status = 503
                stopped = problem_response(503, "the service stops; send it again", {"retry-after": "1"}, scope["path"])
                await stopped(scope, receive, noting)
        except Exception:
            log.exception("%s %s failed", scope["method"], scope["path"][:200])
            if answering:
                raise
            failed = problem_response(500, "the service failed on this request; its log says why", None, scope["path"])
            await failed(scope, receive, noting)
        finally:
            self._note(scope, status, perf_counter() - started)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "unknown")
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._metrics.requests.labels(route, method, str(status)).inc()
        self._metrics.request_seconds.labels(route).observe(seconds)
        level = logging.DEBUG if status < 400 else logging.INFO if status < 500 else logging.ERROR
        if log.isEnabledFor(level):
            log.log(level, "%s %s", method, scope["path"][:200], extra=_facts(scope, status, seconds))


def _facts(scope: Scope, status: int, seconds: float) -> dict[str, Any]:
    client = scope.get("client") or ("unknown", 0)
    return {"status": status, "milliseconds": round(1e3 * seconds, 3), "client": client[0]}
