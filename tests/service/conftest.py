"""A service on the shell avatar: in process, and live on a loopback port."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from loopback import live
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
    with live(Settings(avatars=avatars)) as address:
        yield address
