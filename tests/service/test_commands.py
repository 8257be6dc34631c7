"""``caphy serve`` and ``caphy demo`` as a user runs them."""

from __future__ import annotations

import socket
import time

import cv2
import numpy as np
import pytest
import trimesh

from caphy.cli import main
from caphy.commands.demo import _service
from caphy.io.poses import write_poses
from service.client import Client


def test_demo_writes_a_glb_and_a_sheet(avatars, motion, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CAPHY_API_KEY", "k" * 32)  # of the user's own service, not of the demo's
    write_poses(motion, tmp_path / "walk.npz")
    out = tmp_path / "out"
    arguments = ["demo", str(tmp_path / "walk.npz"), "--avatar", str(avatars / "shell"), "--out", str(out)]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    for word in ("milliseconds per frame", "round trip", "avatar.glb", "sheet.png", "caphy serve"):
        assert word in said
    scene = trimesh.load(out / "avatar.glb")
    assert set(scene.geometry) == {"body", "tshirt", "trousers"}
    sheet = cv2.imread(str(out / "sheet.png"))
    assert sheet.shape[1] == 6 * 280
    assert np.std(sheet) > 10
    assert sorted(path.name for path in out.iterdir()) == ["avatar.glb", "sheet.png"]


@pytest.mark.parametrize("arguments", [["demo"], ["simulate", "tshirt", "walk.npz", "-o", "out.npz"]])
def test_endless_motions_are_refused(arguments, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--seconds", "inf"]) == 2
    assert "--seconds must be positive and finite, got inf" in capsys.readouterr().err


def test_demo_without_an_avatar_says_what_to_do(tmp_path, capsys):
    assert main(["demo", "--avatar", str(tmp_path / "none")]) == 2
    assert "caphy export" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["--avatars", "nowhere"], "--avatars"), (["--port", "99999"], "CAPHY_PORT")],
)
def test_serve_refuses_in_words(arguments, word, capsys):
    assert main(["serve", *arguments]) == 2
    assert word in capsys.readouterr().err


def test_small_answers_do_not_wait(avatars, motion):
    """Nagle's algorithm and delayed acknowledgements together hold a small answer back for 40 ms."""
    with _service(avatars) as url:
        client = Client(url)
        waits = []
        for frame in range(20):
            started = time.perf_counter()
            client.frames("shell", motion[frame : frame + 1])
            waits.append(time.perf_counter() - started - 1e-3 * sum(client.server_timing.values()))
    assert sorted(waits)[5] < 0.03


def test_serve_on_a_port_in_use(avatars, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["serve", "--avatars", str(avatars), "--port", port]) == 2
    assert "choose another with --port" in capsys.readouterr().err
