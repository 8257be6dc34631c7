"""What conditioning knows of the avatar's body: where its feet and its chest are in a pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from caphy.conditioning.quaternions import product, turned
from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError

LEG: Final = ("hip", "knee", "ankle", "foot")
LEGS: Final = tuple(tuple(JOINT_NAMES.index(f"{side}_{name}") for name in LEG) for side in ("left", "right"))
SPINE: Final = tuple(JOINT_NAMES.index(name) for name in ("spine1", "spine2", "spine3"))
EVEN: Final = 0.01
"""Height over which points of the soles stand together [m]."""
STEP: Final = 0.05
"""Height over which one foot rather than the other is taken for the one stood on [m]."""


@dataclass(frozen=True, eq=False)
class Body:
    """A body at rest: joints (55, 3) [m] and the height of its soles [m], y up."""

    joints: np.ndarray
    sole: float

    def __post_init__(self) -> None:
        if np.shape(self.joints) != (JOINT_COUNT, 3) or not np.isfinite(self.joints).all():
            raise CaphyError(f"a body has {JOINT_COUNT} finite rest joints (x, y, z), got {np.shape(self.joints)}")
        object.__setattr__(self, "joints", np.array(self.joints, np.float64))

    def soles(self, turns: np.ndarray) -> np.ndarray:
        """Where both soles are (6, 3) [m], seen from the pelvis, in a pose of quaternions (55, 4); left foot first.

        A sole is the points under ankle and ball, which move with the ankle, and the toe's tip, which moves with the
        ball, as in :func:`caphy.io.poses.ground.sole_points`.
        """
        return np.concatenate([self._sole(turns, leg) for leg in LEGS])

    def _sole(self, turns: np.ndarray, leg: tuple[int, ...]) -> np.ndarray:
        hip, knee, ankle, ball = (self.joints[joint] for joint in leg)
        down, below = [0.0, self.sole - ankle[1], 0.0], [0.0, self.sole - ball[1], 0.0]
        tread = (ball - ankle) * [1.0, 0.0, 1.0] + down
        tip = (ball - ankle) * [0.5, 0.0, 0.5] + below
        at, world = hip - self.joints[0], turns[0]
        at = turned(world, at)
        for joint, reach in ((leg[0], knee - hip), (leg[1], ankle - knee)):
            world = product(world, turns[joint])
            at = at + turned(world, reach)
        world = product(world, turns[leg[2]])
        foot = product(world, turns[leg[3]])
        return at + np.stack(
            [turned(world, np.array(down)), turned(world, tread), turned(world, ball - ankle) + turned(foot, tip)]
        )

    def chest(self, turns: np.ndarray) -> np.ndarray:
        """Where the joint spine3 is (3,) [m], seen from the pelvis."""
        at, world, before = np.zeros(3), turns[0], self.joints[0]
        for joint in SPINE:
            at = at + turned(world, self.joints[joint] - before)
            world, before = product(world, turns[joint]), self.joints[joint]
        return at

    def upward(self, turns: np.ndarray) -> np.ndarray:
        """The direction (3,) from the foot that is stood on to the chest, unit: on average over a motion, up.

        Over CMU clips of 1.5 to 8 s its mean is within 2 degrees of up in the median, 3 degrees in nine of ten.
        """
        points = self.soles(turns).reshape(2, 3, 3).mean(axis=1)
        chest = self.chest(turns)
        left = 1 / (1 + np.exp(np.clip((points[0, 1] - points[1, 1]) / STEP, -50, 50)))
        direction = chest - left * points[0] - (1 - left) * points[1]
        return direction / max(float(np.linalg.norm(direction)), 1e-6)


@cache
def bundled_body() -> Body:
    """The body that comes with the package."""
    from caphy.io.retarget_rest import default_rest  # reads a file that who brings a body need not have

    rest = default_rest()
    return Body(rest.joints, rest.sole)


def standing_height(points: np.ndarray) -> float:
    """How high points of the soles (6, 3) stand together [m]: that of the lowest, without kinks in time."""
    lowest = points[:, 1].min()
    return float(lowest - EVEN * np.log(np.exp((lowest - points[:, 1]) / EVEN).sum()))
