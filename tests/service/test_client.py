"""The client against a live service."""

from __future__ import annotations

import json
import socket
import threading
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.io.poses.sequence import SMPLX_PELVIS
from service.client import Client
from service.clients.feed import FeedClient
from service.clients.stream import StreamClient
from service.engine import GarmentEngine


def test_frames_are_the_engines(url, bundle, motion):
    client = Client(url)
    meshes = client.frames("shell", motion)
    for garment in bundle.garments:
        engine = GarmentEngine(garment)
        arrays = (motion.poses.astype(np.float32), motion.transl.astype(np.float32))
        np.testing.assert_array_equal(meshes[garment.name], engine.run(*arrays, engine.initial_state())[0])
    assert set(client.server_timing) == {"parse", "infer", "encode"}
    assert client.server_timing["infer"] > 0


def test_a_motion_in_parts(url, motion):
    client = Client(url)
    whole = client.frames("shell", motion, ["tshirt"])
    first = client.run("shell", motion[:11], ["tshirt"])
    second = client.run("shell", motion[11:], ["tshirt"], first.states)
    joined = np.concatenate([first.vertices["tshirt"], second.vertices["tshirt"]])
    np.testing.assert_allclose(joined, whole["tshirt"], atol=5e-6)


def test_z_up_motions_are_turned(url, motion):
    client = Client(url)
    expected, found = client.frames("shell", motion), client.frames("shell", motion.to_z_up())
    np.testing.assert_allclose(found["tshirt"], expected["tshirt"], atol=1e-5)


@pytest.mark.parametrize("condition", [None, {}])
def test_roots_stand_where_those_of_another_body_stood(url, motion, condition):
    client = Client(url)
    expected, found = (client.run("shell", m, condition=condition) for m in (motion, motion.about(SMPLX_PELVIS)))
    np.testing.assert_allclose(found.vertices["tshirt"], expected.vertices["tshirt"], atol=1e-5)


@pytest.mark.parametrize("z_up", [False, True])
def test_a_cameras_view_of_another_body_is_told_about_the_avatars_pelvis(url, motion, z_up):
    client, view = Client(url), replace(motion, frame="camera")
    other = view.about(SMPLX_PELVIS)
    settings = {"up": [0.0, -0.8, -0.6]}
    expected = client.run("shell", view, condition=settings)
    found = client.run("shell", other.to_z_up() if z_up else other, condition=settings)
    np.testing.assert_allclose(found.vertices["tshirt"], expected.vertices["tshirt"], atol=1e-5)


def test_an_avatar_is_asked_for_once_a_motion(url, motion, monkeypatch):
    """Not once for all: between two motions the service may have loaded another skeleton under its name."""
    client, asked, states = Client(url), [], None
    describe = client.describe
    monkeypatch.setattr(client, "describe", lambda avatar: asked.append(avatar) or describe(avatar))
    for frame in range(3):
        states = client.run("shell", motion[frame : frame + 1], states=states).states
    assert asked == ["shell"]
    expected = client.frames("shell", motion)
    before = describe("shell")
    client._avatars["shell"] = {**before, "fps": 10.0, "joints": (np.array(before["joints"]) + 0.25).tolist()}
    np.testing.assert_array_equal(client.frames("shell", motion)["tshirt"], expected["tshirt"])


def test_states_go_by_their_names(url, motion):
    client = Client(url)
    first = client.run("shell", motion[:11])
    expected = client.run("shell", motion[11:], states=first.states)
    turned = dict(reversed(first.states.items()))
    assert list(turned) != list(first.states)
    found = client.run("shell", motion[11:], states=turned)
    for name, vertices in expected.vertices.items():
        np.testing.assert_array_equal(found.vertices[name], vertices)


@pytest.mark.parametrize(
    ("garments", "states", "word"),
    [
        (["tshirt"], ["trousers"], r"each garment asked for \(tshirt\), got trousers"),
        (["tshirt"], ["tshirt", "trousers"], r"asked for \(tshirt\), got tshirt, trousers"),
        ([], ["tshirt"], r"asked for \(tshirt, trousers\), got tshirt"),
        ([], ["tshirt", "trousers", "hat"], "got tshirt, trousers, hat"),
    ],
)
def test_states_of_other_garments_are_refused(url, motion, garments, states, word):
    client = Client(url)
    known = client.run("shell", motion[:2]).states
    told = {name: known.get(name, np.zeros(3)) for name in states}
    with pytest.raises(CaphyError, match=word):
        client.run("shell", motion[2:4], garments, told)
    with pytest.raises(CaphyError, match="state of tshirt must have shape"):
        client.run("shell", motion[2:4], ["tshirt"], {"tshirt": known["tshirt"][1:]})


def test_lists_and_describes(url):
    client = Client(url)
    assert [avatar["id"] for avatar in client.avatars()] == ["shell"]
    assert client.describe("shell")["name"] == "shell"


def test_the_services_words_reach_the_caller(url, motion):
    client = Client(url)
    with pytest.raises(CaphyError, match=r"no avatar 'nobody'.*HTTP 404"):
        client.frames("nobody", motion)
    with pytest.raises(CaphyError, match="no garment"):
        client.frames("shell", motion, ["hat"])
    assert client.frames("shell", motion)  # the connection still serves


def test_camera_frames_are_not_guessed(url, motion):
    with pytest.raises(CaphyError, match="camera"):
        Client(url).frames("shell", replace(motion, frame="camera"))


def test_nobody_there_and_no_address():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    with pytest.raises(CaphyError, match="cannot be reached"):
        Client(f"http://127.0.0.1:{port}").avatars()
    with pytest.raises(CaphyError, match="address"):
        Client("localhost:8000")


