"""Answers of many megabytes, sent part by part without a copy of the whole, to clients that take them in time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import anyio
import anyio.lowlevel
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

log = logging.getLogger("caphy.service")
PIECE: Final = 256 << 10
"""Bytes given to a connection at once; the next piece waits until the client has taken most of them."""


class PartsResponse(Response):
    """``parts`` one after another; what the client has not taken after ``seconds`` is dropped with the connection."""

    def __init__(
        self, parts: Sequence[bytes | memoryview], media_type: str, seconds: float, headers: Mapping[str, str] = {}
    ) -> None:
        super().__init__(None, media_type=media_type, headers=headers)
        self._parts = parts
        self._seconds = seconds
        self.headers["content-length"] = str(sum(len(part) for part in parts))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        try:
            with anyio.fail_after(self._seconds):
                for piece, is_last in self._pieces():
                    await send({"type": "http.response.body", "body": piece, "more_body": not is_last})
                    await anyio.lowlevel.checkpoint()  # else nobody would hear that the client has gone
        except TimeoutError:  # returning before the last piece closes the connection
            log.warning("a client did not take its answer in time", extra={"seconds": self._seconds})
            scope["state"]["hold"].guard.metrics.refused.labels("slow_reader").inc()

    def _pieces(self) -> Iterator[tuple[bytes, bool]]:
        """Small parts joined, large ones cut, and whether a piece is the last."""
        left = total = sum(len(part) for part in self._parts)
        gathered, size = [], 0
        for part in self._parts:
            view = memoryview(part)
            while view:
                gathered.append(view[: PIECE - size])
                view = view[PIECE - size :]
                size = sum(len(found) for found in gathered)
                if size == PIECE:
                    left -= size
                    yield b"".join(gathered), not left
                    gathered, size = [], 0
        if left or not total:
            yield b"".join(gathered), True
