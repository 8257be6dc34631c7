"""Motions to train on: clips at the network's frame rate, mirrored, faster and slower, with all that poses fix."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from torch import Tensor

from caphy.body.kinematics import joint_transforms
from caphy.body.model import BodyModel
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.poses.parts import part
from caphy.network.features import pose_features, rest_state
from caphy.rotations import matrix_from_axis_angle

SPEEDS: Final = (0.8, 1.0, 1.25)
"""Each training clip is played at these speeds, as it is and mirrored."""

POSE_SUFFIXES: Final = (".npz", ".bvh", ".amc", ".pt", ".pkl", ".npy")
RATELESS: Final = ".amc"
_CONVERT: Final = (
    "AMC files do not say their frame rate; to use one, write it as npz with 'caphy poses convert FILE --fps RATE "
    "-o FOLDER' (CMU recorded at 120)"
)

_MIRROR: Final = [
    JOINT_NAMES.index(name.replace("left", "\0").replace("right", "left").replace("\0", "right"))
    for name in JOINT_NAMES
]


def find_poses(paths: Iterable[Path], say: Callable[[str], None] = print) -> list[PoseSequence]:
    """The motions in pose files and, sorted by name, in folders of them (searched to any depth).

    AMC files do not say their frame rate, and AMASS has files of shapes among its motions: in folders they are passed
    over, and ``say`` is told which.

    Raises
        CaphyError: if a path does not exist, a folder holds no pose file, a file cannot be read, or its poses are in a
            camera's frame.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(p for p in path.rglob("*") if p.suffix.lower() in POSE_SUFFIXES) if path.is_dir() else [path]
        rateless = [p for p in inside if p.suffix.lower() == RATELESS]
        still = [p for p in inside if path.is_dir() and _is_without_poses(p)]
        inside = [p for p in inside if p not in rateless and p not in still]
        if still:
            say(f"note: passed over {len(still)} files without poses in {path} ({still[0].name})")
        if rateless and inside:
            say(f"note: passed over {', '.join(p.name for p in rateless)} in {path}: {_CONVERT}")
        elif rateless:
            raise CaphyError(f"{path}: {_CONVERT}")
        elif not inside:
            raise CaphyError(f"{path}: holds no pose file ({', '.join(POSE_SUFFIXES)})")
        files += inside
    clips = (replace(read_poses(file), source=str(file)).require_world() for file in files)
    return [each for clip in clips for each in continuous_parts(clip)]


def _is_without_poses(path: Path) -> bool:
    """Whether no array of an archive has a name like one of rotations; what cannot be opened is not that."""
    try:
        with ZipFile(path) as archive:
            return not any(re.search("pose|orient|rot|theta|smpl", name, re.IGNORECASE) for name in archive.namelist())
    except (OSError, BadZipFile):
        return False


def continuous_parts(sequence: PoseSequence, least: float = 0.5) -> list[PoseSequence]:
    """The stretches between steps too fast for a body (tracking errors), those of at least ``least`` seconds."""
    cuts = [0, *sorted({jump.frame for jump in sequence.jumps()}), len(sequence)]
    if len(cuts) == 2:
        return [sequence]
    return [part(sequence, a, b) for a, b in pairwise(cuts) if b - a >= least * sequence.fps]


def mirrored(sequence: PoseSequence) -> PoseSequence:
    """The motion with left and right exchanged, reflected in the plane x = 0 of the world."""
    flip = np.array([-1.0, 1.0, 1.0])
    pelvis = np.asarray(sequence.pelvis)
    return replace(
        sequence,
        poses=sequence.poses[:, _MIRROR] * -flip,  # an axis is a pseudovector: (x, -y, -z)
        transl=(sequence.transl + pelvis) * flip - pelvis,
    )


def varied(sequence: PoseSequence, fps: float, speeds: Sequence[float] = SPEEDS) -> list[PoseSequence]:
    """The motion and its mirror image at several speeds, each resampled to ``fps`` [Hz]."""
    both = (sequence, mirrored(sequence))
    return [replace(one, fps=one.fps * speed).resample(fps) for one in both for speed in speeds]


@dataclass(frozen=True)
class Motions:
    """Clips laid end to end: N frames in all.

    Attributes:
        poses, transl: axis-angle [rad] and translation [m], (N, 55, 3) and (N, 3) float64.
        features: what the network sees in mid-motion, (N, D) float32.
        transforms: skinning transforms with the translation added, (N, 55, 3, 4) float32.
        starts: first frame of each clip and the end of the last, (clips + 1,).
        names: source of each clip.
    """

    poses: np.ndarray
    transl: np.ndarray
    features: Tensor
    transforms: Tensor
    starts: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def of(
        cls, clips: Sequence[PoseSequence], body: BodyModel, driving: Sequence[int], fps: float, betas=None
    ) -> Motions:
        """Clips, already at ``fps`` [Hz], as seen by a network of driving joints on a body of shape ``betas``."""
        joints = body.rest(betas)[1]
        clips = [clip.to_y_up(joints[0]) for clip in clips]
        features, transforms = [], []
        for clip in clips:
            if clip.fps != fps:
                raise ValueError(f"clips must run at {fps} Hz, got {clip.fps} Hz: {clip.source}")
            rotations = matrix_from_axis_angle(clip.poses)
            skeleton = joint_transforms(rotations, joints, body.parents)
            skeleton[..., 3] += clip.transl[:, None]
            transl = torch.tensor(clip.transl)
            seen, _ = pose_features(torch.from_numpy(rotations), transl, rest_state(transl), driving, fps)
            features.append(seen.float())
            transforms.append(torch.from_numpy(skeleton).float())
        return cls(
            np.concatenate([clip.poses for clip in clips]),
            np.concatenate([clip.transl for clip in clips]),
            torch.cat(features),
            torch.cat(transforms),
            np.concatenate([[0], np.cumsum([len(clip) for clip in clips])]),
            tuple(clip.source for clip in clips),
        )

    def times(self, frames: np.ndarray, fps: float) -> np.ndarray:
        """Time [s] of each of ``frames`` since its clip began."""
        clip = np.searchsorted(self.starts, frames, side="right") - 1
        return (frames - self.starts[clip]) / fps

    def __len__(self) -> int:
        return len(self.poses)
