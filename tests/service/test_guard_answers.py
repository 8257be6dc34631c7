"""Answers part by part: every byte, in order, in pieces that a connection can take."""

from __future__ import annotations

import anyio
import numpy as np
import pytest

from service.answers import PIECE, PartsResponse

SIZES = [[], [0], [5], [PIECE], [PIECE + 1], [3, 0, PIECE - 3], [7, 2 * PIECE, 9], [PIECE // 2] * 5, [3 * PIECE]]


@pytest.mark.parametrize("sizes", SIZES)
def test_pieces_are_the_parts(sizes):
    rng = np.random.default_rng(0)
    parts = [rng.bytes(size) if number % 2 else memoryview(rng.bytes(size)) for number, size in enumerate(sizes)]
    sent: list[dict] = []

    async def send(message):
        sent.append(message)

    anyio.run(PartsResponse(parts, "application/octet-stream", 5.0), {"type": "http"}, None, send)
    start, *pieces = sent
    assert b"".join(piece["body"] for piece in pieces) == b"".join(parts)
    assert dict(start["headers"])[b"content-length"] == str(sum(sizes)).encode()
    assert [piece["more_body"] for piece in pieces] == [True] * (len(pieces) - 1) + [False]
    assert max(len(piece["body"]) for piece in pieces) <= PIECE
    assert len(pieces) == max(1, -(-sum(sizes) // PIECE))
