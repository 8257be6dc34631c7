"""The stream's bytes against vectors that neither client wrote, in Python and in node."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caphy.errors import CaphyError
from service.encodings import Encoding
from service.stream.messages import (
    Credit,
    Dressed,
    Failure,
    GarmentRecord,
    GetState,
    Hello,
    Poses,
    Rate,
    Reset,
    Seen,
    ServerDecoder,
    State,
    Welcome,
    decode_client,
    encode_client,
    encode_failure,
    encode_meshes_message,
    encode_state,
    encode_welcome,
)

VECTORS = Path(__file__).parent / "vectors"
MEANING: dict[str, dict[str, Any]] = json.loads((VECTORS / "vectors.json").read_text())
CLIENT = [name for name in MEANING if name.startswith("client_")]
SERVER = [name for name in MEANING if name.startswith("server_")]


def vector(name: str) -> bytes:
    return (VECTORS / f"{name}.bin").read_bytes()


def client_message(meant: dict[str, Any]):
    match meant["kind"]:
        case "hello":
            encoding, state = Encoding[meant["encoding"].upper()], np.array(meant["state"], "<f4")
            text = json.dumps(meant["conditioning"], separators=(",", ":")) if "conditioning" in meant else ""
            names, credits = tuple(meant["garments"]), meant["credits"]
            return Hello(names, meant["fps"], encoding, meant["normals"], credits, state, text)
        case "poses" | "seen":
            poses, transl = np.array(meant["poses"], "<f4"), np.array(meant["transl"], "<f4")
            given = meant["number"], meant["time"], poses.reshape(-1, 55, 3), transl.reshape(-1, 3)
            times, sure = meant.get("times", ()), np.array(meant.get("confidence", ()), "<f4").reshape(-1, 55)
            return Seen(*given, np.array(times), sure) if len(times) else Poses(*given)
        case "credit":
            return Credit(meant["count"])
        case "rate":
            return Rate(meant["fps"])
        case "get_state":
            return GetState(meant["time"])
    return Reset()


def decoder_for(meant: dict[str, Any]) -> ServerDecoder:
    encoding = Encoding[meant.get("encoding", "float32").upper()]
    counts, conditioned = {"hat": meant.get("count", 2)}, meant.get("conditioned", False)
    return ServerDecoder(encoding, meant.get("normals", False), counts, conditioned)


@pytest.mark.parametrize("name", CLIENT)
def test_client_messages(name):
    message = client_message(MEANING[name])
    assert encode_client(message) == vector(name)
    found = decode_client(vector(name))
    assert type(found) is type(message)
    for key, value in vars(message).items():
        np.testing.assert_array_equal(getattr(found, key), value, err_msg=key)


@pytest.mark.parametrize("name", SERVER)
def test_server_messages_are_understood(name):
    meant = MEANING[name]
    found = decoder_for(meant).decode(vector(name))
    match found:
        case Welcome():
            assert found.garments == tuple(GarmentRecord(**garment) for garment in meant["garments"])
            assert (found.fps, found.max_frames, found.max_credits) == (30, 32, 64)
            assert found.latency == meant.get("latency", 0)
        case Dressed():
            for key in ("number", "skipped", "time", "tick", "milliseconds"):
                assert getattr(found, key) == meant[key]
            assert found.meshes.frames == meant["frames"]
            assert found.shown == meant.get("shown", 0)
            np.testing.assert_array_equal([] if found.did is None else found.did, meant.get("did", []))
            for kind in ("vertices", "weights"):
                for garment, values in meant.get(kind, {}).items():
                    np.testing.assert_array_equal(getattr(found.meshes, kind)[garment].ravel(), np.float32(values))
            if "root" in meant:
                assert found.meshes.joints is not None
                np.testing.assert_array_equal(found.meshes.joints.root.ravel(), np.float32(meant["root"]))
                np.testing.assert_array_equal(found.meshes.joints.rotations.ravel(), np.float32(meant["rotations"]))
            for garment, values in meant.get("unit_normals", {}).items():
                np.testing.assert_array_equal(found.meshes.normals[garment].ravel(), values)
        case State():
            assert (found.number, found.time, found.state.tolist()) == (40, 2.5, meant["state"])
        case Failure():
            assert (found.code, found.number, found.text) == (422, 39, meant["text"])


@pytest.mark.parametrize("name", SERVER)
def test_server_messages_are_written(name):
    meant = MEANING[name]
    message = decoder_for(meant).decode(vector(name))
    match message:
        case Welcome():
            assert encode_welcome(message) == vector(name)
        case Dressed():
            encoding = Encoding[meant["encoding"].upper()]
            written = b"".join(encode_meshes_message(message, encoding))
            if encoding in (Encoding.FLOAT32, Encoding.WEIGHTS):
                assert written == vector(name)
                return
            assert written[:32] == vector(name)[:32]  # a writer may choose other bounds for the same vertices
            again = decoder_for(meant).decode(written)
            assert isinstance(again, Dressed)
            expected = message.meshes.vertices["hat"]
            np.testing.assert_allclose(again.meshes.vertices["hat"], expected, atol=np.ptp(expected) / 4096)
        case State():
            assert encode_state(message) == vector(name)
        case Failure():
            assert encode_failure(message) == vector(name)


@pytest.fixture(scope="module")
def javascript() -> dict[str, Any]:
    node = shutil.which("node")
    assert node, (
        "node (18 or later) must be installed: the JavaScript client is tested with it (apt-get install nodejs)"
    )
    done = subprocess.run([node, VECTORS / "read.mjs"], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", CLIENT)
def test_javascript_writes_the_same_bytes(javascript, name):
    assert javascript["encoded"][name] == vector(name).hex()


@pytest.mark.parametrize("name", SERVER)
def test_javascript_understands_the_same(javascript, name):
    meant, found = MEANING[name], javascript["decoded"][name]
    for key in ("number", "skipped", "time", "tick", "milliseconds", "frames", "code", "text", "state", "fps"):
        if key in meant:
            assert found[key] == meant[key], key
    for kind in ("vertices", "weights"):
        for garment, values in meant.get(kind, {}).items():
            np.testing.assert_array_equal(np.float32(found["garments"][garment][kind]), np.float32(values))
    for key in ("root", "rotations"):
        np.testing.assert_array_equal(np.float32(found.get(key, [])), np.float32(meant.get(key, [])))
    for garment, values in meant.get("unit_normals", {}).items():
        normals = np.reshape(found["garments"][garment]["normals"], (-1, 4)) / 127
        np.testing.assert_array_equal(normals, np.c_[np.reshape(values, (-1, 3)), [0, 0]])
    if meant["kind"] == "welcome":
        assert found["garments"] == [{"name": "hat", "count": 2, "stateSize": 3}]
        assert (found["maxFrames"], found["maxCredits"], found["latency"]) == (32, 64, meant.get("latency", 0))
    assert (found.get("shown", 0), found.get("did", [])) == (meant.get("shown", 0), meant.get("did", []))
    whole = 24 if meant["kind"] == "error" else len(vector(name))
    assert javascript["refused"][name] == whole  # every shorter message


@pytest.mark.parametrize("name", MEANING)
def test_cut_messages_are_refused_in_words(name):
    body, meant = vector(name), MEANING[name]
    decode = decode_client if name.startswith("client_") else decoder_for(meant).decode
    for end in range(24 if meant["kind"] == "error" else len(body)):
        with pytest.raises(CaphyError):
            decode(body[:end])
    for at, byte in ((0, b"X"), (4, b"\2"), (5, b"\x63")):
        with pytest.raises(CaphyError):
            decode(body[:at] + byte + body[at + 1 :])


def test_messages_of_the_other_side_are_refused():
    with pytest.raises(CaphyError, match="one of the server's"):
        decode_client(vector("server_state"))
    with pytest.raises(CaphyError, match="one of the client's"):
        ServerDecoder(Encoding.FLOAT32, False).decode(vector("client_reset"))


@pytest.mark.parametrize("name", ["client_poses", "client_seen"])
def test_numbers_that_no_answer_could_carry_are_refused(name):
    """An answer carries the number of the newest pose."""
    body = vector(name)
    message = decode_client(body)
    last = 2**32 - len(message.poses)
    assert decode_client(body[:8] + struct.pack("<I", last) + body[12:]).number == last
    with pytest.raises(CaphyError, match="must be below 2\\^32"):
        decode_client(body[:8] + struct.pack("<I", last + 1) + body[12:])


@given(st.binary(max_size=300))
def test_any_bytes_are_refused_in_words(body):
    for decode in (decode_client, ServerDecoder(Encoding.UINT16, True, {"hat": 2}).decode):
        with pytest.raises(CaphyError):
            decode(body)


@given(
    kind=st.integers(0, 255), count=st.integers(0, 65535), extra=st.integers(0, 2**32 - 1), tail=st.binary(max_size=90)
)
def test_any_header_is_understood_or_refused_in_words(kind, count, extra, tail):
    body = b"CPHS" + bytes([1, kind]) + struct.pack("<HIId", count, 1, extra, 0.0) + tail
    for decode in (decode_client, ServerDecoder(Encoding.WEIGHTS, False, {"hat": 2}).decode):
        try:
            decode(body)
        except CaphyError as error:
            assert str(error)


def test_a_long_error_is_cut_between_letters():
    found = ServerDecoder(Encoding.FLOAT32, False).decode(encode_failure(Failure(422, "ü" * 1500)))
    assert isinstance(found, Failure)
    assert found.text == "ü" * 1000
