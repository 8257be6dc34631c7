"""Both clients against a live service, over connections that break."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from service.clients.stream import StreamClient, StreamRefused
from service.engine import GarmentEngine

NODE = "node 20.10 or later must be installed: the JavaScript client is tested with its WebSocket"


@pytest.fixture(scope="module")
def whole(bundle: AvatarBundle, motion) -> dict[str, np.ndarray]:
    arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    engines = [GarmentEngine(garment) for garment in bundle.garments]
    return {engine.name: engine.run(*arrays, engine.initial_state())[0] for engine in engines}


class Wire:
    """A TCP proxy that can be cut, as a network or a killed process cuts: by a reset, at any byte."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def port(self) -> int:
        return self._listener.getsockname()[1]

    def cut(self) -> None:
        for pair in self._pairs:
            for end in pair:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self._pairs.clear()

    def close(self) -> None:
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(("127.0.0.1", self._port))
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._pairs.append((near, far))
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            return


@pytest.fixture
def wire(url: str) -> Iterator[Wire]:
    found = Wire(int(url.rsplit(":", 1)[1]))
    yield found
    found.close()


def test_frame_by_frame(url, motion, whole):
    with StreamClient(url, "shell") as stream:
        assert [garment.name for garment in stream.welcome.garments] == ["tshirt", "trousers"]
        for frame in range(10):
            number = stream.send(motion.poses[frame], motion.transl[frame])
            answer = stream.receive()
            assert (answer.number, answer.tick) == (number, frame)
            assert 0 < answer.milliseconds < 1e4
            for name, vertices in whole.items():
                np.testing.assert_allclose(answer.meshes.vertices[name][0], vertices[frame], rtol=0, atol=5e-6)
        assert stream.skipped == 0


def test_one_garment_quantised_with_normals(url, motion, whole):
    with StreamClient(url, "shell", ["trousers"], encoding="uint16", normals=True) as stream:
        stream.send(motion.poses[:4], motion.transl[:4])
        meshes = stream.receive().meshes
    assert list(meshes.vertices) == ["trousers"]
    assert 0 < np.abs(meshes.vertices["trousers"] - whole["trousers"][:4]).max() < 3e-5
    np.testing.assert_allclose(np.linalg.norm(meshes.normals["trousers"], axis=-1), 1, atol=0.02)


def test_a_client_that_reads_late_gets_the_newest_and_the_right_one(url, motion, whole):
    with StreamClient(url, "shell", credits=1) as stream:
        for frame in range(len(motion)):
            stream.send(motion.poses[frame], motion.transl[frame])
        stream.state()  # everything was lived
        answers = [stream.receive()]
        while answers[-1].number < len(motion):
            answers.append(stream.receive())
    assert len(answers) + stream.skipped == len(motion)
    assert stream.skipped > 0
    for answer in answers:
        np.testing.assert_allclose(answer.meshes.vertices["tshirt"][0], whole["tshirt"][answer.tick], atol=5e-6)


@pytest.mark.parametrize("lost", [0, 3])
def test_a_broken_connection_loses_nothing(wire, motion, whole, lost):
    """Answers that nobody read are lost with the connection; poses are not, because the client sends them again."""
    with StreamClient(f"http://127.0.0.1:{wire.port}", "shell", credits=64) as stream:
        found = {}
        for frame in range(len(motion)):
            stream.send(motion.poses[frame], motion.transl[frame])
            if frame == 11:
                stream.state()
            if frame % 10 >= lost:
                answer = stream.receive()
                found[answer.number] = answer.meshes.vertices["tshirt"][-1]
            if frame in (8, 17):
                wire.cut()
        while max(found) < len(motion):
            answer = stream.receive()
            found[answer.number] = answer.meshes.vertices["tshirt"][-1]
        assert stream.reconnections == 2
    assert sorted(found) == list(range(1, len(motion) + 1))
    for number, vertices in found.items():
        np.testing.assert_allclose(vertices, whole["tshirt"][number - 1], rtol=0, atol=5e-6)


