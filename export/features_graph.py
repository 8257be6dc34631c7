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
ONE_MORE = np.eye(MOTION_STATE)[15]
"""Added to the motion's state: one more frame was seen."""
MOST_SEEN = np.where(ONE_MORE > 0, 2.0, np.finfo(np.float32).max)
"""Two frames are all that matters."""


def pose_features(
    graph: OnnxGraph,
    network: GarmentNetwork,
    local: str,
    joints: list[int],
    *,
    transl: str,
    motion: str,
    streams: str,
) -> tuple[str, str]:
    """Features (T, B, D) and the motion's states (1, B, 16), as :func:`caphy.network.features.pose_features` has them.

    The one difference: columns of gravity hold up, minus gravity; the GRU's weights turn the sign back.
    ``local`` (4, 4, n + 1, T B) are the transforms of ``joints``, whose first is the root; ``transl`` is (T B, 3), all
    streams' first frames before their second ones; ``motion`` (1, B, 16) the states before the first frame; ``streams``
    is B, of shape (1,).
    """
    flat = graph.node("Transpose", local, perm=[3, 2, 0, 1])
    flat = _by_stream(graph, flat, streams, (len(joints) + 1) * 16)
    shape = np.concatenate([16 * joints.index(j) + SIXD_ENTRIES for j in network.driving] + [UP_ENTRIES])
    root = graph.node("Gather", flat, ROTATION_ENTRIES, axis=2)
    transl = _by_stream(graph, transl, streams, 3)

    turned, velocity, gained, seen = _motion(graph, network.fps, transl, root, motion)
    vectors = graph.node("Concat", velocity, gained, turned, axis=2)
    products = graph.node("Mul", graph.node("Unsqueeze", root, [3]), graph.node("Unsqueeze", vectors, [2]))
    products = graph.node("Reshape", products, [0, 0, 9 * 15])
    moving = graph.node("MatMul", products, _scaled_motion(network.fps))
    moving = graph.node("Clip", moving, np.array(-LIMIT), np.array(LIMIT))
    features = graph.node("Concat", graph.node("Gather", flat, shape, axis=2), moving, axis=2)

    after = graph.node("Concat", transl, velocity, root, seen, axis=2)
    after = graph.node("Slice", after, [-1], [END], [0])
    return features, graph.node("Min", graph.node("Add", after, ONE_MORE), MOST_SEEN)


def _by_stream(graph: OnnxGraph, rows: str, streams: str, columns: int) -> str:
    """Rows (T B, ...) as (T, B, columns)."""
    return graph.node("Reshape", rows, graph.node("Concat", [-1], streams, [columns], axis=0))


def _motion(graph: OnnxGraph, fps: float, transl: str, root: str, motion: str) -> tuple[str, str, str, str]:
    """Root rotation one frame ago (T, B, 9), velocity (T, B, 3) [m/s], its gain in a frame, frames seen (T, B, 1)."""
    last_transl, last_velocity, last_root, count = graph.nodes("Split", motion, [3, 3, 9, 1], outputs=4, axis=2)
    known = graph.node("Clip", count, np.array(0.0), np.array(1.0))
    placed = graph.node("Concat", transl, root, axis=2)
    first = graph.node("Slice", placed, [0], [1], [0])
    remembered = graph.node("Concat", last_transl, last_root, axis=2)
    start = graph.node("Add", first, graph.node("Mul", known, graph.node("Sub", remembered, first)))
    transl_before, turned = graph.nodes("Split", _one_frame_later(graph, start, placed), [3, 9], outputs=2, axis=2)
    velocity = graph.node("Mul", graph.node("Sub", transl, transl_before), np.array(fps))

    frames = graph.node("Squeeze", graph.node("Shape", transl, start=0, end=1), [0])
    frame = graph.node("Cast", graph.node("Range", np.array(0), frames, np.array(1)), to=1)
    seen = graph.node("Add", graph.node("Unsqueeze", frame, [1, 2]), count)
    settled = graph.node("Sub", seen, np.array(1.0))
    settled = graph.node("Clip", settled, np.array(0.0), np.array(1.0))
    gained = graph.node("Sub", velocity, _one_frame_later(graph, last_velocity, velocity))
    return turned, velocity, graph.node("Mul", gained, settled), seen


def _one_frame_later(graph: OnnxGraph, first: str, values: str) -> str:
    """``first`` (1, B, C) and all frames but the last of ``values`` (T, B, C)."""
    return graph.node("Slice", graph.node("Concat", first, values, axis=0), [0], [-1], [0])


def _scaled_motion(fps: float) -> np.ndarray:
    """Matrix (135, 9) of products R_ki x_m, R the root's rotation and x = [velocity, its gain in a frame, previous
    R], to velocity, acceleration and angular velocity in the root's frame and scaled: R^T of the first two, and the
    antisymmetric part of R_before^T R."""
    matrix = np.zeros((3, 3, 15, 9))  # k, i, m, feature
    for k in range(3):
        for i in range(3):
            matrix[k, i, k, i] = 1 / VELOCITY_UNIT
            matrix[k, i, 3 + k, 3 + i] = fps / ACCELERATION_UNIT
            after, following = (i + 1) % 3, (i + 2) % 3
            matrix[k, after, 6 + 3 * k + following, 6 + i] = 0.5 * fps / ANGULAR_UNIT
            matrix[k, following, 6 + 3 * k + after, 6 + i] = -0.5 * fps / ANGULAR_UNIT
    return matrix.reshape(9 * 15, 9)
