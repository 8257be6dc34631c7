"""The network's pose features as ONNX nodes."""

from __future__ import annotations

import numpy as np

from caphy.network.features import ACCELERATION_UNIT, ANGULAR_UNIT, LIMIT, MOTION_STATE, VELOCITY_UNIT
from caphy.network.garment_network import GarmentNetwork
from export.onnx_graph import OnnxGraph

ROTATION_ENTRIES = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10])
"""Places of a rotation's nine entries in a row-major 4x4 matrix."""
SIXD_ENTRIES = np.array([0, 4, 8, 1, 5, 9])
"""Places of its first two columns."""
UP_ENTRIES = np.array([4, 5, 6])
"""Places of its second row: the world's up in the rotated frame."""
END = np.iinfo(np.int64).max


def pose_features(
    graph: OnnxGraph, network: GarmentNetwork, local: str, joints: list[int], *, transl: str, state: str
) -> tuple[str, str]:
    """Features (T, D) and the motion's state (16,), as :func:`caphy.network.features.pose_features` orders them.

    The one difference: columns of gravity hold up, minus gravity; the GRU's weights turn the sign back.
    ``local`` (T, n + 1, 16) are the transforms of ``joints``, whose first is the root.
    """
    flat = graph.node("Reshape", local, [0, (len(joints) + 1) * 16])
    shape = np.concatenate([16 * joints.index(j) + SIXD_ENTRIES for j in network.driving] + [UP_ENTRIES])
    root = graph.node("Gather", flat, ROTATION_ENTRIES, axis=1)
    motion = graph.node("Slice", state, [network.hidden_size], [network.state_size], [0])
    motion = graph.node("Reshape", motion, [1, MOTION_STATE])

    turned, velocity, acceleration, seen = _motion(graph, network.fps, transl, root, motion)
    columns = [graph.node("Unsqueeze", vector, [2]) for vector in (velocity, acceleration)]
    columns = graph.node("Concat", *columns, graph.node("Reshape", turned, [-1, 3, 3]), axis=2)
    inverse = graph.node("Transpose", graph.node("Reshape", root, [-1, 3, 3]), perm=[0, 2, 1])
    in_root = graph.node("Reshape", graph.node("MatMul", inverse, columns), [-1, 15])
    moving = graph.node("MatMul", in_root, _scaled_motion(network.fps))
    moving = graph.node("Clip", moving, np.array(-LIMIT), np.array(LIMIT))
    features = graph.node("Concat", graph.node("Gather", flat, shape, axis=1), moving, axis=1)

    last = [graph.node("Slice", value, [-1], [END], [0]) for value in (transl, velocity, root, seen)]
    last[3] = graph.node("Clip", graph.node("Add", last[3], np.array(1.0)), np.array(0.0), np.array(2.0))
    after = graph.node("Concat", *last, axis=1)
    return features, graph.node("Reshape", after, [MOTION_STATE])


def _motion(graph: OnnxGraph, fps: float, transl: str, root: str, motion: str) -> tuple[str, str, str, str]:
    """Root rotation one frame ago (T, 9), velocity (T, 3) [m/s], acceleration (T, 3) [m/s^2], frames seen (T, 1)."""
    count = graph.node("Gather", motion, [15], axis=1)
    known = graph.node("Clip", count, np.array(0.0), np.array(1.0))
    placed = graph.node("Concat", transl, root, axis=1)
    first = graph.node("Slice", placed, [0], [1], [0])
    remembered = graph.node("Gather", motion, [0, 1, 2, *range(6, 15)], axis=1)
    start = graph.node("Add", first, graph.node("Mul", known, graph.node("Sub", remembered, first)))
    before = _one_frame_later(graph, start, placed)
    step = graph.node("Sub", transl, graph.node("Slice", before, [0], [3], [1]))
    velocity = graph.node("Mul", step, np.array(fps))

    length = graph.node("Squeeze", graph.node("Shape", transl, start=0, end=1), [0])
    frame = graph.node("Range", np.array(0), length, np.array(1))
    seen = graph.node("Add", graph.node("Unsqueeze", graph.node("Cast", frame, to=1), [1]), count)
    settled = graph.node("Sub", seen, np.array(1.0))
    settled = graph.node("Clip", settled, np.array(0.0), np.array(1.0))
    velocity_before = _one_frame_later(graph, graph.node("Slice", motion, [3], [6], [1]), velocity)
    gained = graph.node("Sub", velocity, velocity_before)
    acceleration = graph.node("Mul", gained, graph.node("Mul", settled, np.array(fps)))
    return graph.node("Slice", before, [3], [12], [1]), velocity, acceleration, seen


def _one_frame_later(graph: OnnxGraph, first: str, values: str) -> str:
    """``first`` (1, C) and all but the last of ``values`` (T, C)."""
    return graph.node("Slice", graph.node("Concat", first, values, axis=0), [0], [-1], [0])


def _scaled_motion(fps: float) -> np.ndarray:
    """Matrix (15, 9) from R^T [velocity, acceleration, previous R] (row-major) to scaled velocity, acceleration and
    angular velocity: the antisymmetric part of R_before^T R."""
    matrix = np.zeros((15, 9))
    for axis in range(3):
        matrix[5 * axis, axis] = 1 / VELOCITY_UNIT
        matrix[5 * axis + 1, 3 + axis] = 1 / ACCELERATION_UNIT
        after, following = (axis + 1) % 3, (axis + 2) % 3
        matrix[5 * after + 2 + following, 6 + axis] = 0.5 * fps / ANGULAR_UNIT
        matrix[5 * following + 2 + after, 6 + axis] = -0.5 * fps / ANGULAR_UNIT
    return matrix
