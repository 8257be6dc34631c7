"""A stream's client: poses in, meshes out, and a new connection with the old state where one breaks.

with StreamClient("http://127.0.0.1:8000", "default", encoding="uint16") as stream:
    stream.send(poses, transl)          # (55, 3) and (3,), or a few frames of them
    answer = stream.receive()           # answer.meshes.vertices["tshirt"]: (T, V, 3)
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import quote, urlunsplit

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.frames import Close
from websockets.sync.client import ClientConnection, connect

from caphy.errors import CaphyError
from caphy.io.bundle import NAME_PATTERN
from service.clients import given
from service.encodings import LABELS, Encoding, EncodingName
from service.stream.messages import (
    MOST_CREDITS,
    Credit,
    Dressed,
    Failure,
    GetState,
    Hello,
    Poses,
    Rate,
    Reset,
    Seen,
    ServerDecoder,
    ServerMessage,
    State,
    Welcome,
    encode_client,
)

SAVE_EVERY = 30
"""Messages of poses between two requests for the state."""
SCHEMES = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
"""Of a service's address, and of its WebSockets'."""
FINAL = {4400, 4404, 4409, 4413, 4422, 1008}
"""Close codes after which the same again would fail again."""


class StreamRefused(CaphyError):
    """The service said no; ``code`` is HTTP's for the reason."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"{text} ({code})")
        self.code = code


