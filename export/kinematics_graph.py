"""Axis-angle poses to skinning transforms as ONNX nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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


def rotation_products(graph: OnnxGraph, poses: str, joints: Sequence[int]) -> str:
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


def local_transforms(graph: OnnxGraph, products: str, joints: Sequence[int], rest: np.ndarray) -> str:
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


def skinning_transforms(
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
