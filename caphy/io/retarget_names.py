"""Joint names of the CMU skeleton in the three spellings it is published in."""

from __future__ import annotations

from typing import Final

from caphy.errors import CaphyError
from caphy.io.poses.skeleton import SkeletonMotion

_ASF = (
    *("root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"),
    *("lfemur", "ltibia", "lfoot", "ltoes", "rfemur", "rtibia", "rfoot", "rtoes"),
    *("lclavicle", "lhumerus", "lradius", "lwrist", "lhand", "rclavicle", "rhumerus", "rradius", "rwrist", "rhand"),
)
_CGSPEED = (
    *("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"),
    *("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "LeftFingerBase"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand", "RightFingerBase"),
)
_3DSMAX = (
    *("Hips", "lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head"),
    *("LeftHip", "LeftKnee", "LeftAnkle", "LeftToe", "RightHip", "RightKnee", "RightAnkle", "RightToe"),
    *("LeftCollar", "LeftShoulder", "LeftElbow", "LeftWrist", "lhand"),
    *("RightCollar", "RightShoulder", "RightElbow", "RightWrist", "rhand"),
)
SPELLINGS: Final = {"ASF/AMC": _ASF, "cgspeed BVH": _CGSPEED, "3dsMax-friendly BVH": _3DSMAX}
"""Names of the same 25 joints; those of the ASF are the bones that start at each joint."""


def cmu_joints(motion: SkeletonMotion) -> dict[str, int]:
    """Index in ``motion`` of every CMU joint, by its ASF name; raises :class:`CaphyError` for other skeletons."""
    present = {name: index for index, name in enumerate(motion.names)}
    missing = {spelling: [n for n in names if n not in present] for spelling, names in SPELLINGS.items()}
    best = min(missing, key=lambda spelling: len(missing[spelling]))
    if missing[best]:
        raise CaphyError(
            f"{motion.source}: the joint layout is not the CMU skeleton's; nearest is {best}, which also has "
            f"{', '.join(missing[best][:6])}; got {', '.join(motion.names[:8])}... "
            "Convert the motion to SMPL-X parameters, or rename its joints"
        )
    return {asf: present[name] for asf, name in zip(_ASF, SPELLINGS[best], strict=True)}
