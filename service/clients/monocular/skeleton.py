"""The avatar's skeleton as a landmark detector sees it: where on the body each landmark lies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES, JOINT_PARENTS
from service.clients.monocular.landmarks import LANDMARKS

FACE: Final[dict[str, tuple[float, float, float]]] = {
    "nose": (0.0, -0.60, 0.75),
    "left_eye_inner": (0.25, 0.0, 0.20),
    "left_eye": (0.50, 0.0, 0.22),
    "left_eye_outer": (0.78, 0.0, 0.05),
    "left_ear": (1.20, -0.30, -1.55),
    "left_mouth": (0.42, -1.30, 0.22),
}
"""From the middle between the eyes' joints, in distances between them: left, up, ahead (an average adult's face)."""

FOOT: Final[dict[str, tuple[float, float, float]]] = {
    "left_heel": (0.0, -0.45, -0.25),
    "left_foot_index": (0.0, -0.45, 1.35),
}
"""From the ankle, in horizontal distances from it to the ball of the foot: left, up, ahead."""

SEEN: Final[dict[str, tuple[float, float, float]]] = {
    "nose": (0, 19, -20),
    "left_eye_inner": (0, 14, -12),
    "left_eye": (-4, 13, -18),
    "left_eye_outer": (-9, 12, -13),
    "left_ear": (-21, 7, 38),
    "left_mouth": (-6, 24, 0),
    "left_shoulder": (-1, 0, 3),
    "left_elbow": (-4, 22, 15),
    "left_wrist": (6, 5, 1),
    "left_pinky": (-16, -14, 30),
    "left_index": (-28, -13, -14),
    "left_thumb": (4, 10, -25),
    "left_hip": (-6, -58, 34),
    "left_knee": (-11, -33, -16),
    "left_ankle": (-9, 21, 34),
    "left_heel": (-12, 25, 30),
    "left_foot_index": (-17, 17, -20),
}
"""Where the detector sees each landmark of a body at rest, from where anatomy has it: left, up, ahead [mm].

Least squares over the films of the benchmark (benchmarks/monocular_landmarks.py). Without any one of its eight motions
no number changes by more than 5 mm.
"""

SEGMENTS: Final = (
    ("left_hip", "left_knee", 0.100, 0.433),
    ("left_knee", "left_ankle", 0.0465, 0.433),
    ("left_ankle", "left_foot", 0.0145, 0.5),
    ("left_shoulder", "left_elbow", 0.028, 0.436),
    ("left_elbow", "left_wrist", 0.022, 0.682),
    ("left_hip", "left_shoulder", 0.2485, 0.5),
    ("neck", "head", 0.0405, 1.0),
)
"""From joint to joint, share of the body's mass, and where on the way its centre lies; each twice, left and right
(Winter, "Biomechanics and Motor Control of Human Movement", 2009, table 4.1)."""

FINGERS: Final = {"pinky": "pinky1", "index": "index1", "thumb": "thumb2"}
"""The knuckle of the hand that each landmark of a hand is."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """What inverse kinematics needs of an avatar.

    joints: (22, 3) rest positions [m] of pelvis and body joints. parents: of each, -1 for the pelvis.
    sites: (33, 3) rest positions [m] of the landmarks. carrier: (33,) the joint that carries each.
    above: (33, 22) whether a joint moves a landmark.
    """

    joints: np.ndarray
    parents: tuple[int, ...]
    sites: np.ndarray
    carrier: np.ndarray
    above: np.ndarray

    @classmethod
    def of(cls, joints: np.ndarray) -> Skeleton:
        """The skeleton of an avatar with rest joints (55, 3) [m]."""
        joints = np.asarray(joints, np.float64)
        carriers, sites = zip(*(_site(name, joints) for name in LANDMARKS), strict=True)
        carrier = np.array([JOINT_NAMES.index(name) for name in carriers])
        parents = JOINT_PARENTS[:BODY_JOINT_COUNT]
        above = np.zeros((len(LANDMARKS), BODY_JOINT_COUNT), bool)
        for site, joint in enumerate(carrier):
            mover = int(joint)
            while mover >= 0:
                above[site, mover] = True
                mover = parents[mover]
        return cls(joints[:BODY_JOINT_COUNT], parents, np.array(sites) + seen_from_anatomy(), carrier, above)

    def posed(self, rotations: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World rotations (22, 3, 3), joints (22, 3) and landmarks (33, 3) [m] of local rotations (22, 3, 3).

        ``root`` (3,) is where the pelvis stands [m].
        """
        turned, placed = np.empty_like(rotations), np.empty((len(rotations), 3))
        turned[0], placed[0] = rotations[0], root
        bones = self.joints - self.joints[list(self.parents)]
        for joint in range(1, len(rotations)):
            parent = self.parents[joint]
            turned[joint] = turned[parent] @ rotations[joint]
            placed[joint] = placed[parent] + turned[parent] @ bones[joint]
        arms = (self.sites - self.joints[self.carrier])[..., None]
        return turned, placed, placed[self.carrier] + (turned[self.carrier] @ arms)[..., 0]


def _site(landmark: str, joints: np.ndarray) -> tuple[str, np.ndarray]:
    """The joint that carries a landmark, and where anatomy has it at rest."""
    side, _, part = landmark.partition("_")
    if part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
        return landmark, joints[JOINT_NAMES.index(landmark)]
    if part in FINGERS:
        return f"{side}_wrist", joints[JOINT_NAMES.index(f"{side}_{FINGERS[part]}")]
    mirrored = np.array([-1.0 if side == "right" else 1.0, 1.0, 1.0])
    left = landmark.replace("right_", "left_")
    if left in FOOT:
        ankle = joints[JOINT_NAMES.index(f"{side}_ankle")]
        length = joints[JOINT_NAMES.index(f"{side}_foot")][2] - ankle[2]
        return f"{side}_ankle", ankle + length * mirrored * FOOT[left]
    eyes = joints[[JOINT_NAMES.index("left_eye"), JOINT_NAMES.index("right_eye")]]
    return "head", eyes.mean(axis=0) + np.linalg.norm(eyes[0] - eyes[1]) * mirrored * FACE[left]


def seen_from_anatomy() -> np.ndarray:
    """:data:`SEEN` of all landmarks, (33, 3) [m]."""
    sides = [np.array([-1.0 if name.startswith("right") else 1.0, 1.0, 1.0]) for name in LANDMARKS]
    return 1e-3 * np.array(
        [side * SEEN[name.replace("right_", "left_")] for name, side in zip(LANDMARKS, sides, strict=True)]
    )


def centre_of_mass(joints: np.ndarray) -> np.ndarray:
    """Of a body (3,) [m] with joints (22, 3) [m]."""
    centre = np.zeros(3)
    for start, end, mass, share in SEGMENTS:
        for side in ("left", "right"):
            first, last = (joints[JOINT_NAMES.index(name.replace("left", side))] for name in (start, end))
            centre += mass * (first + share * (last - first))
    return centre
