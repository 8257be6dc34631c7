"""One garment network as an ONNX graph made for a single CPU thread.

Exactly the network of :mod:`caphy.network.garment_network`, arranged so that little is touched: only the joints that
the garment sees or hangs on, native GRU nodes, a low-rank head, blended transforms as one matrix product, and
coordinates kept planar (all x, all y, all z) until the end.
"""

from __future__ import annotations

import numpy as np
import onnx

from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.network.garment_network import GarmentNetwork
from export.features_graph import pose_features
from export.head import Head
from export.kinematics_graph import chain, local_transforms, rotation_products, skinning_transforms
from export.onnx_graph import OnnxGraph


def garment_graph(network: GarmentNetwork, head: Head, name: str) -> onnx.ModelProto:
    """Inputs poses (T, 55, 3) [rad], transl (T, 3) [m], state (S,); outputs vertices (T, V, 3) [m], next_state (S,)."""
    graph = OnnxGraph()
    poses = graph.input("poses", ["frames", JOINT_COUNT, 3])
    transl = graph.input("transl", ["frames", 3])
    state = graph.input("state", [network.state_size])

    weights = network.weights.double().numpy()
    influences = np.flatnonzero(weights.any(axis=0)).tolist()
    joints = chain([*influences, *network.driving], JOINT_PARENTS)
    products = rotation_products(graph, poses, joints)
    local = local_transforms(graph, products, joints, network.joints.double().numpy())
    moved = skinning_transforms(graph, local, joints, JOINT_PARENTS, influences)

    features, motion = pose_features(graph, network, local, joints, transl=transl, state=state)
    hidden, states = gru(graph, network, features, state)
    points = _head(graph, head, network.template.double().numpy(), hidden)
    vertices = _skin(graph, moved, transl, points, weights[:, influences])

    graph.output(vertices, "vertices", ["frames", len(weights), 3])
    graph.output(graph.node("Concat", *states, motion, axis=0), "next_state", [network.state_size])
    return graph.model(name, "CaPhy garment: poses, transl and state in, skinned vertices and state out")


def gru(graph: OnnxGraph, network: GarmentNetwork, features: str, state: str) -> tuple[str, list[str]]:
    """The last layer's output (T, width), and every layer's hidden state (width,) after the last frame."""
    width, layers = network.gru.hidden_size, network.gru.num_layers
    hidden = graph.nodes("Split", state, [width] * layers + [network.state_size - layers * width], outputs=layers + 1)
    sequence, states = graph.node("Unsqueeze", features, [1]), []
    for layer in range(layers):
        matrices = [_gates(network, f"{kind}_l{layer}") for kind in ("weight_ih", "weight_hh")]
        bias = np.concatenate([_gates(network, f"{kind}_l{layer}") for kind in ("bias_ih", "bias_hh")])
        if layer == 0:
            first = 6 * len(network.driving)
            matrices[0][:, first : first + 3] *= -1  # the graph's features hold minus gravity
        start = graph.node("Reshape", hidden[layer], [1, 1, width])
        sequence, last = graph.nodes(
            "GRU",
            sequence,
            *(matrix[None] for matrix in matrices),
            bias[None],
            None,
            start,
            outputs=2,
            hidden_size=width,
            linear_before_reset=1,
        )
        sequence = graph.node("Squeeze", sequence, [1])
        states.append(graph.node("Reshape", last, [width]))
    return graph.node("Squeeze", sequence, [1]), states


def _gates(network: GarmentNetwork, name: str) -> np.ndarray:
    """A GRU parameter with its three gates in ONNX's order (update, reset, new) instead of torch's (reset, update)."""
    reset, update, new = np.split(getattr(network.gru, name).detach().double().numpy(), 3)
    return np.concatenate([update, reset, new])


def _head(graph: OnnxGraph, head: Head, template: np.ndarray, hidden: str) -> str:
    """Canonical points as planes x, y, z and 1: (T, 1, 4, V)."""
    count = len(template)
    planar = np.arange(3 * count).reshape(count, 3).T.ravel()
    inner = graph.node("MatMul", hidden, head.reduce.T)
    bias = head.bias[planar] + template.T.ravel()
    expand = head.expand[planar].T
    halves = np.array_equal(head.expand, head.rounded().expand)  # then nothing is lost by storing it so
    points = graph.node("Gemm", inner, graph.half(expand) if halves else expand, bias)
    points = graph.node("Reshape", points, [-1, 1, 3, count])
    return graph.node("Pad", points, [0, 0, 0, 0, 0, 0, 1, 0], np.array(1.0))


def _skin(graph: OnnxGraph, moved: str, transl: str, points: str, weights: np.ndarray) -> str:
    """World vertices (T, V, 3) of joint transforms (T, n, 4, 4) and points (T, 1, 4, V); weights (V, n) sum to one,
    so ``transl`` rides along in the joints' transforms."""
    count, joints = weights.shape
    rows = graph.node("Slice", moved, [0], [3], [2])
    rows = graph.node("Transpose", rows, perm=[0, 2, 3, 1])
    shift = graph.node("Pad", graph.node("Unsqueeze", transl, [2, 3]), [0, 0, 3, 0, 0, 0, 0, 0])
    rows = graph.node("Reshape", graph.node("Add", rows, shift), [-1, joints])
    blended = graph.node("Reshape", graph.node("MatMul", rows, weights.T), [-1, 3, 4, count])
    planes = graph.node("ReduceSum", graph.node("Mul", blended, points), [2], keepdims=0)
    return graph.node("Transpose", planes, perm=[0, 2, 1])
