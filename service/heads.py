"""Middleware: HEAD is answered wherever GET is, as RFC 9110 has it; the server leaves the content out."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send


class Heads:
    """Asks for what GET would give; files, which know HEAD themselves, are asked as they are."""

    def __init__(self, app: ASGIApp, except_below: str) -> None:
        self._app = app
        self._except = except_below

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD" or scope["path"].startswith(self._except):
            return await self._app(scope, receive, send)
        asked = {**scope, "method": "GET"}
        try:
            await self._app(asked, receive, send)
        finally:
            if "route" in asked:  # by which it is counted
                scope["route"] = asked["route"]
