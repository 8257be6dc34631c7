"""Two thousand mutated requests: every answer is a mesh or a 4xx in words."""

from __future__ import annotations

import json

import numpy as np
from test_app import BINARY, FRAMES, body_of

REQUESTS = 1000


def mutated(body: bytes, rng: np.random.Generator) -> bytes:
    """The body with bytes flipped, cut, repeated or overwritten, mostly near its header."""
    changed = bytearray(body)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, 40 if rng.random() < 0.6 else max(len(changed), 1)))
        match rng.integers(0, 5):
            case 0 if at < len(changed):
                changed[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                changed[at : at + 4] = rng.bytes(4)
            case 2:
                del changed[at : at + int(rng.integers(1, 64))]
            case 3:
                changed[at:at] = changed[at : at + 16]
            case 4:
                changed[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\xc0\x7f", b"\0\0\0\0", b"\0\0\x80\xff"])
    return bytes(changed)


def answers(http, bodies, headers) -> dict[int, int]:
    found: dict[int, int] = {}
    for body in bodies:
        response = http.post(FRAMES, content=body, headers=headers)
        found[response.status_code] = found.get(response.status_code, 0) + 1
        assert response.status_code == 200 or 400 <= response.status_code < 500, (response.text[:300], body[:64])
        if response.status_code != 200:
            assert response.json()["detail"]
        elif headers is BINARY:
            assert np.isfinite(np.frombuffer(response.content[-400:], "<f4")).all()
    return found


def test_mutated_binary_requests(http, motion, bundle):
    rng = np.random.default_rng(0)
    state = np.zeros(sum(garment.state_size for garment in bundle.garments))
    seeds = [body_of(motion[:3]), body_of(motion[:2], state=state), body_of(motion[:4], fps=60)]
    found = answers(http, (mutated(seeds[i % 3], rng) for i in range(REQUESTS)), BINARY)
    assert found[422] > REQUESTS / 4
    assert found[200] > REQUESTS / 50  # some mutations are harmless, so valid requests are exercised too


def test_mutated_json_requests(http, motion):
    rng = np.random.default_rng(1)
    seed = json.dumps({"fps": 30, "poses": motion.poses[:1].round(2).tolist(), "transl": [[0, 0, 0]]}).encode()
    found = answers(http, (mutated(seed, rng) for _ in range(REQUESTS)), {"content-type": "application/json"})
    assert found[422] > REQUESTS / 4