class StreamClient:
    """One stream; not for several threads at once.

    A connection that breaks is made again for up to ``patience`` seconds, to the same address, with the last state
    that the service told and all poses sent since; meshes received already are not given twice. The state is asked
    for by itself once in a while.

    Raises StreamRefused where the service refuses, CaphyError where it cannot be reached.
    """

    def __init__(
        self,
        url: str,
        avatar: str,
        garments: Sequence[str] = (),
        *,
        encoding: EncodingName = "float32",
        normals: bool = False,
        fps: float = 30.0,
        credits: int = 2,
        state: Mapping[str, np.ndarray] | np.ndarray | None = None,
        key: str | None = None,
        patience: float = 10.0,
        conditioning: Mapping[str, Any] | None = None,
    ) -> None:
        """``state``: of a motion to continue, what :meth:`state` said, by name or one after another as welcome has it.
        ``conditioning``: settings as in docs/conditioning.md; {} for its defaults, none for no conditioning.

        Raises CaphyError for what no hello can hold, and states of other garments than the stream's.
        """
        if encoding not in LABELS:
            raise CaphyError(f"encoding must be one of {', '.join(LABELS)}, got {encoding!r}")
        if not 1 <= credits <= MOST_CREDITS:
            raise CaphyError(f"credits must lie between 1 and {MOST_CREDITS}, got {credits}")
        for name in garments:
            if not NAME_PATTERN.fullmatch(name):
                raise CaphyError(f"garment names are lower-case letters, digits, - and _, 39 at most, got {name!r}")
        self._address = web_socket(url, f"/avatars/{quote(avatar, safe='')}/stream")
        self._headers = given.headers("authorization", "Bearer ", key)
        self._fps, self._patience = given.rate(fps), patience  # the rate where the state is
        settings = "" if conditioning is None else given.settings(conditioning)
        self._hello = Hello(
            tuple(garments), fps, Encoding(LABELS.index(encoding)), normals, credits, conditioning=settings
        )
        named = isinstance(state, Mapping)
        self._state = np.zeros(0, np.float32) if state is None or named else given.floats("state", state).ravel()
        self._number = self._received = self._settled = 0
        self._motion = 0  # goes with every request for the state and comes back, to tell states from before a reset
        self._unsaved: deque[Poses | Rate] = deque()
        self._since_saved = 0
        self._messages: deque[ServerMessage] = deque()
        self._closed = False
        self.skipped = 0
        """Messages of poses that were lived but not answered, because newer ones came before there was a credit."""
        self.reconnections = 0
        self._welcome: Welcome
        self._socket = self._connect()
        if isinstance(state, Mapping) and state:  # in which order it goes, the first welcome said
            self._socket.close()
            self._state = given.joined(state, {g.name: g.state_size for g in self._welcome.garments})
            self._socket = self._connect()

    @property
    def welcome(self) -> Welcome:
        """Garments, the avatar's frame rate, and limits."""
        return self._welcome

    def send(
        self,
        poses: np.ndarray,
        transl: np.ndarray,
        times: np.ndarray | float | None = None,
        confidence: np.ndarray | float = 1.0,
    ) -> int:
        """Send poses (55, 3) or (T, 55, 3) [rad] and transl (3,) or (T, 3) [m]; returns the last one's number.

        On a conditioned stream ``times`` (T,) [s] are when they were seen, and ``confidence`` how surely, of all or of
        each joint (T, 55): 0 where nobody was seen, whatever the pose holds.
        """
        self._require_open()
        poses, transl = given.frames(poses, transl)
        message = Poses(self._number + 1, time.monotonic(), poses, transl)
        if times is not None:
            message = Seen(message.number, message.time, poses, transl, *given.seen(times, confidence, len(poses)))
        self._number += len(poses)
        self._unsaved.append(message)
        self._since_saved += 1
        self._send(encode_client(message))
        if self._since_saved >= SAVE_EVERY:
            self._since_saved = 0
            self._send(encode_client(GetState(self._motion)))
        return self._number

    def receive(self, timeout: float | None = 10.0) -> Dressed:
        """The next answer; a credit goes back with it. Raises CaphyError after ``timeout`` seconds without one, and
        StreamRefused where a message of poses was refused; the stream goes on after that."""
        self._require_open()
        while True:
            message = self._next(timeout)
            if isinstance(message, Dressed):
                self._send(encode_client(Credit(1)))
                if message.number > self._received:
                    self._received = message.number
                    return message
            elif isinstance(message, Failure):
                raise StreamRefused(message.code, message.text)

    def state(self, timeout: float | None = 10.0) -> dict[str, np.ndarray]:
        """The state (S,) of every garment after all poses sent so far; those that are refused have no part in it."""
        self._require_open()
        self._send(encode_client(GetState(self._motion)))
        kept = []
        while any(isinstance(sent, Poses) for sent in self._unsaved) or not self._state.size:
            message = self._next(timeout)
            if not isinstance(message, State):
                kept.append(message)
        self._messages.extendleft(reversed(kept))
        ends = np.cumsum([garment.state_size for garment in self._welcome.garments])[:-1]
        parts = np.split(self._state, ends)
        return {garment.name: part for garment, part in zip(self._welcome.garments, parts, strict=True)}

    def reset(self) -> None:
        """The next pose starts a new motion; of the old one no meshes are given any more."""
        self._require_open()
        self._motion += 1
        self._state = np.zeros(0, np.float32)
        self._settled = self._received = self._number
        self._forget_settled()
        self._send(encode_client(Reset()))

    def set_fps(self, fps: float) -> None:
        """The poses from here on come at ``fps`` [Hz]."""
        self._require_open()
        message = Rate(given.rate(fps))
        self._unsaved.append(message)
        self._send(encode_client(message))

    def close(self) -> None:
        """End the stream; nothing may be asked of it after that."""
        self._closed = True
        self._socket.close()

    def _require_open(self) -> None:
        if self._closed:  # or a late pose would open it anew
            raise CaphyError(f"{self._address}: this stream was closed; open another")

    def __enter__(self) -> StreamClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _next(self, timeout: float | None) -> ServerMessage:
        if self._messages:
            return self._messages.popleft()
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                body = self._socket.recv(timeout=left)
            except TimeoutError:
                raise CaphyError(f"the service did not answer within {timeout:g} s") from None
            except ConnectionClosed as closed:
                self._reconnect(closed)
                continue
            return self._noted(self._decoder.decode(body if isinstance(body, bytes) else body.encode()))

    def _noted(self, message: ServerMessage) -> ServerMessage:
        if isinstance(message, State) and message.time == self._motion:
            self._state = message.state
            self._settled = max(self._settled, message.number)  # a new connection counts no poses before its own
            self._forget_settled()
        if isinstance(message, Dressed):
            self.skipped = message.skipped
        if isinstance(message, Failure):  # the service goes on as if they had not been sent
            self._unsaved = deque(s for s in self._unsaved if isinstance(s, Rate) or s.number != message.number)
        return message

    def _forget_settled(self) -> None:
        """Forget the poses that the state has in it, and the rates before those that it has not."""
        while self._unsaved:
            first = self._unsaved[0]
            if isinstance(first, Rate):
                self._fps = first.fps
            elif first.number + len(first.poses) - 1 > self._settled:
                return
            self._unsaved.popleft()

    def _send(self, body: bytes) -> None:
        try:
            self._socket.send(body)
        except ConnectionClosed as closed:
            self._reconnect(closed)

    def _reconnect(self, closed: ConnectionClosed) -> None:
        _require_not_final(closed)
        self.reconnections += 1
        self._socket = self._connect()
        try:
            for message in (*self._unsaved, GetState(self._motion)):
                self._socket.send(encode_client(message))
        except ConnectionClosed as again:
            self._reconnect(again)

    def _connect(self) -> ClientConnection:
        """A connection on which hello was said with the state there is."""
        hello = replace(self._hello, fps=self._fps, state=self._state)
        end, wait = time.monotonic() + self._patience, 0.05
        while True:
            try:
                opening = connect(
                    self._address, compression=None, additional_headers=self._headers, max_size=None, proxy=None
                )
                socket = opening.__enter__()  # and not with: the stream outlives this method
                socket.send(encode_client(hello))
                self._decoder = ServerDecoder(hello.encoding, hello.normals, conditioned=bool(hello.conditioning))
                message = self._decoder.decode(socket.recv(timeout=10, decode=False))
                if isinstance(message, Failure):
                    raise StreamRefused(message.code, message.text)
                if not isinstance(message, Welcome):
                    raise CaphyError("the service must say welcome first")
                self._welcome = message
                return socket
            except StreamRefused as refused:
                if refused.code not in (429, 503) or time.monotonic() > end:
                    raise
            except (OSError, ConnectionClosed, InvalidHandshake, TimeoutError) as error:
                _require_not_final(error)
                if time.monotonic() > end or _is_denied(error):
                    raise CaphyError(
                        f"{self._address}: no stream ({error}); is 'caphy serve' running there?"
                    ) from error
            time.sleep(wait)
            wait = min(1.0, 2 * wait)


def _require_not_final(error: Exception) -> None:
    """Raise StreamRefused where the service closed with words that a new connection would hear again."""
    said = error.rcvd if isinstance(error, ConnectionClosed) else None
    if said is not None and said.code in FINAL:
        raise refusal(said) from error


def refusal(said: Close) -> StreamRefused:
    """What a service closes with, as the error that it is."""
    return StreamRefused(said.code - 4000 if said.code >= 4000 else 403, said.reason)


def _is_denied(error: Exception) -> bool:
    """Whether the service answered that this caller may not open a stream here."""
    status = getattr(getattr(error, "response", None), "status_code", 0)
    return status in (401, 403, 404)


def web_socket(url: str, path: str) -> str:
    """The WebSocket's address of a path below a service's; CaphyError for what is no address."""
    parts = given.address(url, SCHEMES)
    return urlunsplit((SCHEMES[parts.scheme], parts.netloc, parts.path.rstrip("/") + path, "", ""))
