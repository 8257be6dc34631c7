"""The bytes on the wire, against docs/protocol.md spelled out by hand."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caphy.errors import CaphyError
from service.protocol import (
    FramesRequest,
    FramesResponse,
    decode_request,
    decode_response,
    encode_request,
    encode_response,
)


def test_request_byte_by_byte():
    poses = np.arange(6, dtype=np.float32).reshape(1, 2, 3)
    body = encode_request(FramesRequest(poses, np.array([[7.0, 8.0, 9.0]]), 30.0, np.array([0.5])))
    expected = b"CPHQ" + bytes([1, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]) + struct.pack("<f", 30) + bytes([1, 0, 0, 0])
    expected += struct.pack("<10f", 0, 1, 2, 3, 4, 5, 7, 8, 9, 0.5)
    assert body == expected


def test_response_byte_by_byte():
    answer = FramesResponse({"hat": np.ones((2, 1, 3))}, {"hat": np.array([4.0])}, 30.0, 60.0)
    body = b"".join(encode_response(answer))
    expected = b"CPHR" + bytes([1, 0, 1, 0, 2, 0, 0, 0]) + struct.pack("<ff", 30, 60)
    expected += b"hat" + bytes(37) + bytes([1, 0, 0, 0, 1, 0, 0, 0]) + struct.pack("<7f", *[1] * 6, 4)
    assert body == expected


@given(frames=st.integers(0, 4), joints=st.integers(0, 4), states=st.integers(0, 5), seed=st.integers(0, 99))
def test_requests_survive_the_wire(frames, joints, states, seed):
    rng = np.random.default_rng(seed)
    sent = FramesRequest(rng.random((frames, joints, 3)), rng.random((frames, 3)), 29.97, rng.random(states))
    found = decode_request(encode_request(sent))
    np.testing.assert_array_equal(found.poses, sent.poses.astype(np.float32))
    np.testing.assert_array_equal(found.transl, sent.transl.astype(np.float32))
    np.testing.assert_array_equal(found.state, sent.state.astype(np.float32))
    assert found.fps == pytest.approx(29.97)


@given(
    sizes=st.lists(st.tuples(st.integers(1, 5), st.integers(0, 4)), min_size=1, max_size=3), frames=st.integers(0, 3)
)
def test_responses_survive_the_wire(sizes, frames):
    vertices = {f"g{i}": np.random.rand(frames, v, 3).astype(np.float32) for i, (v, _) in enumerate(sizes)}
    states = {f"g{i}": np.random.rand(s).astype(np.float32) for i, (_, s) in enumerate(sizes)}
    body = b"".join(encode_response(FramesResponse(vertices, states, 30, 30)))
    found = decode_response(body)
    assert list(found.vertices) == list(vertices)
    for name, expected in vertices.items():
        np.testing.assert_array_equal(found.vertices[name], expected)
        np.testing.assert_array_equal(found.states[name], states[name])
    for end in (0, 10, len(body) - 1):
        with pytest.raises(CaphyError):
            decode_response(body[:end])


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_in_words(body):
    for decode in (decode_request, decode_response):
        with pytest.raises(CaphyError):
            decode(body)
