"""Wrote the vectors in this folder, by docs/stream.md and nothing else: it imports nothing of the service.

python tests/service/vectors/make.py
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

HERE = Path(__file__).parent


def header(kind: int, count: int = 0, number: int = 0, extra: int = 0, time: float = 0.0) -> bytes:
    return b"CPHS" + bytes([1, kind]) + struct.pack("<HIId", count, number, extra, time)


def floats(values: list[float]) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def name(text: str) -> bytes:
    return text.encode() + bytes(40 - len(text))


POSES = [i / 64 for i in range(2 * 165)]
TRANSL = [0.5, -1.0, 2.0, 0.25, 8.0, -0.125]
TIMES = [0.125, 1 / 3]
SURE = [(i % 9) / 8 for i in range(2 * 55)]
HAT = [0.5, 0.25, -1.0, 1.5, -0.75, 2.0]
"""One frame of two vertices."""
WELCOME = {"fps": 30, "max_frames": 32, "max_credits": 64}
CHOSEN = {"encoding": "float32", "normals": False}


def welcome(count: int) -> bytes:
    return header(129, 1, 0, 3) + struct.pack("<fHH", 30, 32, 64) + name("hat") + struct.pack("<II", count, 3)


def meshes(body: bytes, frames: int = 1) -> bytes:
    return header(130, frames, 41, 5, 12.5) + struct.pack("<If", 17, 1.5) + body


def client() -> dict[str, tuple[bytes, dict]]:
    plain = struct.pack("<fHBB", 30, 2, 0, 0)
    full = struct.pack("<fHBB", 59.5, 4, 2, 1)
    hello = {"garments": ["hat", "left-glove_2"], "fps": 59.5, "encoding": "uint16", "normals": True, "credits": 4,
             "state": [0.5, -2.0, 0.0]}  # fmt: skip
    return {
        "hello": (
            header(1, 2, 0, 3) + full + name("hat") + name("left-glove_2") + floats([0.5, -2, 0]),
            {"kind": "hello", **hello},
        ),
        "hello_short": (
            header(1) + plain,
            {"kind": "hello", "garments": [], "fps": 30, "credits": 2, "state": [], **CHOSEN},
        ),
        "poses": (
            header(2, 2, 7, 0, 1234.0625) + floats(POSES) + floats(TRANSL),
            {"kind": "poses", "number": 7, "time": 1234.0625, "poses": POSES, "transl": TRANSL},
        ),
        "hello_conditioned": (
            header(1, 0, 24, 2) + plain + floats([1, 2]) + b'{"cutoff":2,"hold":0.25}',
            {"kind": "hello", "garments": [], "fps": 30, "credits": 2, "state": [1.0, 2.0], **CHOSEN,
             "conditioning": {"cutoff": 2, "hold": 0.25}},
        ),
        "seen": (
            header(7, 2, 7, 0, 1234.0625) + struct.pack("<2d", *TIMES) + floats(POSES) + floats(TRANSL) + floats(SURE),
            {"kind": "seen", "number": 7, "time": 1234.0625, "poses": POSES, "transl": TRANSL, "times": TIMES,
             "confidence": SURE},
        ),
        "credit": (header(3, extra=3), {"kind": "credit", "count": 3}),
        "reset": (header(4), {"kind": "reset"}),
        "rate": (header(5) + floats([120]), {"kind": "rate", "fps": 120}),
        "get_state": (header(6, time=9.75), {"kind": "get_state", "time": 9.75}),
    }  # fmt: skip


def server() -> dict[str, tuple[bytes, dict]]:
    answer = {"kind": "meshes", "number": 41, "skipped": 5, "time": 12.5, "tick": 17, "milliseconds": 1.5, "frames": 1}
    low, step = [-1.0, 0.0, 2.0], [2**-10, 2**-9, 2**-8]
    corners = [0, 65535, 256, 1024, 0, 65535]
    quantised = [low[i % 3] + step[i % 3] * corner for i, corner in enumerate(corners)]
    halves = struct.pack("<6e", 0.5, -0.25, 1, 2**-24, -2, 65504) + bytes(0)
    from_halves = [c + h for c, h in zip([1.0, 0.0, -1.0] * 2, [0.5, -0.25, 1, 2**-24, -2, 65504], strict=True)]
    turned = [0.0, 0.6, 0.0, 0.8] * 55
    weights = [1.5, -0.25, 3.0]
    return {
        "welcome": (
            welcome(2),
            {"kind": "welcome", **WELCOME, "garments": [{"name": "hat", "count": 2, "state_size": 3}]},
        ),
        "meshes_float32": (meshes(floats(HAT)), {**answer, **CHOSEN, "vertices": {"hat": HAT}}),
        "welcome_conditioned": (
            header(129, 1, 0, 3, 0.0625) + welcome(2)[24:],
            {"kind": "welcome", **WELCOME, "garments": [{"name": "hat", "count": 2, "state_size": 3}],
             "latency": 0.0625},
        ),
        "meshes_conditioned": (
            meshes(struct.pack("<d", 1 / 3) + bytes([16, 33, 0]) + bytes(1) + floats(HAT * 3), 3),
            {**answer, **CHOSEN, "frames": 3, "vertices": {"hat": HAT * 3}, "conditioned": True, "shown": 1 / 3,
             "did": [16, 33, 0]},
        ),
        "meshes_none": (meshes(b"", 0), {**answer, **CHOSEN, "frames": 0, "vertices": {"hat": []}}),
        "meshes_float16": (
            meshes(floats([1, 0, -1]) + halves),
            {**answer, "encoding": "float16", "normals": False, "vertices": {"hat": from_halves}},
        ),
        "meshes_uint16": (
            meshes(floats(low) + floats(step) + struct.pack("<6H", *corners) + bytes([127, 0, 0, 0, 0, 129, 0, 0])),
            {**answer, "encoding": "uint16", "normals": True, "vertices": {"hat": quantised},
             "unit_normals": {"hat": [1, 0, 0, 0, -1, 0]}},
        ),
        "meshes_weights": (
            meshes(floats([0.125, 1, 2]) + floats(turned) + struct.pack("<3e", *weights) + bytes(2)),
            {**answer, "encoding": "weights", "normals": False, "count": 3, "root": [0.125, 1, 2],
             "rotations": turned, "weights": {"hat": weights}},
        ),
        "state": (
            header(131, 0, 40, 3, 2.5) + floats([0.5, -0.5, 0.25]),
            {"kind": "state", "number": 40, "time": 2.5, "state": [0.5, -0.5, 0.25]},
        ),
        "error": (
            header(132, 0, 39, 422) + "angles: 4π at most".encode(),
            {"kind": "error", "number": 39, "code": 422, "text": "angles: 4π at most"},
        ),
    }  # fmt: skip


if __name__ == "__main__":
    meaning: dict[str, dict] = {}
    for side, messages in (("client", client()), ("server", server())):
        for title, (body, meant) in messages.items():
            (HERE / f"{side}_{title}.bin").write_bytes(body)
            meaning[f"{side}_{title}"] = meant
    (HERE / "vectors.json").write_text(json.dumps(meaning, indent=1) + "\n")
