"""Ten thousand mutated binary requests and a thousand of JSON: every answer is a mesh, or a 4xx in words."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import anyio
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from test_app import FRAMES, body_of

from service.app import create_app
from service.openinference.messages import HEADER_LENGTH
from service.settings import Settings

REQUESTS = 5000
JSON_REQUESTS = 1000
BINARY = [(b"content-type", b"application/octet-stream")]
INFER = "/v2/models/shell.tshirt/infer"
Asked = tuple[bytes, list[tuple[bytes, bytes]]]


def mutated(body: bytes, rng: np.random.Generator, head: int = 40) -> bytes:
    """The body with bytes flipped, cut, repeated or overwritten, mostly in its first ``head`` bytes."""
    changed = bytearray(body)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, head if rng.random() < 0.6 else max(len(changed), 1)))
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


@pytest.fixture(scope="module")
def http(avatars: Path) -> Iterator[TestClient]:
    """Without the limit of requests per second, which a fast machine reaches here, so that all are read."""
    settings = Settings(avatars=avatars, max_client_rate=1e9)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


async def post(app: FastAPI, path: str, body: bytes, headers: list[tuple[bytes, bytes]]) -> tuple[int, bytes]:
    """Status and body of an answer, straight from the application: ten times as fast as through a client."""
    sent = []

    async def receive() -> dict[str, object]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": path, "query_string": b"", "headers": headers}
    await app(scope, receive, send)
    return sent[0]["status"], b"".join(bytes(message["body"]) for message in sent[1:])


def answers(http, path: str, requests: Iterable[Asked]) -> Counter[int]:
    """How often each status was answered; anything but 200 and 4xx in words fails."""
    found: Counter[int] = Counter()
    words = "error" if path.startswith("/v2") else "detail"

    async def ask_all() -> None:
        for body, headers in requests:
            status, answer = await post(http.app, path, body, headers)
            found[status] += 1
            assert status == 200 or 400 <= status < 500, (answer[:300], body[:64])
            if status != 200:
                assert json.loads(answer)[words]
            elif headers is BINARY:
                assert np.isfinite(np.frombuffer(answer[-400:], "<f4")).all()

    anyio.run(ask_all)
    return found


def test_mutated_binary_requests(http, motion, bundle):
    rng = np.random.default_rng(0)
    state = np.zeros(sum(garment.state_size for garment in bundle.garments))
    seeds = [body_of(motion[:3]), body_of(motion[:2], state=state), body_of(motion[:4], fps=60)]
    found = answers(http, FRAMES, ((mutated(seeds[i % 3], rng), BINARY) for i in range(REQUESTS)))
    assert found[422] > REQUESTS / 4
    assert found[200] > REQUESTS / 50  # some mutations are harmless, so valid requests are exercised too


def test_mutated_open_inference_requests(http, motion):
    """JSON with tensors behind it; the header's length is mutated too."""
    rng = np.random.default_rng(1)
    poses = motion.poses[:2].astype("<f4").tobytes()
    tensor = {"name": "poses", "shape": [2, 55, 3], "datatype": "FP32", "parameters": {"binary_data_size": len(poses)}}
    head = json.dumps({"inputs": [tensor], "parameters": {"binary_data_output": True}}).encode()

    def asked(number: int) -> Asked:
        length = str(len(head) + int(rng.integers(-3, 4)) * (number % 4 == 0)).encode()
        return mutated(head + poses, rng, len(head)), [(HEADER_LENGTH.encode(), length)]

    found = answers(http, INFER, (asked(number) for number in range(REQUESTS)))
    assert found[400] > REQUESTS / 4
    assert found[200] > REQUESTS / 50


def test_mutated_json_requests(http, motion):
    rng = np.random.default_rng(2)
    seed = json.dumps({"fps": 30, "poses": motion.poses[:1].round(2).tolist(), "transl": [[0, 0, 0]]}).encode()
    headers = [(b"content-type", b"application/json")]
    found = answers(http, FRAMES, ((mutated(seed, rng), headers) for _ in range(JSON_REQUESTS)))
    assert found[422] > JSON_REQUESTS / 4
