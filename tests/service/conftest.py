"""A service on the shell avatar: in process, and live on a loopback port."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from fastapi.testclient import TestClient
from shell_avatar import shell_avatar, wiggle

from caphy.io.bundle import AvatarBundle, write_bundle
from caphy.io.poses import PoseSequence
from service.app import create_app
from service.settings import Settings


@pytest.fixture(scope="session")
def bundle() -> AvatarBundle:
    return shell_avatar()


@pytest.fixture(scope="session")
def avatars(bundle: AvatarBundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one avatar, ``shell``."""
    folder = tmp_path_factory.mktemp("avatars")
    write_bundle(bundle, folder / "shell")
    return folder


@pytest.fixture(scope="session")
def http(avatars: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(avatars=avatars)), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="session")
def motion() -> PoseSequence:
    return wiggle(1.0, seed=4)


@pytest.fixture(scope="session")
def url(avatars: Path) -> Iterator[str]:
    """A live uvicorn on a free loopback port."""
    server = uvicorn.Server(uvicorn.Config(create_app(Settings(avatars=avatars)), port=0, log_level="warning"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    deadline = time.monotonic() + 30
    while not server.started:
        assert time.monotonic() < deadline and thread.is_alive()
        time.sleep(0.02)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(timeout=10)
