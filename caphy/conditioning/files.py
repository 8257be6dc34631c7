"""Whole motions through the same conditioner, pose by pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.conditioning.conditioner import Conditioner
from caphy.conditioning.frame import Frame
from caphy.errors import CaphyError
from caphy.io.poses.sequence import PoseSequence


def condition(
    conditioner: Conditioner,
    times: np.ndarray,
    poses: np.ndarray,
    transl: np.ndarray,
    confidence: np.ndarray | None = None,
) -> list[Frame]:
    """All frames of poses (T, 55, 3) and transl (T, 3) seen at ``times`` (T,) [s], pushed one after another.

    confidence: (T,) or (T, 55), as :meth:`Conditioner.push` takes it; 0 throughout is a frame without anybody.
    """
    if not len(times) == len(poses) == len(transl) or (confidence is not None and len(confidence) != len(times)):
        raise CaphyError(f"there must be a time, a pose and a translation each, got {len(times)} and {len(poses)}")
    frames = []
    for i, time in enumerate(times):
        frames += conditioner.push(time, poses[i], transl[i], None if confidence is None else confidence[i])
    return frames + conditioner.flush()


def as_sequence(frames: list[Frame], like: PoseSequence, fps: float) -> PoseSequence:
    """The frames as a motion in the world, with what was done among its notes."""
    if not frames:
        raise CaphyError(f"{like.source}: nobody was seen in it, so there is no motion")
    notes = tuple(dict.fromkeys(note for frame in frames for note in frame.notes))
    return replace(
        like,
        poses=np.stack([frame.poses for frame in frames]),
        transl=np.stack([frame.transl for frame in frames]),
        fps=fps,
        frame="world",
        notes=(*like.notes, *notes[:20]),
    )
