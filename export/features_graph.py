"""The network's pose features as ONNX nodes."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class Rows:
    """How frames of several streams lie in one axis of N = T B rows: all streams' first frames, then their second ones.

    Tensors of the graph, integers of shape (1,): ``streams`` is B, ``frames`` T, ``count`` N.
    """

    streams: str
    frames: str
    count: str

    @classmethod
    def of(cls, graph: OnnxGraph, transl: str, states: str) -> Rows:
        """From transl (N, 3) and states (B, S)."""
        streams = graph.node("Shape", states, start=0, end=1)
        count = graph.node("Shape", transl, start=0, end=1)
        return cls(streams, graph.node("Div", count, streams), count)

    def from_last(self, graph: OnnxGraph) -> str:
        """-B, where the last frame of every stream starts."""
        return graph.node("Neg", self.streams)


def pose_features(
    graph: OnnxGraph, network: GarmentNetwork, local: str, joints: list[int], *, transl: str, states: str, rows: Rows
) -> tuple[str, str]:
    """Features (N, D) and the motion's states (B, 16), as :func:`caphy.network.features.pose_features` orders them.

    The one difference: columns of gravity hold up, minus gravity; the GRU's weights turn the sign back.
    ``local`` (16, n + 1, N) are the transforms of ``joints``, whose first is the root; ``states`` is (B, S).
    """
    flat = graph.node("Transpose", local, perm=[2, 1, 0])
    flat = graph.node("Reshape", flat, [-1, (len(joints) + 1) * 16])
    shape = np.concatenate([16 * joints.index(j) + SIXD_ENTRIES for j in network.driving] + [UP_ENTRIES])
    root = graph.node("Gather", flat, ROTATION_ENTRIES, axis=1)
    motion = graph.node("Slice", states, [network.hidden_size], [network.state_size], [1])

    turned, velocity, acceleration, seen = _motion(graph, network.fps, transl, root, motion, rows)
    columns = [graph.node("Unsqueeze", vector, [2]) for vector in (velocity, acceleration)]
    columns = graph.node("Concat", *columns, graph.node("Reshape", turned, [-1, 3, 3]), axis=2)
    inverse = graph.node("Transpose", graph.node("Reshape", root, [-1, 3, 3]), perm=[0, 2, 1])
    in_root = graph.node("Reshape", graph.node("MatMul", inverse, columns), [-1, 15])
    moving = graph.node("MatMul", in_root, _scaled_motion(network.fps))
    moving = graph.node("Clip", moving, np.array(-LIMIT), np.array(LIMIT))
    features = graph.node("Concat", graph.node("Gather", flat, shape, axis=1), moving, axis=1)

    after = graph.node("Concat", transl, velocity, root, seen, axis=1)
    after = graph.node("Slice", after, rows.from_last(graph), [END], [0])
    return features, graph.node("Min", graph.node("Add", after, ONE_MORE), MOST_SEEN)


def _motion(graph: OnnxGraph, fps: float, transl: str, root: str, motion: str, rows: Rows) -> tuple[str, str, str, str]:
    """Root rotation one frame ago (N, 9), velocity (N, 3) [m/s], acceleration (N, 3) [m/s^2], frames seen (N, 1)."""
    count = graph.node("Slice", motion, [15], [16], [1])
    known = graph.node("Clip", count, np.array(0.0), np.array(1.0))
    placed = graph.node("Concat", transl, root, axis=1)
    first = graph.node("Slice", placed, [0], rows.streams, [0])
    remembered = graph.node("Gather", motion, [0, 1, 2, *range(6, 15)], axis=1)
    start = graph.node("Add", first, graph.node("Mul", known, graph.node("Sub", remembered, first)))
    before = _one_frame_later(graph, start, placed, rows)
    step = graph.node("Sub", transl, graph.node("Slice", before, [0], [3], [1]))
    velocity = graph.node("Mul", step, np.array(fps))

    frame = graph.node("Range", np.array(0), graph.node("Squeeze", rows.frames, [0]), np.array(1))
    frame = graph.node("Unsqueeze", graph.node("Cast", frame, to=1), [1, 2])
    seen = graph.node("Reshape", graph.node("Add", frame, count), [-1, 1])
    settled = graph.node("Sub", seen, np.array(1.0))
    settled = graph.node("Clip", settled, np.array(0.0), np.array(1.0))
    velocity_before = _one_frame_later(graph, graph.node("Slice", motion, [3], [6], [1]), velocity, rows)
    gained = graph.node("Sub", velocity, velocity_before)
    acceleration = graph.node("Mul", gained, graph.node("Mul", settled, np.array(fps)))
    return graph.node("Slice", before, [3], [12], [1]), velocity, acceleration, seen


def _one_frame_later(graph: OnnxGraph, first: str, values: str, rows: Rows) -> str:
    """``first`` (B, C) and all frames but the last of ``values`` (N, C)."""
    return graph.node("Slice", graph.node("Concat", first, values, axis=0), [0], rows.count, [0])


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
