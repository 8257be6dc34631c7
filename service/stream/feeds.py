"""Feeds: poses that one program sends, such as a camera's client, and that pages show as they come.

A feed is known by its avatar and a name. One sender, ``WS /avatars/{avatar}/feeds/{feed}/send``, says its rate and then
poses and resets, as on the stream; whoever listens on ``WS /avatars/{avatar}/feeds/{feed}`` gets the same bytes, and
has them dressed on a stream of its own. Nothing is kept but the rate: a feed is what happens now. Who listens too
slowly misses the oldest messages. Sender and listeners meet in one process, so a service of several workers has none.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from fastapi import FastAPI, WebSocket

from caphy.errors import CaphyError
from service.avatar_routes import find_avatar
from service.clients.given import RATES
from service.errors import Problem
from service.stream.connection import Allowance, Connection, StreamError, answered
from service.stream.limits import StreamLimits
from service.stream.messages import ClientMessage, Poses, Rate, Reset, Seen, decode_client

NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,40}")
MOST_FEEDS: Final = 64
"""Feeds with a sender or a listener in one process."""
MOST_LISTENERS: Final = 32
"""Of one feed."""
WAITING: Final = 32
"""Messages that wait for a listener before the oldest are dropped."""


@dataclass(eq=False)
class Listener:
    """What waits for one page."""

    waiting: deque[bytes] = field(default_factory=lambda: deque(maxlen=WAITING))
    moved: asyncio.Event = field(default_factory=asyncio.Event)

    def post(self, body: bytes) -> None:
        """Send it after what waits."""
        self.waiting.append(body)
        self.moved.set()


@dataclass(eq=False)
class Feed:
    """rate: the message that the sender said it by, none without a sender."""

    rate: bytes | None = None
    listeners: list[Listener] = field(default_factory=list)

    def post(self, body: bytes) -> None:
        """Send it to all who listen."""
        for listener in self.listeners:
            listener.post(body)


class Feeds:
    """The feeds of one process, by avatar and name."""

    def __init__(self) -> None:
        self._feeds: dict[tuple[str, str], Feed] = {}

    @contextmanager
    def sending(self, key: tuple[str, str]) -> Iterator[Feed]:
        """A feed for its one sender; raises StreamError where there is one already."""
        with self._used(key) as feed:
            if feed.rate is not None:
                raise StreamError(409, f"somebody sends on feed {key[1]!r} already; choose another name")
            feed.rate = b""
            try:
                yield feed
            finally:
                feed.rate = None

    @contextmanager
    def listening(self, key: tuple[str, str]) -> Iterator[Listener]:
        """A place for one who listens, with the rate as the first message where there is a sender."""
        with self._used(key) as feed:
            if len(feed.listeners) >= MOST_LISTENERS:
                raise StreamError(503, f"{MOST_LISTENERS} listen to feed {key[1]!r} already, its limit")
            listener = Listener()
            feed.listeners.append(listener)
            if feed.rate:
                listener.post(feed.rate)
            try:
                yield listener
            finally:
                feed.listeners.remove(listener)

    @contextmanager
    def _used(self, key: tuple[str, str]) -> Iterator[Feed]:
        if not NAME.fullmatch(key[1]):
            raise StreamError(422, "a feed's name has 1 to 40 letters, digits, - or _")
        if key not in self._feeds and len(self._feeds) >= MOST_FEEDS:
            raise StreamError(503, f"the service holds {MOST_FEEDS} feeds, its limit; try again later")
        feed = self._feeds.setdefault(key, Feed())
        try:
            yield feed
        finally:
            if not feed.listeners and feed.rate is None:
                self._feeds.pop(key, None)


def add_feeds(app: FastAPI, limits: StreamLimits) -> None:
    """Mount both ends."""
    feeds = Feeds()

    @app.websocket("/avatars/{avatar}/feeds/{feed}/send")
    async def send(websocket: WebSocket, avatar: str, feed: str) -> None:
        async def serve() -> None:
            _require(websocket, avatar)
            with feeds.sending((avatar, feed)) as found:
                await _relay(Connection(websocket, limits), found, limits)

        await answered(websocket, serve)

    @app.websocket("/avatars/{avatar}/feeds/{feed}")
    async def listen(websocket: WebSocket, avatar: str, feed: str) -> None:
        async def serve() -> None:
            _require(websocket, avatar)
            with feeds.listening((avatar, feed)) as listener:
                await _listen(websocket, listener)

        await answered(websocket, serve)


def _require(websocket: WebSocket, avatar: str) -> None:
    """Raise StreamError where the service has no such avatar, or several processes that do not know of each other."""
    if websocket.app.state.settings.workers > 1:
        raise StreamError(501, "feeds need a service of one process: caphy serve --workers 1")
    try:
        find_avatar(websocket, avatar)
    except Problem as problem:
        raise StreamError(problem.status, str(problem)) from problem


async def _relay(connection: Connection, feed: Feed, limits: StreamLimits) -> None:
    """Pass on what the sender sends, until it leaves."""
    allowance = Allowance(limits.max_rate, limits.burst)
    while True:
        body = await connection.receive()
        try:
            message = decode_client(body)
        except CaphyError as error:
            raise StreamError(400, str(error)) from error
        count = _checked(message, feed, limits)
        if isinstance(message, Rate):
            feed.rate = body
        feed.post(body)
        await allowance.spend(count)


def _checked(message: ClientMessage, feed: Feed, limits: StreamLimits) -> int:
    """How many frames a message counts for; raises StreamError for what is not for feeds."""
    if isinstance(message, Rate):
        if not RATES[0] <= message.fps <= RATES[1]:
            raise StreamError(422, f"the rate must be {RATES[0]:g} to {RATES[1]:g} Hz, got {message.fps:g}")
        return 1
    if not feed.rate:
        raise StreamError(409, "the first message of a feed must be its rate")
    if isinstance(message, Reset):
        return 1
    if not isinstance(message, Poses) or isinstance(message, Seen):
        raise StreamError(409, "a feed takes rate, poses and reset")
    if not 0 < len(message.poses) <= limits.max_frames:
        raise StreamError(413, f"a message may have 1 to {limits.max_frames} frames, got {len(message.poses)}")
    if not (np.isfinite(message.poses).all() and np.isfinite(message.transl).all()):
        raise StreamError(422, f"poses and transl must be finite, message {message.number} has others")
    return len(message.poses)


async def _listen(websocket: WebSocket, listener: Listener) -> None:
    """Send what comes until the page leaves; what it says itself is not heard."""
    sending = asyncio.ensure_future(_pass_on(websocket, listener))
    try:
        while not sending.done():
            hearing = asyncio.ensure_future(websocket.receive())
            await asyncio.wait([sending, hearing], return_when=asyncio.FIRST_COMPLETED)
            if not hearing.done():
                hearing.cancel()
            elif hearing.result()["type"] == "websocket.disconnect":
                return
        sending.result()
    finally:
        sending.cancel()


async def _pass_on(websocket: WebSocket, listener: Listener) -> None:
    while True:
        listener.moved.clear()
        while listener.waiting:
            await websocket.send_bytes(listener.waiting.popleft())
        await listener.moved.wait()
