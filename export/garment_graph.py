"""One garment network as an ONNX graph made for a single CPU thread.

Exactly the network of :mod:`caphy.network.garment_network`, arranged so that little is touched: only the joints that
the garment sees or hangs on, native GRU nodes, a low-rank head, blended transforms as one matrix product, and
coordinates kept planar (all x, all y, all z) until the end.
"""

from __future__ import annotations

import numpy as np
import onnx

from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.network.features import MOTION_STATE
from caphy.network.garment_network import GarmentNetwork
from export.features_graph import pose_features
from export.head import Head
from export.kinematics_graph import chain, local_transforms, quaternions, skinning_transforms
from export.onnx_graph import OnnxGraph


def garment_graph(network: GarmentNetwork, head: Head, name: str) -> onnx.ModelProto:
    """Inputs poses (T, 55, 3) [rad], transl (T, 3) [m], state (S,); outputs vertices (T, V, 3) [m], next_state (S,).

    The same graph computes B streams at once: their states one after another, (B S,), and T B rows of poses, all
    streams' first frames before their second ones.
    """
    graph = OnnxGraph()
    poses = graph.input("poses", ["frames", JOINT_COUNT, 3])
    transl = graph.input("transl", ["frames", 3])
    joined = f"streams*{network.state_size}"
    states = graph.node("Reshape", graph.input("state", [joined]), [1, -1, network.state_size])
    hidden, motion = parted(graph, network, states)
    streams = graph.node("Shape", states, start=1, end=2)

    weights = network.weights.double().numpy()
    influences = np.flatnonzero(weights.any(axis=0)).tolist()
    joints = chain([*influences, *network.driving], JOINT_PARENTS)
    local = local_transforms(graph, quaternions(graph, poses, joints), joints, network.joints.double().numpy())
    moved = skinning_transforms(graph, local, joints, JOINT_PARENTS, influences)

    features, motion = pose_features(graph, network, local, joints, transl=transl, motion=motion, streams=streams)
    sequence, after = gru(graph, network, features, hidden)
    points = _head(graph, head, network.template.double().numpy(), sequence)
    vertices = _skin(graph, moved, transl, points, weights[:, influences])

    graph.output(vertices, "vertices", ["frames", len(weights), 3])
    after = graph.node("Concat", *after, motion, axis=2)
    graph.output(graph.node("Reshape", after, [-1]), "next_state", [joined])
    return graph.model(name, "CaPhy garment: poses, transl and state in, skinned vertices and state out")


def parted(graph: OnnxGraph, network: GarmentNetwork, states: str) -> tuple[list[str], str]:
    """States (1, B, S) as every layer's hidden state (1, B, width) and the motion's state (1, B, 16)."""
    sizes = [network.gru.hidden_size] * network.gru.num_layers + [MOTION_STATE]
    *hidden, motion = graph.nodes("Split", states, sizes, outputs=len(sizes), axis=2)
    return hidden, motion


def gru(graph: OnnxGraph, network: GarmentNetwork, features: str, hidden: list[str]) -> tuple[str, list[str]]:
    """The last layer's output (N, width), and every layer's hidden state (1, B, width) after the last frame.

    Features are (T, B, D), the hidden states before the first frame (1, B, width) for each layer.
    """
    sequence, after = features, []
    for layer, start in enumerate(hidden):
        matrices = [_gates(network, f"{kind}_l{layer}") for kind in ("weight_ih", "weight_hh")]
        bias = np.concatenate([_gates(network, f"{kind}_l{layer}") for kind in ("bias_ih", "bias_hh")])
        if layer == 0:
            first = 6 * len(network.driving)
            matrices[0][:, first : first + 3] *= -1  # the graph's features hold minus gravity
        inputs = sequence if layer == 0 else graph.node("Squeeze", sequence, [1])
        sequence, last = graph.nodes(
            "GRU",
            inputs,
            *(matrix[None] for matrix in matrices),
            bias[None],
            None,
            start,
            outputs=2,
            hidden_size=network.gru.hidden_size,
            linear_before_reset=1,
        )
        after.append(last)
    return graph.node("Reshape", sequence, [-1, network.gru.hidden_size]), after


def _gates(network: GarmentNetwork, name: str) -> np.ndarray:
    """A GRU parameter with its three gates in ONNX's order (update, reset, new) instead of torch's (reset, update)."""
    reset, update, new = np.split(getattr(network.gru, name).detach().double().numpy(), 3)
    return np.concatenate([update, reset, new])


def _head(graph: OnnxGraph, head: Head, template: np.ndarray, hidden: str) -> str:
    """Canonical points as planes x, y and z: (N, 1, 3, V)."""
    count = len(template)
    planar = np.arange(3 * count).reshape(count, 3).T.ravel()
    inner = graph.node("MatMul", hidden, head.reduce.T)
    bias = head.bias[planar] + template.T.ravel()
    expand = head.expand[planar].T
    halves = np.array_equal(head.expand, head.rounded().expand)  # then nothing is lost by storing it so
    points = graph.node("Gemm", inner, graph.half(expand) if halves else expand, bias)
    return graph.node("Reshape", points, [-1, 1, 3, count])


def _skin(graph: OnnxGraph, moved: str, transl: str, points: str, weights: np.ndarray) -> str:
    """World vertices (N, V, 3) of joint transforms (4, 4, n, N) and points (N, 1, 3, V); weights (V, n) sum to one,
    so ``transl`` rides along in the joints' transforms.

    The sum runs over the last axis but one: over the second it takes four times as long when a frame comes alone.
    """
    moved = graph.node("Slice", moved, [0], [3], [0])
    moved = graph.node("Transpose", moved, perm=[3, 0, 1, 2])
    linear, shift = graph.nodes("Split", moved, [3, 1], outputs=2, axis=2)
    turned = graph.node("Mul", graph.node("MatMul", linear, weights.T), points)
    shift = graph.node("Add", graph.node("Squeeze", shift, [2]), graph.node("Unsqueeze", transl, [2]))
    turned = graph.node("ReduceSum", turned, [2], keepdims=0)
    planes = graph.node("Add", turned, graph.node("MatMul", shift, weights.T))
    return graph.node("Transpose", planes, perm=[0, 2, 1])
