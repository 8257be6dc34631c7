"""Feeds: what one program sends reaches those who listen, and nothing else does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.sync.client import connect

from caphy.errors import CaphyError
from service.app import create_app
from service.clients.feed import FeedClient
from service.clients.stream import StreamRefused
from service.encodings import Encoding
from service.settings import Settings
from service.stream.connection import StreamError
from service.stream.feeds import MOST_LISTENERS, WAITING, Feeds
from service.stream.messages import Credit, Failure, Hello, Poses, Rate, Reset, Seen, ServerDecoder, encode_client

RATE = encode_client(Rate(30.0))


def poses(number: int, frames: int = 1, value: float = 0.5) -> bytes:
    return encode_client(
        Poses(number, 1.5, np.full((frames, 55, 3), value, np.float32), np.zeros((frames, 3), np.float32))
    )


@contextmanager
def sender(http: TestClient, name: str) -> Iterator:
    with http.websocket_connect(f"/avatars/shell/feeds/{name}/send") as socket:
        socket.send_bytes(RATE)
        yield socket


def test_those_who_listen_get_the_bytes_that_were_sent(http):
    sent = [poses(1), poses(2, 3), encode_client(Reset()), poses(5)]
    with sender(http, "a") as source, http.websocket_connect("/avatars/shell/feeds/a") as early:
        assert early.receive_bytes() == RATE
        for body in sent:
            source.send_bytes(body)
        assert [early.receive_bytes() for _ in range(4)] == sent
        with http.websocket_connect("/avatars/shell/feeds/a") as late:
            assert late.receive_bytes() == RATE  # and nothing of before
            source.send_bytes(poses(6))
            assert late.receive_bytes() == early.receive_bytes() == poses(6)


def test_feeds_are_apart_by_name_and_go_on_with_another_sender(http):
    with http.websocket_connect("/avatars/shell/feeds/a") as listener:
        with sender(http, "b") as other:
            other.send_bytes(poses(1))
        for number in (2, 1):
            with sender(http, "a") as one:
                assert listener.receive_bytes() == RATE
                one.send_bytes(poses(number))
                assert listener.receive_bytes() == poses(number)


@pytest.mark.parametrize(
    ("path", "sent", "code", "words"),
    [
        ("nobody/feeds/a/send", [], 4404, "there is no avatar 'nobody'; there is shell"),
        ("nobody/feeds/a", [], 4404, "there is no avatar"),
        ("shell/feeds/a b", [], 4422, "a feed's name has"),
        (f"shell/feeds/{'a' * 41}/send", [], 4422, "a feed's name has"),
        ("shell/feeds/c/send", [poses(1)], 4409, "must be its rate"),
        ("shell/feeds/c/send", [encode_client(Rate(0.0))], 4422, "the rate must be"),
        ("shell/feeds/c/send", [encode_client(Rate(float("nan")))], 4422, "the rate must be"),
        ("shell/feeds/c/send", [RATE, poses(1, value=np.nan)], 4422, "must be finite"),
        ("shell/feeds/c/send", [RATE, poses(1, 33)], 4413, "1 to 32 frames, got 33"),
        ("shell/feeds/c/send", [RATE, poses(1, 0)], 4413, "1 to 32 frames, got 0"),
        ("shell/feeds/c/send", [RATE, encode_client(Hello((), 30.0))], 4409, "takes rate, poses and reset"),
        ("shell/feeds/c/send", [RATE, encode_client(Credit(1))], 4409, "takes rate, poses and reset"),
        ("shell/feeds/c/send", [RATE, b"CPHS"], 4400, "a message starts with"),
        ("shell/feeds/c/send", [bytes(1 << 17)], 4413, "bytes, got 131072"),
    ],
)
def test_what_is_not_for_feeds_is_refused_in_words(http, path, sent, code, words):
    with http.websocket_connect(f"/avatars/{path}") as socket:
        for body in sent:
            socket.send_bytes(body)
        said = ServerDecoder(Encoding.FLOAT32, False).decode(socket.receive_bytes())
        assert isinstance(said, Failure)
        assert said.code + 4000 == code
        assert words in said.text
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
    assert ended.value.code == code


def test_times_and_confidence_are_for_streams(http):
    one = np.zeros((1, 55, 3), np.float32)
    seen = Seen(1, 0.0, one, one[:, 0], np.zeros(1), np.ones((1, 55), np.float32))
    with sender(http, "a") as source:
        source.send_bytes(encode_client(seen))
        assert b"takes rate, poses and reset" in source.receive_bytes()


def test_one_sender_and_so_many_listeners():
    feeds, key = Feeds(), ("shell", "a")
    with feeds.sending(key), pytest.raises(StreamError, match="somebody sends on feed 'a' already"):
        feeds.sending(key).__enter__()
    places = [feeds.listening(key) for _ in range(MOST_LISTENERS)]
    for place in places:
        place.__enter__()
    with pytest.raises(StreamError, match=f"{MOST_LISTENERS} listen to feed 'a' already"):
        feeds.listening(key).__enter__()
    with feeds.sending(key):
        pass
    for place in places:
        place.__exit__(None, None, None)
    assert not feeds._feeds


def test_who_listens_slowly_misses_the_oldest():
    feeds = Feeds()
    with feeds.sending(("shell", "a")) as feed, feeds.listening(("shell", "a")) as listener:
        for number in range(1000):
            feed.post(b"%d" % number)
        assert list(listener.waiting) == [b"%d" % number for number in range(1000 - WAITING, 1000)]


def test_several_workers_have_no_feeds(avatars):
    app = create_app(Settings(avatars=avatars, workers=2))
    with TestClient(app) as http, http.websocket_connect("/avatars/shell/feeds/a") as socket:
        assert b"caphy serve --workers 1" in socket.receive_bytes()


@pytest.mark.parametrize("end", ["", "/send"])
def test_a_service_with_keys_asks_for_one_at_both_ends(avatars, end):
    key = "a-key-that-is-long-enough"
    with TestClient(create_app(Settings(avatars=avatars, api_key=key))) as http:
        with http.websocket_connect(f"/avatars/shell/feeds/door{end}") as socket, pytest.raises(WebSocketDisconnect):
            socket.receive_bytes()
        with http.websocket_connect(f"/avatars/shell/feeds/door{end}", headers={"authorization": f"Bearer {key}"}):
            pass


def test_the_client_sends_what_arrives(url):
    listening = url.replace("http", "ws") + "/avatars/shell/feeds/cam"
    with FeedClient(url, "shell", "cam", fps=25.0) as feed, connect(listening) as listener:
        assert feed.page == f"{url}/?avatar=shell&feed=cam"
        assert listener.recv(timeout=30) == encode_client(Rate(25.0))
        feed.send(np.ones((55, 3)), np.zeros(3))
        feed.reset()
        feed.send(np.ones((2, 55, 3)), np.zeros((2, 3)))
        found = [listener.recv(timeout=30) for _ in range(3)]
        with pytest.raises(StreamRefused, match=r"somebody sends on feed 'cam' already.*\(409\)"):
            until_refused(FeedClient(url, "shell", "cam"))
        with pytest.raises(CaphyError, match=r"poses must have shape \(frames, 55, 3\).*got \(2, 55, 3\), \(3,\)"):
            feed.send(np.ones((2, 55, 3)), np.zeros(3))
        with pytest.raises(CaphyError, match=r"got \(3, 55\), \(3,\)"):
            feed.send(np.ones((3, 55)), np.zeros(3))
    assert [body[5] for body in found] == [2, 4, 2]
    assert [int.from_bytes(body[8:12], "little") for body in (found[0], found[2])] == [1, 2]
    with pytest.raises(CaphyError, match="no feed"):
        FeedClient("http://127.0.0.1:9", "shell", "cam")
    with pytest.raises(CaphyError, match="fps must lie between 1 and 1000, got 1e"):
        FeedClient("http://127.0.0.1:9", "shell", "cam", fps=1e39)


def until_refused(feed: FeedClient) -> None:
    """Send until the refusal has arrived."""
    waiting = threading.Event()
    for _ in range(3000):
        feed.send(np.zeros((55, 3)), np.zeros(3))
        waiting.wait(0.01)
    raise AssertionError("the second sender was not refused")