def test_reset_and_state(url, motion, whole):
    with StreamClient(url, "shell") as stream:
        stream.send(motion.poses[7], motion.transl[7])
        stream.receive()
        moved = stream.state()
        stream.reset()
        rest = stream.state()
        assert all(not rest[name].any() and moved[name].any() for name in moved)
        stream.send(motion.poses[0], motion.transl[0])
        np.testing.assert_allclose(stream.receive().meshes.vertices["tshirt"][0], whole["tshirt"][0], atol=5e-6)
    turned = dict(reversed(moved.items()))
    assert list(turned) != list(moved)
    for state in (np.concatenate(list(moved.values())), moved, turned):
        with StreamClient(url, "shell", state=state) as stream:
            assert all(np.array_equal(value, moved[name]) for name, value in stream.state().items())
    with pytest.raises(CaphyError, match=r"each garment asked for \(tshirt\), got tshirt, trousers"):
        StreamClient(url, "shell", ["tshirt"], state=moved)


def test_of_the_motion_before_a_reset_no_meshes_are_given(url, motion, whole):
    with StreamClient(url, "shell", credits=8) as stream:
        stream.send(motion.poses[7], motion.transl[7])
        stream.state()  # its meshes are here, or about to be
        stream.reset()
        stream.send(motion.poses[0], motion.transl[0])
        answer = stream.receive()
        assert (answer.number, answer.tick) == (2, 0)
        np.testing.assert_allclose(answer.meshes.vertices["tshirt"][0], whole["tshirt"][0], atol=5e-6)


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize("rates", [(30.0, 60.0), (60.0, 30.0), (30.0, 15.0)])
def test_a_new_rate_is_none_of_the_poses_before_it(wire, url, motion, rates, saved):
    """Neither where they go over a new connection again, nor of a state from before it."""

    def played(port: str, cut: bool) -> np.ndarray:
        with StreamClient(f"http://127.0.0.1:{port}", "shell", ["tshirt"], fps=rates[0], credits=64) as stream:
            for frame in range(20):
                if frame == 10:
                    stream.set_fps(rates[1])
                stream.send(motion.poses[frame], motion.transl[frame])
                found.append(stream.receive().meshes.vertices["tshirt"])
                if saved and frame == 5:
                    stream.state()
                if cut and frame == 13:
                    wire.cut()
            assert stream.reconnections == int(cut)
        return np.concatenate(found)

    found: list[np.ndarray] = []
    expected = played(url.rsplit(":", 1)[1], cut=False)
    found = []
    np.testing.assert_allclose(played(str(wire.port), cut=True), expected, atol=5e-6)


def test_a_state_from_before_a_reset_is_none_of_the_motion_after_it(wire, motion, whole, monkeypatch):
    monkeypatch.setattr("service.clients.stream.SAVE_EVERY", 1)
    with StreamClient(f"http://127.0.0.1:{wire.port}", "shell") as stream:
        stream.send(motion.poses[7], motion.transl[7])  # and asks for the state
        stream.reset()
        assert not any(state.any() for state in stream.state().values())
        stream.send(motion.poses[7], motion.transl[7])
        stream.reset()
        with pytest.raises(CaphyError, match="did not answer"):  # all that came of the old motion is read
            while True:
                stream.receive(0.5)
        wire.cut()
        stream.send(motion.poses[0], motion.transl[0])
        np.testing.assert_allclose(stream.receive().meshes.vertices["tshirt"][0], whole["tshirt"][0], atol=5e-6)
        assert stream.reconnections == 1


def test_the_state_may_be_asked_for_again_over_a_new_connection(wire, motion):
    with StreamClient(f"http://127.0.0.1:{wire.port}", "shell") as stream:
        stream.send(motion.poses[7], motion.transl[7])
        moved = stream.state()
        wire.cut()
        for _ in range(20):  # the answer may be here already, and the cut is noticed only by what comes after it
            if not stream.reconnections:
                with contextlib.suppress(CaphyError):
                    stream.receive(0.5)  # the new connection's state, which counts no poses
        assert stream.reconnections == 1
        again = stream.state(3.0)
        assert all(np.array_equal(again[name], moved[name]) for name in moved)


