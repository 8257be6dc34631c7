"""A small builder for ONNX graphs: one method call per node, arrays become initializers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET: Final = 18
IR_VERSION: Final = 9

Value = str | np.ndarray | Sequence[int] | None
"""The name of a tensor, a constant array, a list of integers (shapes, axes), or nothing for an optional input."""


class OnnxGraph:
    """Nodes in the order they were added; names of tensors are what :meth:`node` returns."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def input(self, name: str, shape: Sequence[int | str]) -> str:
        """Declare a float32 input; words in ``shape`` are dynamic axes."""
        self._inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)))
        return name

    def output(self, value: str, name: str, shape: Sequence[int | str]) -> None:
        """Declare a float32 output that takes the tensor ``value``."""
        self._nodes.append(helper.make_node("Identity", [value], [name]))
        self._outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)))

    def constant(self, array: np.ndarray | Sequence[int]) -> str:
        """An initializer; reals become float32, integers int64."""
        array = np.asarray(array)
        array = array.astype(np.float32 if array.dtype.kind == "f" else np.int64)
        return self._stored(array)

    def half(self, array: np.ndarray) -> str:
        """A float32 value stored as float16; the runtime widens it once, when it loads the graph."""
        return self.node("Cast", self._stored(np.asarray(array, dtype=np.float16)), to=TensorProto.FLOAT)

    def _stored(self, array: np.ndarray) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def nodes(self, kind: str, *inputs: Value, outputs: int, **attributes: Any) -> list[str]:
        """Add a node; returns the names of its outputs."""
        names = [self._name(value) for value in inputs]
        results = [f"t{len(self._nodes)}_{i}" for i in range(outputs)]
        self._nodes.append(helper.make_node(kind, names, results, **attributes))
        return results

    def node(self, kind: str, *inputs: Value, **attributes: Any) -> str:
        """Add a node with one output; returns its name."""
        return self.nodes(kind, *inputs, outputs=1, **attributes)[0]

    def model(self, name: str, doc: str) -> onnx.ModelProto:
        """The checked model."""
        graph = helper.make_graph(self._nodes, name, self._inputs, self._outputs, self._constants, doc)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="caphy",
        )
        onnx.checker.check_model(model, full_check=True)
        return model

    def _name(self, value: Value) -> str:
        if value is None:
            return ""
        return value if isinstance(value, str) else self.constant(value)
