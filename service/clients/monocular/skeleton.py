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
        return cls(joints[:BODY_JOINT_COUNT], parents, np.array(sites), carrier, above)

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
    """The joint that carries a landmark, and where it lies at rest."""
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
