"""Who may ask: everybody, or whoever sends one of the keys.

The key comes as ``authorization: Bearer KEY`` or ``x-api-key: KEY``. A browser cannot set headers of a WebSocket, so
there it may come as a subprotocol: ``new WebSocket(url, ["caphy", "caphy.key." + base64url(KEY)])``; the answer chooses
``caphy``.
"""

from __future__ import annotations

import binascii
import hmac
from base64 import urlsafe_b64decode
from collections.abc import Sequence
from typing import Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.guard import ALWAYS_ANSWERED
from service.problem import problem_response

SUBPROTOCOL: Final = "caphy"
KEY_SUBPROTOCOL: Final = "caphy.key."
UNAUTHORISED: Final = "this service wants a key: send it as 'authorization: Bearer KEY' or 'x-api-key: KEY'"
POLICY_VIOLATION: Final = 1008


class RequireKey:
    """Middleware: whatever is neither a probe nor under ``public`` needs one of ``keys``, HTTP and WebSocket alike."""

    def __init__(self, app: ASGIApp, keys: Sequence[str], public: tuple[str, ...] = ()) -> None:
        self._app = app
        self._keys = [encoded for key in keys for encoded in _as_sent(key)]
        self._public = public

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it before its body is read."""
        if scope["type"] == "http":
            if self._is_public(scope["path"]) or self._knows(scope):
                return await self._app(scope, receive, send)
            headers = {"www-authenticate": "Bearer"}
            return await problem_response(401, UNAUTHORISED, headers, scope["path"])(scope, receive, send)
        if scope["type"] == "websocket" and not self._knows(scope):
            return await _turned_away(scope, receive, send)
        return await self._app(scope, receive, send)

    def _is_public(self, path: str) -> bool:
        return path in ALWAYS_ANSWERED or path in self._public or path.startswith(_folders(self._public))

    def _knows(self, scope: Scope) -> bool:
        headers = Headers(scope=scope)
        kind, _, bearer = headers.get("authorization", "").partition(" ")
        sent = [bearer.strip() if kind.lower() == "bearer" else "", headers.get("x-api-key", "")]
        offered = [key.encode("latin-1") for key in sent]
        if scope["type"] == "websocket":
            offered += [_decoded(name) for name in scope.get("subprotocols", ()) if name.startswith(KEY_SUBPROTOCOL)]
        matches = [hmac.compare_digest(key, known) for key in offered for known in self._keys]
        return any(matches)  # of a list: all are compared, whichever matches


def _as_sent(key: str) -> set[bytes]:
    """A key as clients send it: some write headers as UTF-8, others as Latin-1."""
    return {key.encode()} | ({key.encode("latin-1")} if max(map(ord, key), default=0) < 256 else set())


async def _turned_away(scope: Scope, receive: Receive, send: Send) -> None:
    """Accept a WebSocket and close it: one that is refused before tells a browser neither a code nor a reason."""
    await receive()
    chosen = SUBPROTOCOL if SUBPROTOCOL in scope.get("subprotocols", ()) else None
    await send({"type": "websocket.accept", "subprotocol": chosen})
    await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": UNAUTHORISED[:120]})


class Subprotocol:
    """Middleware: chooses the subprotocol ``caphy`` where a browser offers it, as it must hear one of those it sent."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "websocket" or SUBPROTOCOL not in scope.get("subprotocols", ()):
            return await self._app(scope, receive, send)

        async def choosing(message: Message) -> None:
            if message["type"] == "websocket.accept" and not message.get("subprotocol"):
                message = {**message, "subprotocol": SUBPROTOCOL}
            await send(message)

        return await self._app(scope, receive, choosing)


def _folders(paths: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(path for path in paths if path.endswith("/") and path != "/")


def _decoded(subprotocol: str) -> bytes:
    encoded = subprotocol.removeprefix(KEY_SUBPROTOCOL)
    try:
        return urlsafe_b64decode(encoded + "=" * (-len(encoded) % 4))
    except (binascii.Error, ValueError):
        return b""
