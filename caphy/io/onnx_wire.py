"""What little of an ONNX file is needed to find a garment's blend shapes, read without the ``onnx`` package.

An ONNX file is one protocol buffer (https://protobuf.dev/programming-guides/encoding, field numbers of onnx.proto).
The service has no ``onnx`` package, and needs none for three fields.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.errors import CaphyError

_GRAPH, _NODE, _INITIALIZER, _OUTPUT = 7, 1, 5, 12
_TYPES: Final = {1: "<f4", 10: "<f2"}
"""TensorProto.DataType of reals."""


@dataclass(frozen=True)
class Node:
    """One operation: its kind, and the names of the tensors it takes and gives."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Graph:
    """The nodes in their order, and the constant tensors of real numbers by name."""

    nodes: tuple[Node, ...]
    constants: dict[str, np.ndarray]


def read_graph(content: bytes) -> Graph:
    """The graph of an ONNX file; raises CaphyError where the bytes are none."""
    nodes, constants = [], {}
    try:
        for number, graph in _fields(memoryview(content)):
            if number != _GRAPH:
                continue
            for kind, value in _fields(_bytes(graph)):
                if kind == _NODE:
                    nodes.append(_node(_bytes(value)))
                elif kind == _INITIALIZER:
                    name, array = _tensor(_bytes(value))
                    if array is not None:
                        constants[name] = array
    except (IndexError, ValueError, TypeError) as error:
        raise CaphyError(f"not an ONNX graph, or a damaged one ({error}); export the avatar again") from error
    return Graph(tuple(nodes), constants)


def with_output(content: bytes, tensor: str) -> bytes:
    """The ONNX file with ``tensor``, float32 with two axes, as one more output of its graph.

    Protocol buffers of one kind that follow each other are merged, so nothing needs to be parsed.
    """
    unknown = _field(2, 2 * _field(1, b""))  # TypeProto.Tensor.shape: two dimensions of any length
    float32 = _field(1, 1) + unknown  # TypeProto.Tensor.elem_type
    value = _field(1, tensor.encode()) + _field(2, _field(1, float32))
    return content + _field(_GRAPH, _field(_OUTPUT, value))


def _node(content: memoryview) -> Node:
    names: dict[int, list[str]] = {1: [], 2: [], 4: []}
    for number, value in _fields(content):
        if number in names:
            names[number].append(bytes(_bytes(value)).decode())
    return Node(names[4][0], tuple(names[1]), tuple(names[2]))


def _tensor(content: memoryview) -> tuple[str, np.ndarray | None]:
    shape, dtype, name, raw = [], 0, "", memoryview(b"")
    for number, value in _fields(content):
        match number, value:
            case 1, int():
                shape.append(value)
            case 2, int():
                dtype = value
            case 8, memoryview():
                name = bytes(value).decode()
            case 9, memoryview():
                raw = value
    if dtype not in _TYPES:
        return name, None
    return name, np.frombuffer(raw, _TYPES[dtype]).reshape(shape)


def _fields(content: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of each field of a message."""
    at = 0
    while at < len(content):
        key, at = _varint(content, at)
        kind = key & 7
        if kind == 0:
            value, at = _varint(content, at)
            yield key >> 3, value
            continue
        if kind not in (1, 2, 5):
            raise ValueError(f"field of unknown kind {kind}")
        size, at = _varint(content, at) if kind == 2 else ({1: 8, 5: 4}[kind], at)
        if at + size > len(content):
            raise ValueError("cut short")
        yield key >> 3, content[at : at + size]
        at += size


def _varint(content: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = content[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise ValueError("a number of more than 64 bits")


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise TypeError("a number where a message must be")
    return value


def _field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return _number(number << 3) + _number(value)
    return _number(number << 3 | 2) + _number(len(value)) + value


def _number(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])
