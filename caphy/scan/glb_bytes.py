"""GLB files as bytes, changed so that their reader keeps the file's order of meshes and its colours."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

_SHORT, _BYTE = 5123, 5121  # component types of glTF: unsigned, of 16 and 8 bits
_PARTS = {"VEC3": 3, "VEC4": 4}


def ordered_glb(data: bytes) -> bytes:
    """The GLB whose nodes a reader that takes the last of a list first visits in the file's order, with colours of 16
    bits, of which that reader keeps the lower half, as their upper 8."""
    size = struct.unpack_from("<I", data, 12)[0]
    tree, rest = json.loads(data[20 : 20 + size]), bytearray(data[20 + size :])
    for scene in tree.get("scenes", ()):
        scene.get("nodes", []).reverse()
    for node in tree.get("nodes", ()):
        node.get("children", []).reverse()
    colours = {
        primitive["attributes"]["COLOR_0"]
        for mesh in tree.get("meshes", ())
        for primitive in mesh["primitives"]
        if "COLOR_0" in primitive["attributes"]
    }
    for number in sorted(colours):
        _to_bytes(tree, rest, tree["accessors"][number])
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + bytes(rest)


def _to_bytes(tree: dict[str, Any], rest: bytearray, accessor: dict[str, Any]) -> None:
    """Let colours of 16 bits be their upper bytes, where each stood; ``rest`` is all behind the header's chunk."""
    if accessor["componentType"] != _SHORT or "bufferView" not in accessor or "sparse" in accessor:
        return
    parts, view = _PARTS[accessor["type"]], tree["bufferViews"][accessor["bufferView"]]
    stride, count = view.get("byteStride", 2 * parts), accessor["count"]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    first = 8 + start  # behind the head of the binary chunk
    rows = np.lib.stride_tricks.as_strided(np.frombuffer(rest, np.uint8, offset=first), (count, 2 * parts), (stride, 1))
    if first + (count - 1) * stride + 2 * parts > len(rest):
        raise ValueError("colours reach beyond the file's end")
    rows[:, :parts] = rows[:, 1::2].copy()
    length = (count - 1) * stride + parts
    tree["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": length, "byteStride": stride})
    accessor.update(bufferView=len(tree["bufferViews"]) - 1, byteOffset=0, componentType=_BYTE)
