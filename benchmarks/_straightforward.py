"""The network as an ONNX graph written down without a thought about speed: what the exported one is held against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx

from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.network.garment_network import GarmentNetwork
from export.features_graph import pose_features
from export.garment_graph import gru, parted
from export.kinematics_graph import rotation_from_quaternion
from export.onnx_graph import OnnxGraph


def straightforward_graph(network: GarmentNetwork) -> onnx.ModelProto:
    """As one would write it down: every joint, full head, blended transforms and skinning by einsum."""
    graph, joints, count = OnnxGraph(), list(range(JOINT_COUNT)), len(network.template)
    poses, transl = graph.input("poses", ["frames", JOINT_COUNT, 3]), graph.input("transl", ["frames", 3])
    states = graph.node("Unsqueeze", graph.input("state", [network.state_size]), [0, 1])
    hidden, motion = parted(graph, network, states)
    streams = graph.node("Shape", states, start=1, end=2)
    products = _rotation_products(graph, poses, joints)
    local = _local_transforms(graph, products, joints, network.joints.double().numpy())
    moved = _skinning_transforms(graph, local, joints, JOINT_PARENTS, joints)
    entries = graph.node("Transpose", graph.node("Reshape", local, [0, 0, 4, 4]), perm=[2, 3, 1, 0])
    features, motion = pose_features(graph, network, entries, joints, transl=transl, motion=motion, streams=streams)
    hidden, after = gru(graph, network, features, hidden)
    weight, bias = (p.detach().double().numpy() for p in (network.head.weight, network.head.bias))
    points = graph.node("Gemm", hidden, weight.T, bias + network.template.double().numpy().ravel())
    points = graph.node("Reshape", points, [-1, count, 3])
    points = graph.node("Pad", points, [0, 0, 0, 0, 0, 1], np.array(1.0))
    blended = graph.node("Einsum", network.weights.double().numpy(), moved, equation="vj,tjab->tvab")
    posed = graph.node("Einsum", blended, points, equation="tvab,tvb->tva")
    posed = graph.node("Slice", posed, [0], [3], [2])
    graph.output(graph.node("Add", posed, graph.node("Unsqueeze", transl, [1])), "vertices", ["frames", count, 3])
    after = graph.node("Concat", *after, motion, axis=2)
    graph.output(graph.node("Squeeze", after, [0, 1]), "next_state", [network.state_size])
    return graph.model("straightforward", "")


def _rotation_products(graph: OnnxGraph, poses: str, joints: Sequence[int]) -> str:
    """Products q_a q_b (T, n + 1, 16) of the unit quaternions of ``joints``; the last one is the identity's.

    The angle is sqrt(|a|^2 + 1e-12): both cos(t/2) and sin(t/2)/t are smooth in t^2, so the shift costs nothing in
    float32 and spares a branch at zero.
    """
    angles = graph.node("Gather", poses, list(joints), axis=1)
    angles = graph.node("Pad", angles, [0, 0, 0, 0, 1, 0])
    square = graph.node("ReduceSumSquare", angles, [-1], keepdims=1)
    angle = graph.node("Sqrt", graph.node("Add", square, np.array(1e-12)))
    half = graph.node("Mul", angle, np.array(0.5))
    imaginary = graph.node("Mul", angles, graph.node("Div", graph.node("Sin", half), angle))
    quaternion = graph.node("Concat", graph.node("Cos", half), imaginary, axis=-1)
    left = graph.node("Unsqueeze", quaternion, [3])
    right = graph.node("Unsqueeze", quaternion, [2])
    return graph.node("Reshape", graph.node("Mul", left, right), [0, len(joints) + 1, 16])


def _local_transforms(graph: OnnxGraph, products: str, joints: Sequence[int], rest: np.ndarray) -> str:
    """Turns (T, n + 1, 16) of each joint about its own rest position, as row-major 4x4 matrices.

    Their products down the tree are the skinning transforms themselves: no correction by the rest pose is left.
    """
    count = len(joints) + 1
    centre = np.concatenate([rest[list(joints)], np.zeros((1, 3))])
    rotation = rotation_from_quaternion().reshape(16, 3, 3)
    linear = np.zeros((count, 16, 4, 4))
    linear[:, :, :3, :3] = rotation
    linear[:, :, :3, 3] = -np.einsum("qik,nk->nqi", rotation, centre)
    constant = np.zeros((count, 4, 4))
    constant[:, :3, 3] = centre
    constant[:, 3, 3] = 1
    rows = graph.node("Unsqueeze", products, [2])
    entries = graph.node("MatMul", rows, linear.reshape(count, 16, 16))
    entries = graph.node("Reshape", entries, [0, count, 16])
    return graph.node("Add", entries, constant.reshape(count, 16))


def _skinning_transforms(
    graph: OnnxGraph, local: str, joints: Sequence[int], parents: Sequence[int], wanted: Sequence[int]
) -> str:
    """Rest-to-posed transforms (T, len(wanted), 4, 4) from local ones (T, n + 1, 16), without ``transl``.

    Pointer doubling: every round multiplies each joint's product by that of the joint where it ends and doubles the
    distance reached, so ceil(log2(depth)) batched products do the whole tree.
    """
    place = {joint: i for i, joint in enumerate(joints)}
    nothing = len(joints)
    above = np.array([place.get(int(parents[j]), nothing) for j in joints] + [nothing])
    current = graph.node("Reshape", local, [0, nothing + 1, 4, 4])
    needed = [place[j] for j in wanted]
    while True:
        last = (above[above] == nothing).all()
        rows = needed if last else list(range(nothing + 1))
        ends = graph.node("Gather", current, above[rows], axis=1)
        own = graph.node("Gather", current, rows, axis=1) if last else current
        current = graph.node("MatMul", ends, own)
        if last:
            return current
        above = above[above]
