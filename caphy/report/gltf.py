"""The container: a glTF 2.0 document and its one binary buffer, written as GLB."""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np

COMPONENT_TYPES: Final = {"|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
SHAPES: Final = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTEX_DATA: Final = 34962
INDICES: Final = 34963


class Gltf:
    """A document under construction; add to ``document`` freely, arrays through :meth:`accessor`."""

    def __init__(self, generator: str) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": generator}}
        self._buffer = bytearray()

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append to a top-level list such as ``nodes``; returns the index."""
        entries = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def accessor(self, array: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Store an array whose first axis counts elements; returns the accessor's index.

        ``target`` says what a graphics card uses it for; ``bounds`` writes the minimum and maximum that glTF asks
        for with positions and times. Matrices are given row-major and stored column-major.
        """
        shape = array.shape[1:]
        stored = array.transpose(0, 2, 1) if shape == (4, 4) else array
        stored = np.ascontiguousarray(stored, stored.dtype.newbyteorder("<"))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": stored.nbytes}
        if target is not None:
            view["target"] = target
        self._buffer += stored.tobytes()
        self._buffer += bytes(-len(self._buffer) % 4)
        entry: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view),
            "componentType": COMPONENT_TYPES[stored.dtype.str],
            "count": len(array),
            "type": SHAPES[shape],
        }
        if bounds:
            entry["min"] = np.atleast_1d(array.min(axis=0)).tolist()
            entry["max"] = np.atleast_1d(array.max(axis=0)).tolist()
        return self.add("accessors", entry)

    def glb(self) -> bytes:
        """The document and its buffer as one binary file."""
        document = {**self.document, "buffers": [{"byteLength": len(self._buffer)}]}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self._buffer)
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, length),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(self._buffer), b"BIN\0"),
                bytes(self._buffer),
            ]
        )
