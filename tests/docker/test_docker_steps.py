"""The Dockerfile's steps without an engine: what they make starts as nobody, on a tree it cannot write, and answers.

It has the base dependencies alone, so these tests are also of what runs without torch.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from image_steps import Image, unprivileged

from service.protocol import MEDIA_TYPE, FramesRequest, decode_response, encode_request

ROOT = Path(__file__).parents[2]
KEY = "docker-test-key"
TWO_FRAMES = {"fps": 30, "poses": np.zeros((2, 55, 3)).tolist(), "transl": np.zeros((2, 3)).tolist()}
JSON = {"content-type": "application/json", "authorization": f"Bearer {KEY}"}


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    """The built image, its files without any right to write."""
    place = Path(tempfile.mkdtemp(prefix="caphy-image-"))  # not pytest's folder, which nobody may enter
    place.chmod(0o755)
    made = Image(place / "root", ROOT)
    try:
        made.build((ROOT / "Dockerfile").read_text())
        subprocess.run(["chmod", "-R", "a-w", str(made.root)], check=True)
        yield made
    finally:
        subprocess.run(["chmod", "-R", "u+w", str(place)], check=True)
        shutil.rmtree(place)


def start(image: Image, **environment: str) -> subprocess.Popen[str]:
    """The image's command with its own environment only, as nobody where we are root."""
    command = [*unprivileged(), str(image.root / "opt/caphy/bin" / image.command[0]), *image.command[1:]]
    return subprocess.Popen(
        command,
        env={**image.environment, **environment},
        cwd=image.folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def free_port() -> str:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        return str(unused.getsockname()[1])


def listing(folder: Path) -> list[tuple[str, int]]:
    return sorted((str(path), path.lstat().st_mtime_ns) for path in folder.rglob("*"))


def test_it_is_small_and_nobodys(image):
    assert image.user == "caphy"
    if os.geteuid() == 0:
        assert image.user in (image.root / "etc/passwd").read_text()
    installed = {path.name.lower() for path in image.root.glob("opt/caphy/lib/python3*/site-packages/*")}
    assert {"caphy", "service", "onnxruntime"} <= installed
    assert not {"torch", "scipy", "onnx", "numba", "embreex", "anny", "smplx"} & installed
    assert not (image.root / "src").exists()  # the sources stay in the first stage


def test_the_command_line_says_what_is_missing(image):
    command = [str(image.root / "opt/caphy/bin/python"), "-m", "caphy.cli", "export", "x", "-o", "y"]
    found = subprocess.run(
        command, env=image.environment, check=False, capture_output=True, text=True, cwd=image.folder
    )
    assert found.returncode == 2
    assert "Traceback" not in found.stderr
    assert "pip install" in found.stderr


def test_without_a_key_it_does_not_start(image):
    process = start(image, CAPHY_PORT=free_port())
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "CAPHY_API_KEY" in said


def test_it_answers_on_a_tree_it_cannot_write(image):
    port = free_port()
    before = listing(image.root)
    process = start(image, CAPHY_PORT=port, CAPHY_API_KEY=KEY, CAPHY_WORKERS="2")
    try:
        wait_for_probe(image, port, process)
        url = f"http://127.0.0.1:{port}/avatars/default/frames"
        body = encode_request(FramesRequest(np.zeros((4, 55, 3)), np.zeros((4, 3)), 30.0, np.zeros(0)))
        headers = {"content-type": MEDIA_TYPE, "authorization": f"Bearer {KEY}"}
        with urlopen(Request(url, body, headers), timeout=30) as answer:
            meshes = decode_response(answer.read()).vertices
        assert {len(vertices) for vertices in meshes.values()} == {4}
        assert all(np.isfinite(vertices).all() for vertices in meshes.values())
        with urlopen(Request(url, json.dumps(TWO_FRAMES).encode(), JSON), timeout=30) as answer:
            told = json.load(answer)["garments"]
        for name, vertices in meshes.items():
            np.testing.assert_allclose(vertices[:2], told[name]["vertices"], atol=2e-5)
        mesh = f"http://127.0.0.1:{port}/avatars/default/mesh?format=glb"
        with urlopen(Request(mesh, headers=headers), timeout=30) as answer:
            assert answer.read(4) == b"glTF"
        with pytest.raises(HTTPError, match="422"):
            urlopen(Request(url, b"nonsense", headers), timeout=30)
        with pytest.raises(HTTPError, match="401"):
            urlopen(Request(url, body, {"content-type": MEDIA_TYPE}), timeout=30)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
        process.wait()
    assert listing(image.root) == before


def wait_for_probe(image: Image, port: str, process: subprocess.Popen[str]) -> None:
    """Ask as the health check does, until it agrees."""
    probe = [str(image.root / "opt/caphy/bin" / image.probe[0]), *image.probe[1:]]
    environment = {**image.environment, "CAPHY_PORT": port}
    deadline = time.monotonic() + 60
    while subprocess.run(probe, env=environment, capture_output=True, check=False).returncode:
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            pytest.fail(process.communicate()[0])