@pytest.mark.parametrize(
    "client", [Client, partial(StreamClient, avatar="a"), partial(FeedClient, avatar="a", feed="f")]
)
@pytest.mark.parametrize(
    ("url", "key", "word"),
    [
        ("http://h:99999", None, "address is like .*got 'http://h:99999'"),
        ("http://h:abc", None, "address is like"),
        ("http://[::1", None, "address is like"),
        ("http://127.0.0.1:9", "a\nkey", "a key is one line"),
    ],
)
def test_addresses_and_keys_that_cannot_be_are_refused_in_words(client, url, key, word):
    with pytest.raises(CaphyError, match=word):
        client(url, key=key)


def test_hosts_without_a_name_that_can_be_are_told(url):
    with pytest.raises(CaphyError, match="cannot be reached"):
        Client(f"http://{'h' * 80}.example").avatars()


class Prefixed(BaseHTTPRequestHandler):
    """A service below a path."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps([{"id": self.path, "fps": 30, "garments": []}]).encode())

    def log_message(self, *_):
        pass


def test_a_service_may_be_below_a_path():
    with ThreadingHTTPServer(("127.0.0.1", 0), Prefixed) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for end in ("", "/"):
            client = Client(f"http://127.0.0.1:{server.server_port}/clothes{end}")
            assert [avatar["id"] for avatar in client.avatars()] == ["/clothes/avatars"]
            client.close()
        server.shutdown()


class Closing(BaseHTTPRequestHandler):
    """Answers so many requests, each on a connection that it then ends without saying so."""

    protocol_version = "HTTP/1.1"
    left = 0
    seen = 0

    def do_GET(self):
        type(self).seen += 1
        self.close_connection = True
        if type(self).left:
            type(self).left -= 1
            self.send_response(200)
            self.send_header("content-length", "2")
            self.end_headers()
            self.wfile.write(b"[]")

    def log_message(self, *_):
        pass


def test_a_connection_that_ended_in_silence_is_made_again_once(monkeypatch):
    monkeypatch.setattr(Closing, "left", 3)
    monkeypatch.setattr(Closing, "seen", 0)
    with ThreadingHTTPServer(("127.0.0.1", 0), Closing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = Client(f"http://127.0.0.1:{server.server_port}")
        assert [client.avatars() for _ in range(3)] == [[], [], []]
        assert Closing.seen == 3
        for tries in (4, 5):  # the old connection has ended, and over a new one nothing is answered
            with pytest.raises(CaphyError, match="cannot be reached"):
                client.avatars()
            assert Closing.seen == tries
        server.shutdown()


def test_long_motions_are_resampled_and_sent_in_parts(url, motion, monkeypatch):
    client = Client(url)
    whole = client.frames("shell", motion)
    monkeypatch.setattr("service.client.PART", 7)
    parts = client.frames("shell", motion)
    np.testing.assert_allclose(parts["tshirt"], whole["tshirt"], atol=5e-6)
    fast = motion.resample(4 * motion.fps)
    again = client.frames("shell", fast)
    assert again["tshirt"].shape == whole["tshirt"].shape
    np.testing.assert_allclose(again["tshirt"], whole["tshirt"], atol=1e-4)


def test_a_motion_that_gets_long_by_resampling_goes_in_parts(url, motion):
    poses, transl = np.tile(motion.poses, (28, 1, 1)), np.tile(motion.transl, (28, 1))
    slow = replace(motion, poses=poses, transl=transl, fps=10.0)  # 840 poses, but more frames than a request may have
    assert len(Client(url).frames("shell", slow, ["tshirt"])["tshirt"]) == 2518


def test_settings_that_json_cannot_hold_are_told(url, motion):
    with pytest.raises(CaphyError, match="settings of conditioning must be numbers"):
        Client(url).run("shell", motion, condition={"latency": np.float32(0.1)})


def test_parameters_that_are_none_are_told(url):
    with pytest.raises(CaphyError, match="'garments' is no parameter here; there is garment"):
        Client(url)._ask("POST", "/avatars/shell/frames?garments=tshirt", b"")


@pytest.mark.parametrize("content", [b"<html>", b"[1]", b"{}", b'[{"name": "other"}]'])
def test_what_is_another_service_is_told(monkeypatch, content):
    """Another program on the port: it answers 200, with something else."""
    client = Client("http://127.0.0.1:1")
    monkeypatch.setattr(client, "_ask", lambda *_: content)
    with pytest.raises(CaphyError, match="what answers there is not 'caphy serve'"):
        client.avatars()
    with pytest.raises(CaphyError, match="what answers there is not 'caphy serve'"):
        client.describe("shell")


def test_a_closed_stream_is_not_opened_anew(url, motion):
    """By a camera's last picture, say."""
    stream = StreamClient(url, "shell")
    stream.send(motion.poses[0], motion.transl[0])
    stream.close()
    for ask in (lambda: stream.send(motion.poses[1], motion.transl[1]), stream.receive, stream.state, stream.reset):
        with pytest.raises(CaphyError, match="this stream was closed"):
            ask()
    assert stream.reconnections == 0


@pytest.mark.parametrize("scheme", ["http", "ws"])
def test_proxies_of_the_environment_are_not_asked(url, motion, monkeypatch, scheme):
    """As by the client of requests: the service of this machine is not behind one."""
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    with StreamClient(url.replace("http", scheme), "shell") as stream:
        stream.send(motion.poses[0], motion.transl[0])
        assert stream.receive().number == 1
    with FeedClient(url.replace("http", scheme), "shell", "camera") as feed:
        assert feed.page.startswith("http://")
