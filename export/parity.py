"""Whether a graph computes what its network computes, on poses no body takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import onnxruntime
import torch

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.network.garment_network import GarmentNetwork

TOLERANCE = 1e-5
"""Largest distance of a vertex between graph and network [m]."""


@dataclass(frozen=True)
class Parity:
    """Largest distances of a vertex [m]: graph to network, and 60 frames at once to 60 one by one."""

    network: float
    streaming: float

    def metrics(self) -> dict[str, float]:
        """As an avatar's manifest states them."""
        return {
            "parity_with_torch_mm": round(1e3 * self.network, 5),
            "parity_frame_by_frame_mm": round(1e3 * self.streaming, 5),
        }


def random_poses(frames: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (frames, 55, 3) of any angle up to two turns, and a jumpy walk (frames, 3), as float32."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(frames, JOINT_COUNT, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    poses = axes * rng.uniform(0, 4 * np.pi, size=(frames, JOINT_COUNT, 1))
    return poses.astype(np.float32), np.cumsum(rng.normal(size=(frames, 3)) * 0.1, axis=0).astype(np.float32)


def extreme_poses() -> tuple[np.ndarray, np.ndarray]:
    """Rest, tiny angles, and half a turn of every joint about every axis, 8 m from the origin, as float32."""
    poses = np.zeros((2 + 3 * JOINT_COUNT, JOINT_COUNT, 3), np.float32)
    poses[1] = 1e-6
    for i, (joint, axis) in enumerate(np.ndindex(JOINT_COUNT, 3)):
        poses[2 + i, joint, axis] = np.pi
    transl = np.full((len(poses), 3), (8.0, 0.0, -8.0), np.float32)
    return poses, transl


def check_parity(model: bytes, network: GarmentNetwork) -> Parity:
    """Compare a graph with its network in float64 (double precision, so that only the graph's rounding shows).

    Raises CaphyError where a vertex is further than :data:`TOLERANCE` off, or anything is not finite.
    """
    session = single_thread_session(model)
    reference = network.double()
    worst = streaming = 0.0
    for poses, transl in (random_poses(60, 0), random_poses(60, 1), extreme_poses()):
        state = np.zeros(network.state_size, np.float32)
        vertices, after = _run(session, poses, transl, state)
        with torch.no_grad():
            expected, expected_after = reference(
                *(torch.tensor(a, dtype=torch.float64) for a in (poses, transl, state))
            )
        single = []
        for t in range(len(poses)):
            part, state = _run(session, poses[t : t + 1], transl[t : t + 1], state)
            single.append(part)
        worst = max(worst, _distance(vertices, expected.numpy()))
        streaming = max(streaming, _distance(np.concatenate(single), vertices))
        drift = max(np.abs(after - expected_after.numpy()).max(), np.abs(after - state).max())
        if not (worst <= TOLERANCE and streaming <= TOLERANCE and drift <= 1e-3):
            raise CaphyError(
                f"the ONNX graph must answer as the network does within {TOLERANCE * 1e3} mm; it is off by "
                f"{worst * 1e3:.4f} mm, by {streaming * 1e3:.4f} mm frame by frame, and by {drift:.2g} in its state; "
                "nothing was written"
            )
    return Parity(worst, streaming)


def single_thread_session(model: bytes) -> onnxruntime.InferenceSession:
    """A session on one thread that does not spin."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _run(
    session: onnxruntime.InferenceSession, poses: np.ndarray, transl: np.ndarray, state: np.ndarray
) -> list[np.ndarray]:
    return cast(list[np.ndarray], session.run(None, {"poses": poses, "transl": transl, "state": state}))


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    gap = float(np.linalg.norm(a - b, axis=-1).max())
    return gap if np.isfinite(gap) else np.inf
