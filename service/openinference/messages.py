"""The JSON of requests and answers, and the bytes after it.

Sources: the Open Inference Protocol's REST specification, and Triton's binary tensor data extension: where the header
``inference-header-content-length`` says so, the JSON ends after that many bytes, and the tensors whose parameters hold
``binary_data_size`` follow it in their order, little-endian and row-major.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from service.errors import Problem
from service.json_bodies import validated

HEADER_LENGTH: Final = "inference-header-content-length"
DATATYPE: Final = "FP32"
FLOAT: Final = np.dtype("<f4")
Dimension = Annotated[int, Field(ge=0, lt=1 << 32)]
MOST_DIMENSIONS: Final = 8


class Known(BaseModel):
    """What is not known is refused by name: who asks for it would take the answer for what he asked."""

    model_config = ConfigDict(extra="forbid", strict=True)


class InputParameters(Known):
    """binary_data_size: bytes of the tensor after the JSON."""

    binary_data_size: int | None = None


class InputTensor(Known):
    """One tensor of a request: numbers in ``data``, nested or flat, or bytes after the JSON."""

    name: str
    shape: Annotated[list[Dimension], Field(fail_fast=True)] = Field(max_length=MOST_DIMENSIONS)
    datatype: str
    parameters: InputParameters = InputParameters()
    data: list[Any] | None = None


class OutputParameters(Known):
    """binary_data: whether the tensor comes as bytes."""

    binary_data: bool | None = None


class RequestedOutput(Known):
    """One tensor of the answer that is asked for."""

    name: str
    parameters: OutputParameters = OutputParameters()


class Error(BaseModel):
    """What every endpoint under ``/v2`` answers where it refuses."""

    error: str


class InferParameters(Known):
    """fps: of the poses [Hz]. binary_data_output: whether tensors of which nothing else is said come as bytes."""

    fps: float | None = None
    binary_data_output: bool = False


class InferRequest(Known):
    """The JSON of a request; KServe's client repeats the model's name in it."""

    id: str | None = Field(None, max_length=256)
    model_name: str | None = None
    parameters: InferParameters = InferParameters()
    inputs: Annotated[list[InputTensor], Field(fail_fast=True)] = Field(max_length=8)
    outputs: Annotated[list[RequestedOutput], Field(fail_fast=True)] = Field([], max_length=8)

    def wanted(self, names: Sequence[str]) -> dict[str, bool]:
        """The outputs asked for, all of ``names`` where none is, and whether as bytes.

        Raises Problem for others than ``names``.
        """
        binary = self.parameters.binary_data_output
        if not self.outputs:
            return dict.fromkeys(names, binary)
        for output in self.outputs:
            if output.name not in names:
                raise Problem(422, f"outputs: must be among {', '.join(names)}, got {output.name[:64]!r}")
        said = {output.name: output.parameters.binary_data for output in self.outputs}
        return {name: binary if as_bytes is None else as_bytes for name, as_bytes in said.items()}


def request_schema() -> dict[str, Any]:
    """JSON schema of :class:`InferRequest`, without references: it stands deep inside another document."""
    schema = InferRequest.model_json_schema()
    definitions = schema.pop("$defs")

    def resolved(node: Any) -> Any:
        if isinstance(node, dict):
            reference = node.get("$ref", "").rpartition("/")[2]
            return resolved(definitions[reference]) if reference else {k: resolved(v) for k, v in node.items()}
        return [resolved(item) for item in node] if isinstance(node, list) else node

    return resolved(schema)


def decode(
    body: bytes, header_length: str | None, most: int, state_size: int
) -> tuple[InferRequest, dict[str, np.ndarray]]:
    """The JSON of a request of at most ``most`` frames and its tensors by name, float32; raises Problem where the bytes
    are no such request."""
    size = _json_size(header_length, len(body))
    request = validated(InferRequest, body[:size], most, state_size)
    tensors: dict[str, np.ndarray] = {}
    for tensor in request.inputs:
        if tensor.name in tensors:
            raise Problem(422, f"inputs: {tensor.name[:64]!r} comes twice")
        if tensor.datatype != DATATYPE:
            raise Problem(422, f"{tensor.name[:64]}: datatype must be {DATATYPE}, got {tensor.datatype[:64]!r}")
        tensors[tensor.name], size = _tensor(tensor, body, size)
    if size != len(body):
        raise Problem(422, f"{len(body) - size} bytes are left after the JSON and the tensors it announces")
    return request, tensors


def _json_size(header_length: str | None, total: int) -> int:
    if header_length is None:
        return total
    if not header_length.isascii() or not header_length.isdigit() or int(header_length[:20]) > total:
        raise Problem(422, f"{HEADER_LENGTH} must be the bytes of JSON in {total}, got {header_length[:64]!r}")
    return int(header_length)


def _tensor(tensor: InputTensor, body: bytes, offset: int) -> tuple[np.ndarray, int]:
    """The tensor's array, and where the next one's bytes start."""
    name, count = tensor.name[:64], math.prod(tensor.shape)
    said, size = tensor.parameters.binary_data_size, FLOAT.itemsize * count
    if said is None:
        return _shaped(_numbers(tensor.data, name, count), tensor), offset
    if tensor.data is not None:
        raise Problem(422, f"{name}: must have either data or binary_data_size, got both")
    if said != size:
        raise Problem(422, f"{name}: shape {tensor.shape} makes {size} bytes, got {said}")
    if offset + size > len(body):
        raise Problem(422, f"{name}: {size} bytes are announced, {len(body) - offset} are left")
    return _shaped(np.frombuffer(body, FLOAT, count, offset), tensor), offset + size


def _shaped(numbers: np.ndarray, tensor: InputTensor) -> np.ndarray:
    """The ``numbers`` in the shape that they are known to fill; beside a 0 other dimensions may be beyond any array."""
    try:
        return numbers.reshape(tensor.shape)
    except ValueError as error:
        raise Problem(422, f"{tensor.name[:64]}: no array has the shape {tensor.shape}; send what it holds") from error


def _numbers(data: list[Any] | None, name: str, count: int) -> np.ndarray:
    """Numbers of JSON, nested or flat."""
    if data is None:
        raise Problem(422, f"{name}: must have data, or binary_data_size and bytes after the JSON")
    flat = data
    for _ in range(MOST_DIMENSIONS):
        if not flat or set(map(type, flat)) != {list} or len(set(map(len, flat))) > 1:
            break
        flat = list(chain.from_iterable(flat))
    if not set(map(type, flat)) <= {int, float}:  # asked first: as NumPy's text each takes as much as the longest
        raise Problem(422, f"{name}: data must be numbers, in a flat list or in nested lists of equal length")
    if len(flat) != count:
        raise Problem(422, f"{name}: the shape makes {count} numbers, data holds {len(flat)}")
    try:
        with np.errstate(over="ignore"):  # becomes infinite, which is refused with the place where it stands
            return np.array(flat, np.float64).astype(np.float32)
    except OverflowError as error:
        raise Problem(422, f"{name}: data must be numbers that a float can hold") from error


def encode(
    head: Mapping[str, Any], tensors: Mapping[str, np.ndarray], binary: Mapping[str, bool]
) -> tuple[list[bytes | memoryview], dict[str, str]]:
    """The parts of an answer's bytes and its headers.

    ``tensors`` are float32; those of ``binary`` are answered, as bytes where it says so.
    """
    outputs, raw = [], []
    for name, as_bytes in binary.items():
        array = np.ascontiguousarray(tensors[name], FLOAT)
        facts = {"name": name, "shape": list(array.shape), "datatype": DATATYPE}
        if as_bytes:
            raw.append(array.reshape(-1).view(np.uint8).data)
            outputs.append(json.dumps({**facts, "parameters": {"binary_data_size": array.nbytes}}))
        else:
            outputs.append(f'{json.dumps(facts)[:-1]}, "data": [{", ".join(_flat(array))}]}}')
    text = f'{json.dumps(head)[:-1]}, "outputs": [{", ".join(outputs)}]}}'.encode()
    if not any(binary.values()):
        return [text], {"content-type": "application/json"}
    return [text, *raw], {"content-type": "application/octet-stream", HEADER_LENGTH: str(len(text))}


def _flat(array: np.ndarray) -> Iterator[str]:
    """Numbers as JSON, exactly; row by row, because the encoder holds the interpreter's lock while it works."""
    for row in array.reshape(-1, array.size // len(array)) if array.ndim > 1 and len(array) else array[None]:
        yield json.dumps(row.astype(np.float64).ravel().tolist())[1:-1]
