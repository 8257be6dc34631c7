"""Whole motions through the same conditioner, pose by pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.conditioning.conditioner import BRIDGE, Conditioner
from caphy.conditioning.frame import Frame
from caphy.conditioning.world import MEMORY
from caphy.errors import CaphyError
from caphy.io.poses.camera import OPENCV_TO_Y_UP
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


def condition_upright(
    conditioner: Conditioner,
    times: np.ndarray,
    poses: np.ndarray,
    transl: np.ndarray,
    confidence: np.ndarray | None = None,
) -> list[Frame]:
    """:func:`condition` of a motion that is whole: what its first :data:`~caphy.conditioning.world.MEMORY` seconds tell
    of up in a camera's axes holds from its beginning, where a stream begins with a level camera and turns the world as
    it learns."""
    settings = conditioner.settings
    if settings.frame == "camera" and settings.up is None and len(times):
        few = np.asarray(times) <= np.asarray(times)[0] + MEMORY
        looking = Conditioner(settings, conditioner.body)
        condition(looking, times[few], poses[few], transl[few], None if confidence is None else confidence[few])
        conditioner.know_world(looking)
    return condition(conditioner, times, poses, transl, confidence)


def as_seen(sequence: PoseSequence) -> PoseSequence:
    """The motion in the axes that conditioning takes: y up, or of ``frame`` "camera" the camera's own.

    Readers turn a camera's view as if the camera were level, see :mod:`caphy.io.poses.camera`.
    """
    sequence = sequence.to_y_up()
    return sequence.turned(OPENCV_TO_Y_UP.T) if sequence.frame == "camera" else sequence


def condition_sequence(sequence: PoseSequence, conditioner: Conditioner) -> PoseSequence:
    """The motion, conditioned; in a world with y up. ``conditioner.settings.frame`` must be that of the sequence.

    Raises :class:`CaphyError` where it is not, or where no frame comes out.
    """
    wanted = conditioner.settings.frame
    if wanted != sequence.frame:
        raise CaphyError(f"{sequence.source}: is in {sequence.frame} axes, conditioning was set up for {wanted}")
    pelvis = conditioner.body.joints[0]
    seen, notes = as_seen(sequence).about(pelvis), sequence.notes
    if len(seen) > 1 and seen.fps * BRIDGE <= 1 + 1e-9:  # a stream could not know what comes after; a file does
        notes = (*notes, f"conditioning: {seen.fps:g} poses a second are few; between them joints turn evenly")
        seen = seen.resample(conditioner.settings.fps)
    sure = None if seen.unseen is None else 1.0 - seen.unseen  # what was filled in, nobody saw
    frames = condition_upright(conditioner, np.arange(len(seen)) / seen.fps, seen.poses, seen.transl, sure)
    if not frames:
        raise CaphyError(f"{sequence.source}: nobody was seen in it, so there is no motion")
    told = tuple(dict.fromkeys(note for frame in frames for note in frame.notes))
    more = (f"and {len(told) - 10} more such notes",) if len(told) > 10 else ()
    said = tuple(f"conditioning: {note}" for note in (*told[:10], *more))
    return replace(
        sequence,
        poses=np.stack([frame.poses for frame in frames]),
        transl=np.stack([frame.transl for frame in frames]),
        fps=conditioner.settings.fps,
        up_axis="y",
        frame="world",
        pelvis=pelvis,
        notes=(*notes, *said),
        unseen=None,
    )