def test_refusals_reach_the_caller_and_the_stream_goes_on(url, motion):
    with StreamClient(url, "shell") as stream:
        stream.send(np.full((55, 3), 90.0), np.zeros(3))
        with pytest.raises(StreamRefused, match="are they degrees") as refused:
            stream.receive()
        assert refused.value.code == 422
        stream.send(motion.poses[0], motion.transl[0])
        assert stream.receive().number == 2
        before = stream.state(5.0)
        stream.send(np.full((55, 3), 90.0), np.zeros(3))
        after = stream.state(5.0)  # it has no part in the state, and nobody waits for it
        assert all(np.array_equal(before[name], after[name]) for name in before)
        with pytest.raises(StreamRefused, match="are they degrees"):
            stream.receive()
        with pytest.raises(CaphyError, match="shape"):
            stream.send(np.zeros((24, 3)), np.zeros(3))
        for transl in (np.zeros(2), np.zeros((2, 3)), "here"):
            with pytest.raises(CaphyError, match="transl"):
                stream.send(motion.poses[0], transl)
        with pytest.raises(CaphyError, match="times must be an array of numbers"):
            stream.send(motion.poses[0], motion.transl[0], "now")
        with pytest.raises(CaphyError, match=r"confidence must be one number or have shape \(1, 55\), got \(7,\)"):
            stream.send(motion.poses[0], motion.transl[0], 0.0, np.ones(7))
        with pytest.raises(CaphyError, match="fps must lie between 1 and 1000, got 0"):
            stream.set_fps(0.0)


@pytest.mark.parametrize(
    ("arguments", "options", "word"),
    [
        (("nobody",), {}, r"no avatar 'nobody'.*404"),
        (("shell", ["hat"]), {}, r"no garment 'hat'.*404"),
        (("shell",), {"state": np.zeros(5)}, r"state.*422"),
    ],
)
def test_hellos_that_are_refused(url, arguments, options, word):
    with pytest.raises(StreamRefused, match=word):
        StreamClient(url, *arguments, **options)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"encoding": "int4"}, "encoding must be one of float32"),
        ({"credits": 10**6}, "credits must lie between 1 and 65535"),
        ({"credits": -1}, "credits must lie between"),
        ({"garments": ["hät"]}, "garment names are"),
        ({"garments": ["h" * 50]}, "garment names are"),
        ({"fps": -1.0}, "fps must lie between 1 and 1000, got -1"),
        ({"fps": 1e39}, "fps must lie between 1 and 1000, got 1e"),
        ({"fps": float("nan")}, "fps must lie between 1 and 1000, got nan"),
        ({"state": "none"}, "state must be an array of numbers, got str"),
        ({"conditioning": {"latency": np.float32(0.1)}}, "settings of conditioning must be numbers"),
    ],
)
def test_hellos_that_cannot_be_said(url, options, word):
    with pytest.raises(CaphyError, match=word):
        StreamClient(url, "shell", **options)


def test_nobody_there():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    with pytest.raises(CaphyError, match="caphy serve"):
        StreamClient(f"http://127.0.0.1:{port}", "shell", patience=0.2)
    with pytest.raises(CaphyError, match="address"):
        StreamClient("127.0.0.1:8000", "shell")


@pytest.mark.parametrize("encoding", ["float32", "uint16"])
def test_javascript_streams_over_a_broken_connection(wire, motion, whole, encoding, tmp_path: Path):
    node = shutil.which("node")
    assert node, NODE
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    assert tuple(map(int, version.lstrip("v").split(".")[:2])) >= (20, 10), f"{NODE}, got {version}"
    sent = motion[:20]
    asked = {"fps": 30, "poses": sent.poses.reshape(20, 165).tolist(), "transl": sent.transl.tolist(), "pause": 8}
    (tmp_path / "motion.json").write_text(json.dumps(asked))
    script = Path(__file__).parent / "stream_client.mjs"
    address = f"ws://127.0.0.1:{wire.port}/avatars/shell/stream"
    command = [node, "--experimental-websocket", script, address, tmp_path / "motion.json", encoding, tmp_path / "out"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        watchdog = threading.Timer(60, process.kill)
        watchdog.start()
        assert process.stdout.readline() == "paused\n"
        wire.cut()
        time.sleep(0.05)
        process.communicate("go on\n")
        watchdog.cancel()
    assert process.returncode == 0
    found = json.loads((tmp_path / "out").read_text())
    assert found["errors"] == []
    assert found["reconnections"] >= 1
    assert set(found["sizes"]) == set(whole)
    assert found["latency"] > 0
    assert [answer["number"] for answer in found["received"]] == list(range(1, 21))
    for answer in found["received"]:
        for name, vertices in whole.items():
            expected = vertices[answer["number"] - 1].ravel()
            np.testing.assert_allclose(answer["vertices"][name], expected, rtol=0, atol=3e-5)
