"""Clients of a service that wants a key: with it they are served, without it they hear why, at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from loopback import live
from shell_avatar import shell_avatar

from caphy.errors import CaphyError
from service.client import Client
from service.clients.feed import FeedClient
from service.clients.monocular.__main__ import _served
from service.clients.monocular.dressing import RequestWardrobe, open_wardrobe
from service.clients.stream import StreamClient
from service.settings import Settings

KEY = "a-key-with-ümlaut"


@pytest.fixture(scope="module")
def locked(avatars: Path) -> Iterator[str]:
    with live(Settings(avatars=avatars, api_key=KEY)) as address:
        yield address


def asked(url: str, key: str | None) -> list[str]:
    return [avatar["id"] for avatar in Client(url, key=key).avatars()]


def streamed(url: str, key: str | None) -> list[str]:
    with StreamClient(url, "shell", key=key):
        return ["shell"]


def fed(url: str, key: str | None) -> list[str]:
    with FeedClient(url, "shell", "door", key=key) as feed:
        for _ in range(100):
            feed.send(np.zeros((55, 3)), np.zeros(3))
            time.sleep(0.01)
    return ["shell"]


def found(url: str, key: str | None) -> list[str]:
    return [_served(url, shell_avatar(), "", key)]


def dressed(url: str, key: str | None) -> list[str]:
    wardrobe = open_wardrobe(url, "shell", 30.0, key)
    wardrobe.close()
    return ["shell"]


@pytest.mark.parametrize("ask", [asked, streamed, fed, found, dressed])
def test_a_client_sends_its_key_and_is_told_that_one_is_wanted(locked: str, ask: Callable) -> None:
    assert ask(locked, KEY) == ["shell"]
    for wrong in (None, "wrong"):
        began = time.monotonic()
        with pytest.raises(CaphyError, match="this service wants a key"):
            ask(locked, wrong)
        assert time.monotonic() - began < 5  # nobody tries again what will be refused again


def test_requests_carry_the_key(locked: str) -> None:
    wardrobe = RequestWardrobe(locked, "shell", 30.0, KEY)
    assert wardrobe._client.avatars()[0]["id"] == "shell"
    wardrobe.close()


def test_the_video_client_knows_its_avatar_among_others_with_the_same_garments(monkeypatch) -> None:
    """By names and numbers of vertices alone it took the first one, of another person."""
    bundle = shell_avatar()
    garments = [{"name": each.name, "vertices": len(each.mesh.vertices)} for each in bundle.garments]
    offered = [{"id": name, "version": f"of {name}", "garments": garments} for name in ("other", "mine")]
    client = SimpleNamespace(avatars=lambda: offered)
    monkeypatch.setattr("service.clients.monocular.__main__.Client", lambda *_, **__: client)
    assert _served("http://here", bundle, "of mine") == "mine"
    with pytest.raises(CaphyError, match=r"serves other, mine, all with the garments of .* none is the one drawn here"):
        _served("http://here", bundle, "of a third")
    del offered[1]
    assert _served("http://here", bundle, "of a third") == "other"  # the same garments, made again
