"""Which joints of a pose can be believed: a body does not turn faster than bodies do."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conditioning.quaternions import between
from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES

NOISE: Final = np.radians(22.0)
"""Error of a pose estimate that is not yet strange [rad]: four standard deviations of 6 degrees in each joint."""
TRUNK_RATE: Final = 5.0
"""How much faster or slower than expected the trunk may turn [rad/s]."""
LIMB_RATE: Final = 12.0
"""The same of arms, legs and neck."""
END_RATE: Final = 30.0
"""The same of hands, feet and face, which estimators see worst and clothes feel least."""
PATH_NOISE: Final = 0.15
"""Error of a translation that is not yet strange [m]."""
PATH_RATE: Final = 4.0
"""How much faster or slower than expected the root may move [m/s]."""
MOST_STRANGE: Final = 5
"""Body joints that may be strange at once; with more, the whole pose is."""
TRUNK: Final = ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
LIMBS: Final = ("neck", "head", "hip", "knee", "shoulder", "elbow")
RATES: Final = np.array(
    [TRUNK_RATE if n in TRUNK else LIMB_RATE if n.rpartition("_")[2] in LIMBS else END_RATE for n in JOINT_NAMES]
)


def strange_joints(expected: np.ndarray, seen: np.ndarray, since: np.ndarray) -> np.ndarray:
    """Which joints (55,) are not where they can be, of quaternions (55, 4) expected and seen.

    since: (55,) how long ago each was last seen [s]; the longer, the more is believed, so that whatever lasts is
    believed in the end.
    """
    turn = between(expected, seen)
    return np.sqrt(np.einsum("ji,ji->j", turn, turn)) > NOISE + RATES * since


def is_path_strange(expected: np.ndarray, seen: np.ndarray, since: float) -> bool:
    """Whether the root (3,) [m] is where it cannot be."""
    return bool(np.linalg.norm(seen - expected) > PATH_NOISE + PATH_RATE * since)


def is_pose_strange(strange: np.ndarray) -> bool:
    """Whether so many joints, or the root, are strange that nothing of the pose should be used."""
    return bool(strange[0]) or int(strange[:BODY_JOINT_COUNT].sum()) > MOST_STRANGE


def names(joints: np.ndarray) -> str:
    """Up to four names of the joints chosen by (55,), in words."""
    found = [JOINT_NAMES[j] for j in np.flatnonzero(joints)]
    more = f" and {len(found) - 4} more" if len(found) > 4 else ""
    return ", ".join(found[:4]) + more
