"""A garment network read back from the ONNX graph that serves it."""

from __future__ import annotations

import numpy as np
import onnx
import torch
from onnx import numpy_helper

from caphy.errors import CaphyError
from caphy.io.bundle import BundledGarment
from caphy.network.garment_network import GarmentNetwork


def network_of(garment: BundledGarment, joints: np.ndarray, fps: float) -> GarmentNetwork:
    """The network that a bundle's graph computes, as trainable as when it was exported.

    The GRU's weights come back exactly, up to the order of gates. The head comes back as the graph holds it: of the
    rank it was reduced to, its large factor rounded to float16. Nothing is lost against what the avatar serves.

    Args:
        garment: one garment of a bundle.
        joints: the bundle's rest joints (55, 3) [m].
        fps: the bundle's frame rate [Hz].

    Raises:
        CaphyError: the graph is not one that ``caphy export`` writes.
    """
    try:
        layers, head, bias = _weights(onnx.load_from_string(garment.onnx))
        width = layers[0][1].shape[1]
        template = garment.mesh.vertices
        weights = garment.mesh.dense_weights()
        network = GarmentNetwork(template, weights, joints, fps=fps, layers=len(layers), width=width)
        _set_gru(network, layers)
        with torch.no_grad():
            network.head.weight.copy_(torch.tensor(_by_vertex(head)))
            network.head.bias.copy_(torch.tensor(_by_vertex(bias) - template.ravel()))
    except Exception as error:  # onnx raises protobuf's own errors
        raise CaphyError(
            f"garment {garment.name!r}: its graph is not one that 'caphy export' writes, so no network can be read "
            f"back from it ({error}); give the folder that 'caphy train' wrote instead"
        ) from error
    return network


def _weights(model: onnx.ModelProto) -> tuple[list[tuple[np.ndarray, ...]], np.ndarray, np.ndarray]:
    """GRU layers (input, recurrent, both biases), and the head (3V, width) with its bias (3V,), coordinate-major."""
    graph = model.graph
    arrays = {tensor.name: numpy_helper.to_array(tensor).astype(np.float64) for tensor in graph.initializer}
    made_by = {output: node for node in graph.node for output in node.output}
    layers = [tuple(arrays[name][0] for name in node.input[1:4]) for node in graph.node if node.op_type == "GRU"]
    (gemm,) = (node for node in graph.node if node.op_type == "Gemm" and len(node.input) == 3)
    inner, expand, bias = gemm.input
    if expand not in arrays:  # stored in half precision
        expand = made_by[expand].input[0]
    return layers, (arrays[made_by[inner].input[1]] @ arrays[expand]).T, arrays[bias]


def _set_gru(network: GarmentNetwork, layers: list[tuple[np.ndarray, ...]]) -> None:
    """Gates from ONNX's order (update, reset, new) to torch's (reset, update, new); gravity's sign turned back."""
    for layer, (inputs, recurrent, biases) in enumerate(layers):
        values = inputs, recurrent, *np.split(biases, 2)
        for kind, value in zip(("weight_ih", "weight_hh", "bias_ih", "bias_hh"), values, strict=True):
            update, reset, new = np.split(value, 3)
            ordered = np.concatenate([reset, update, new])
            if layer == 0 and kind == "weight_ih":
                first = 6 * len(network.driving)
                ordered[:, first : first + 3] *= -1  # the graph's features hold minus gravity
            parameter = getattr(network.gru, f"{kind}_l{layer}")
            if parameter.shape != ordered.shape:
                raise ValueError(f"{kind} of layer {layer} is {ordered.shape}, not {tuple(parameter.shape)}")
            parameter.data.copy_(torch.tensor(ordered))


def _by_vertex(values: np.ndarray) -> np.ndarray:
    """Rows of all x, all y, all z (3V, ...) as x, y, z of each vertex."""
    return values.reshape(3, -1, *values.shape[1:]).swapaxes(0, 1).reshape(values.shape)
