"""A garment's network ends in a linear map: its blend shapes, and their weights for a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import onnxruntime

from caphy.errors import CaphyError
from caphy.io.bundle import BundledGarment
from caphy.io.onnx_wire import read_graph, with_output


@dataclass(frozen=True, eq=False)
class BlendShapes:
    """Canonical vertices base + sum_k weights[k] targets[k], before skinning.

    base: (V, 3) [m]. targets: (R, V, 3) [m], largest first. tensor: name of the tensor (T, R) of the garment's graph
    that holds the weights of the first R targets.
    """

    base: np.ndarray
    targets: np.ndarray
    tensor: str

    def first(self, count: int, mean: np.ndarray) -> BlendShapes:
        """The first ``count`` targets; those left out rest at their ``mean`` weights (R,)."""
        base = self.base + np.tensordot(mean[count:], self.targets[count:], axes=1)
        return replace(self, base=base, targets=self.targets[:count])


def blend_shapes(garment: BundledGarment) -> BlendShapes:
    """The blend shapes in a garment's graph: all that its network has, so nothing is lost.

    Raises CaphyError where the graph does not end in a linear head.
    """
    graph, count = read_graph(garment.onnx), len(garment.mesh.vertices)
    cast_from = {node.outputs[0]: node.inputs[0] for node in graph.nodes if node.kind == "Cast"}
    for node in graph.nodes:
        if node.kind != "Gemm" or len(node.inputs) != 3:
            continue
        weights, matrix, bias = node.inputs
        expand = graph.constants.get(cast_from.get(matrix, matrix))
        base = graph.constants.get(bias)
        if expand is not None and base is not None and expand.shape[1:] == base.shape == (3 * count,):
            targets = expand.astype(np.float64).reshape(-1, 3, count).transpose(0, 2, 1)
            return BlendShapes(base.astype(np.float64).reshape(3, count).T, targets, weights)
    raise CaphyError(f"garment {garment.name!r}: its graph has no linear head; export the avatar again")


def blend_weights(garment: BundledGarment, shapes: BlendShapes, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Weights (T, R) of all of a garment's blend shapes for poses (T, 55, 3) [rad] and transl (T, 3) [m]."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    content = with_output(garment.onnx, shapes.tensor)
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    state, found = np.zeros(garment.state_size, np.float32), []
    for start in range(0, len(poses), 32):
        part = slice(start, start + 32)
        inputs = {"poses": poses[part].astype(np.float32), "transl": transl[part].astype(np.float32), "state": state}
        weights, state = cast(list[np.ndarray], session.run([shapes.tensor, "next_state"], inputs))
        found.append(weights)
    return np.concatenate(found)
