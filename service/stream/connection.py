"""One WebSocket: reads at a bounded rate, sends at the client's pace, and notices who is gone."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from time import monotonic
from typing import Final

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect

from caphy.errors import CaphyError
from service.errors import Problem
from service.stream.limits import StreamLimits
from service.stream.messages import Failure, Hello, Poses, decode_client, encode_failure
from service.stream.scheduler import Member, Scheduler
from service.stream.session import Session

log = logging.getLogger("caphy.service")
OUTBOX: Final = 64
"""Messages to a client that does not take them before no more are read from it."""


class StreamError(CaphyError):
    """The stream ends; ``code`` is HTTP's for the reason, and 4000 more the WebSocket's close code."""

    def __init__(self, code: int, text: str, number: int = 0) -> None:
        super().__init__(text)
        self.code = code
        self.number = number


async def answered(websocket: WebSocket, serve: Callable[[], Awaitable[None]]) -> None:
    """Accept a WebSocket and serve it; whatever ends that is told to the client."""
    await websocket.accept()
    try:
        await serve()
    except WebSocketDisconnect:
        pass
    except StreamError as error:
        await _close(websocket, error)
    except Exception:
        log.exception("a WebSocket of %s failed", websocket.url.path[:100])
        await _close(websocket, StreamError(500, "the service failed on this stream; its log says why"))


async def _close(websocket: WebSocket, error: StreamError) -> None:
    """Say why, and close; whoever does not listen any more is left."""
    try:
        async with asyncio.timeout(1.0):
            await websocket.send_bytes(encode_failure(Failure(error.code, str(error), error.number)))
            await websocket.close(4000 + error.code, str(error)[:120])
    except Exception:
        log.debug("a stream's client was gone before it was told %s", error, exc_info=True)


class Connection:
    """Both directions of a stream's WebSocket."""

    def __init__(self, websocket: WebSocket, limits: StreamLimits) -> None:
        self._websocket = websocket
        self._limits = limits
        self._outbox: deque[bytes] = deque()
        self._moved = asyncio.Event()
        self._heard = monotonic()
        self._sending: float | None = None
        self._allowance = Allowance(limits.max_rate, limits.burst)
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def post(self, message: bytes) -> None:
        """Send a message after those that wait."""
        self._outbox.append(message)
        self._moved.set()

    async def receive(self) -> bytes:
        """The next message; raises StreamError for text and for too many bytes, WebSocketDisconnect at the end."""
        event = await self._websocket.receive()
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(event.get("code", 1005))
        self._heard = monotonic()
        body = event.get("bytes")
        if body is None:
            raise StreamError(400, "messages are binary, this one is text")
        if len(body) > self._limits.max_message_bytes:
            most = self._limits.max_message_bytes
            raise StreamError(413, f"a message may have {most} bytes, got {len(body)}; send fewer frames at a time")
        return body

    async def run(self, session: Session, scheduler: Scheduler) -> None:
        """Serve until the client leaves, or something goes wrong that ends the stream."""
        member = Member(session, self.post, self._is_free, self._fail)
        tasks = [
            asyncio.ensure_future(part)
            for part in (self._read(session, scheduler, member), self._write(scheduler, member), self._watch(session))
        ]
        try:
            await asyncio.wait([*tasks, self._failure], return_when=asyncio.FIRST_COMPLETED)
        finally:
            scheduler.forget(member)
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
            self._failure.cancel()
        if self._failure.done() and not self._failure.cancelled():
            self._failure.result()
        for result in results:
            if isinstance(result, Exception):
                raise result

    async def _read(self, session: Session, scheduler: Scheduler, member: Member) -> None:
        while True:
            body = await self.receive()
            with scheduler.stages.time("parse"):
                message = self._take(session, body)
            scheduler.wake(member)
            await self._allowance.spend(len(message.poses) if isinstance(message, Poses) else 1)
            while session.is_full or len(self._outbox) > OUTBOX:
                await asyncio.sleep(0.01)

    def _take(self, session: Session, body: bytes) -> object:
        """Take a message in. What cannot be used is answered by an error, and the stream goes on; what cannot be
        understood ends it."""
        try:
            message = decode_client(body)
        except CaphyError as error:
            raise StreamError(400, str(error)) from error
        if isinstance(message, Hello):
            raise StreamError(409, "hello was said already; open another stream")
        try:
            session.take(message)
        except CaphyError as error:
            code = error.status if isinstance(error, Problem) else 422
            number = message.number if isinstance(message, Poses) else 0
            self.post(encode_failure(Failure(code, str(error), number)))
        return message

    async def _write(self, scheduler: Scheduler, member: Member) -> None:
        while True:
            while self._outbox:
                self._sending = monotonic()
                await self._websocket.send({"type": "websocket.send", "bytes": self._outbox[0]})
                self._outbox.popleft()
                self._sending = None
            scheduler.wake(member)
            self._moved.clear()
            await self._moved.wait()

    async def _watch(self, session: Session) -> None:
        limits = self._limits
        while True:
            await asyncio.sleep(min(1.0, limits.idle_seconds / 4, limits.send_seconds / 4))
            now = monotonic()
            if session.is_owed:
                self._heard = now
            if now - self._heard > limits.idle_seconds:
                raise StreamError(408, f"nothing was heard for {limits.idle_seconds:g} s")
            if self._sending is not None and now - self._sending > limits.send_seconds:
                raise StreamError(408, f"a message was not taken for {limits.send_seconds:g} s")

    def _is_free(self) -> bool:
        return not self._outbox

    def _fail(self, error: Exception) -> None:
        if self._failure.done():
            return
        if isinstance(error, Problem):
            error = StreamError(error.status, str(error))
        self._failure.set_exception(error)


class Allowance:
    """A bucket of messages and frames that fills at ``rate`` per second up to ``burst``."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, monotonic()

    async def spend(self, count: int) -> None:
        """Take ``count`` out, and wait until the bucket is not in debt: what reads too fast is read more slowly."""
        now = monotonic()
        self._left = min(self._burst, self._left + self._rate * (now - self._at)) - count
        self._at = now
        if self._left < 0:
            await asyncio.sleep(-self._left / self._rate)
