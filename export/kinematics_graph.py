"""Axis-angle poses to skinning transforms as ONNX nodes.

Joints and frames are the last two axes of everything here: each of a matrix's entries is one long row, and a product of
matrices is a few products of rows, which costs a fraction of as many little matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caphy.conventions import JOINT_COUNT
from export.onnx_graph import OnnxGraph


def chain(joints: Sequence[int], parents: Sequence[int]) -> list[int]:
    """``joints`` and all that carry them, the root included, in order."""
    found = {0}
    for joint in joints:
        above = joint
        while above > 0:
            found.add(above)
            above = int(parents[above])
    return sorted(found)


def rotation_from_quaternion() -> np.ndarray:
    """Matrix (16, 9) from the products q_a q_b (row-major, w first) of a unit quaternion to its rotation matrix."""
    w, x, y, z = range(4)
    terms = [
        [(1, w, w), (1, x, x), (-1, y, y), (-1, z, z)], [(2, x, y), (-2, w, z)], [(2, x, z), (2, w, y)],
        [(2, x, y), (2, w, z)], [(1, w, w), (-1, x, x), (1, y, y), (-1, z, z)], [(2, y, z), (-2, w, x)],
        [(2, x, z), (-2, w, y)], [(2, y, z), (2, w, x)], [(1, w, w), (-1, x, x), (-1, y, y), (1, z, z)],
    ]  # fmt: skip
    matrix = np.zeros((16, 9))
    for entry, products in enumerate(terms):
        for factor, a, b in products:
            matrix[4 * a + b, entry] += factor
    return matrix


def quaternions(graph: OnnxGraph, poses: str, joints: Sequence[int]) -> str:
    """Unit quaternions (4, n + 1, N), w first, of ``joints`` in poses (N, 55, 3); the last one is the identity.

    Half the angle is sqrt(|a|^2 / 4 + 1e-12): both cos(t/2) and sin(t/2)/t are smooth in t^2, so the shift costs
    nothing in float32 and spares a branch at zero. One product with a matrix of halves picks, halves and transposes.
    """
    halves = np.zeros((3, len(joints) + 1, JOINT_COUNT, 3))
    for place, joint in enumerate(joints):
        halves[:, place, joint] = 0.5 * np.eye(3)
    flat = graph.node("Reshape", poses, [-1, 3 * JOINT_COUNT])
    angles = graph.node("Gemm", halves.reshape(-1, 3 * JOINT_COUNT), flat, transB=1)
    angles = graph.node("Reshape", angles, [3, len(joints) + 1, -1])
    square = graph.node("ReduceSumSquare", angles, [0], keepdims=1)
    half = graph.node("Sqrt", graph.node("Add", square, np.array(1e-12)))
    imaginary = graph.node("Mul", angles, graph.node("Div", graph.node("Sin", half), half))
    return graph.node("Concat", graph.node("Cos", half), imaginary, axis=0)


def local_transforms(graph: OnnxGraph, quaternion: str, joints: Sequence[int], rest: np.ndarray) -> str:
    """Turns (4, 4, n + 1, N) of each joint about its own rest position.

    Their products down the tree are the skinning transforms themselves: no correction by the rest pose is left.
    Entries are linear in the quaternion's products and in (1, c), c the rest position: [R, c - R c; 0, 1].
    """
    centre = np.concatenate([rest[list(joints)], np.zeros((1, 3))]).T
    rotation = rotation_from_quaternion().T.reshape(3, 3, 16)
    linear = np.zeros((4, 4, 4, 16))
    linear[0, :3, :3] = rotation
    linear[1:, :3, 3] = -rotation.swapaxes(0, 1)
    constant = np.zeros((4, 4, centre.shape[1]))
    constant[:3, 3], constant[3, 3] = centre, 1

    left, right = (graph.node("Unsqueeze", quaternion, [axis]) for axis in (1, 0))
    products = graph.node("Reshape", graph.node("Mul", left, right), [16, -1])
    terms = graph.node("MatMul", linear.reshape(64, 16), products)
    terms = graph.node("Reshape", terms, [4, 4, 4, centre.shape[1], -1])
    factors = np.concatenate([np.ones_like(centre[:1]), centre])
    entries = graph.node("ReduceSum", graph.node("Mul", terms, factors[:, None, None, :, None]), [0], keepdims=0)
    return graph.node("Add", entries, constant[..., None])


def skinning_transforms(
    graph: OnnxGraph, local: str, joints: Sequence[int], parents: Sequence[int], wanted: Sequence[int]
) -> str:
    """Rest-to-posed transforms (4, 4, len(wanted), N) from local ones (4, 4, n + 1, N), without ``transl``.

    Pointer doubling: every round multiplies each joint's product by that of the joint where it ends and doubles the
    distance reached, so ceil(log2(depth)) batched products do the whole tree.
    """
    place = {joint: i for i, joint in enumerate(joints)}
    nothing = len(joints)
    above = np.array([place.get(int(parents[j]), nothing) for j in joints] + [nothing])
    current, needed = local, [place[j] for j in wanted]
    while True:
        last = (above[above] == nothing).all()
        rows = needed if last else list(range(nothing + 1))
        ends = graph.node("Gather", current, above[rows], axis=2)
        own = graph.node("Gather", current, rows, axis=2) if last else current
        left, right = graph.node("Unsqueeze", ends, [2]), graph.node("Unsqueeze", own, [0])
        current = graph.node("ReduceSum", graph.node("Mul", left, right), [1], keepdims=0)
        if last:
            return current
        above = above[above]
