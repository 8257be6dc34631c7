"""Sends poses to a feed, which the service's page shows as they come.

with FeedClient("http://127.0.0.1:8000", "default", "camera", fps=30.0) as feed:
    print(feed.page)                 # open it in a browser
    feed.send(poses, transl)         # (55, 3) and (3,), or a few frames of them
"""

from __future__ import annotations

import time
from urllib.parse import quote, urlencode, urlunsplit

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from caphy.errors import CaphyError
from service.clients import given
from service.clients.stream import FINAL, SCHEMES, refusal, web_socket
from service.stream.messages import Poses, Rate, Reset, encode_client

PAGES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
"""Of a service's address, and of its pages'."""


class FeedClient:
    """One sender; not for several threads at once.

    Raises StreamRefused where the service refuses, CaphyError where it cannot be reached or has gone.
    """

    def __init__(self, url: str, avatar: str, feed: str, *, fps: float = 30.0, key: str | None = None) -> None:
        parts = given.address(url, SCHEMES)
        query = urlencode({"avatar": avatar, "feed": feed})
        self.page = urlunsplit((PAGES[parts.scheme], parts.netloc, f"{parts.path.rstrip('/')}/", query, ""))
        """The page's address that shows this feed."""
        self._address = web_socket(url, f"/avatars/{quote(avatar, safe='')}/feeds/{quote(feed, safe='')}/send")
        headers, fps = given.headers("authorization", "Bearer ", key), given.rate(fps)
        self._number = 0
        try:
            opening = connect(self._address, compression=None, additional_headers=headers, proxy=None)
            self._socket = opening.__enter__()  # and not with: it outlives this method
        except (OSError, InvalidHandshake, TimeoutError) as error:
            raise CaphyError(f"{self._address}: no feed ({error}); is 'caphy serve' running there?") from error
        self._send(encode_client(Rate(fps)))

    def send(self, poses: np.ndarray, transl: np.ndarray) -> None:
        """Send poses (55, 3) or (T, 55, 3) [rad] and transl (3,) or (T, 3) [m] of the next frames."""
        poses, transl = given.frames(poses, transl)
        self._send(encode_client(Poses(self._number + 1, time.monotonic(), poses, transl)))
        self._number += len(poses)

    def reset(self) -> None:
        """The next pose starts a new motion."""
        self._send(encode_client(Reset()))

    def close(self) -> None:
        """End the feed."""
        self._socket.close()

    def __enter__(self) -> FeedClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, body: bytes) -> None:
        try:
            self._socket.send(body)
        except ConnectionClosed as closed:
            raise self._reason(closed) from closed

    def _reason(self, closed: ConnectionClosed) -> CaphyError:
        """Why the service closed: it says so before, in a message of its own."""
        said = closed.rcvd
        if said is not None and (said.code >= 4000 or said.code in FINAL):
            return refusal(said)
        return CaphyError(f"{self._address}: the service has gone ({said.code if said else 1006})")
