"""From pictures to poses of the avatar: landmarks, inverse kinematics, gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.rotations import axis_angle_from_matrix
from service.clients.monocular.gravity import Gravity
from service.clients.monocular.kinematics import Kinematics, Posture
from service.clients.monocular.landmarks import LANDMARKS, Detector, Landmarks
from service.clients.monocular.skeleton import Skeleton, centre_of_mass
from service.clients.monocular.video import Cuts, Picture

_PARTS = {
    "shoulder": ("shoulder", "elbow"),
    "elbow": ("elbow", "wrist"),
    "wrist": ("wrist", "index"),
    "hip": ("hip", "knee"),
    "knee": ("knee", "ankle"),
    "ankle": ("ankle", "foot_index"),
}
"""The landmarks without which a joint's turn is only guessed."""
_ANKLES = [JOINT_NAMES.index("left_ankle"), JOINT_NAMES.index("right_ankle")]
_FEET = [*_ANKLES, JOINT_NAMES.index("left_foot"), JOINT_NAMES.index("right_foot")]
_NECK = JOINT_NAMES.index("neck")
_MISFIT = 0.25
"""Landmarks that fit the body no better are of no body [m]."""
_JUMP = 0.8
"""Somebody who moves by more than so much of their own size between pictures is somebody else."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one picture says.

    time: [s]. poses: (55, 3) [rad] and transl: (3,) [m] in the world; none where nobody was seen. confidence: (55,) 0
    to 1. turn: (3, 3) from the camera's axes to the world's. origin: (3,) where the camera stands in the world [m].
    is_new: whether a scene or a person begins here.
    """

    time: float
    poses: np.ndarray | None
    transl: np.ndarray | None
    confidence: np.ndarray
    turn: np.ndarray
    origin: np.ndarray
    is_new: bool = False


class Estimator:
    """Follows one person through a video.

    joints: (55, 3) the avatar's rest joints [m]. focal: [pixels]. size: width and height of the pictures [pixels].
    """

    def __init__(self, joints: np.ndarray, detector: Detector, focal: float, size: tuple[int, int]) -> None:
        self._joints = np.asarray(joints, np.float64)
        self._kinematics = Kinematics(Skeleton.of(self._joints), focal, size)
        self._skeleton = Skeleton.of(self._joints)
        self._height = float(np.linalg.norm(self._joints[_NECK] - self._joints[_ANKLES].mean(axis=0)))
        self._detector, self.gravity = detector, Gravity(focal)
        self._cuts = Cuts()
        self._last: Landmarks | None = None
        self._time = 0.0
        self._turn, self._origin, self._root = np.eye(3), np.zeros(3), np.array([0.0, 0.0, 3.0])
        self.counts = {"pictures": 0, "nobody": 0, "cuts": 0, "jumps": 0, "no body": 0}

    def detect(self, picture: Picture) -> tuple[Landmarks | None, bool]:
        """The person in the picture, and whether a scene begins with it. The slow part; keeps its own state only."""
        is_cut = self._cuts.between(picture.pixels)
        return self._detector(picture.rgb), is_cut

    def estimate(self, picture: Picture, seen: Landmarks | None, is_cut: bool) -> Estimate:
        """The pose of what :meth:`detect` saw."""
        self.counts["pictures"] += 1
        self.counts["cuts"] += is_cut
        jumped = not is_cut and self._is_other(seen)
        self.counts["jumps"] += jumped
        if is_cut:
            self.gravity.forget()
        if is_cut or jumped:
            self._kinematics.forget()
        step, self._time = float(np.clip(picture.time - self._time, 1e-3, 1.0)), picture.time
        self._last = seen if seen is not None else self._last
        posture = None if seen is None else self._kinematics.fit(seen, step)
        if seen is None or posture is None or posture.misfit > _MISFIT:
            self.counts["nobody" if seen is None else "no body"] += 1
            self.gravity.see(picture.time, picture.pixels, None)
            self._turn_world()
            return self._estimate(picture.time, None, np.zeros(JOINT_COUNT), is_cut or jumped)
        self._root = posture.root
        self.gravity.see(picture.time, picture.pixels, *self._uprightness(posture, seen))
        self._turn_world()
        return self._estimate(picture.time, posture, confidence(seen), is_cut or jumped)

    def _turn_world(self) -> None:
        """Take over what is known of up by now; the world turns about the person, who therefore does not jump."""
        turn = self.gravity.turn
        self._origin = self._origin + (self._turn - turn) @ self._root
        self._turn = turn

    def _estimate(self, time: float, posture: Posture | None, trust: np.ndarray, is_new: bool) -> Estimate:
        if posture is None:
            return Estimate(time, None, None, trust, self._turn, self._origin, is_new)
        rotations = posture.rotations.copy()
        rotations[0] = self._turn @ rotations[0]
        poses = np.zeros((JOINT_COUNT, 3))
        poses[: len(rotations)] = axis_angle_from_matrix(rotations)
        transl = self._turn @ posture.root + self._origin - self._joints[0]
        return Estimate(time, poses, transl, trust, self._turn, self._origin, is_new)

    def _uprightness(self, posture: Posture, seen: Landmarks) -> tuple[np.ndarray, float]:
        """The way from the middle of the feet to the centre of mass (3,) in the camera, for nobody falls over; and how
        much it says about gravity: standing tall only."""
        _, joints, _ = self._skeleton.posed(posture.rotations, posture.root)
        tall = float(np.linalg.norm(joints[_NECK] - joints[_ANKLES].mean(axis=0)) / self._height)
        feet = seen.visibility[[LANDMARKS.index("left_ankle"), LANDMARKS.index("right_ankle")]].min()
        weight = float(np.clip((tall - 0.85) / 0.12, 0, 1)) * float(feet) + 1e-3
        return centre_of_mass(joints) - joints[_FEET].mean(axis=0), weight

    def _is_other(self, seen: Landmarks | None) -> bool:
        if seen is None or self._last is None:
            return False
        size = np.linalg.norm(np.ptp(self._last.pixels, axis=0))
        moved = np.linalg.norm(np.median(seen.pixels - self._last.pixels, axis=0))
        return bool(moved > _JUMP * size / 2)


def confidence(seen: Landmarks) -> np.ndarray:
    """How surely each joint's rotation (55,) is known, 0 to 1: by the visibility of the landmarks beyond it."""
    trust = np.full(JOINT_COUNT, float(seen.visibility[:25].mean()))
    for joint, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        if part in _PARTS:
            trust[joint] = min(seen.visibility[LANDMARKS.index(f"{side}_{end}")] for end in _PARTS[part])
    return trust.clip(0.1, 1)
