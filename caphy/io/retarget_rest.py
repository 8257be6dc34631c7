"""The body that motions are retargeted to when none is named."""

from __future__ import annotations

from functools import cache

import numpy as np

from caphy.errors import CaphyError
from caphy.io.retarget import RestBody

_GENERIC = {
    "pelvis": (0, 0.93, 0),
    "left_hip": (0.09, 0.86, 0),
    "spine1": (0, 1.03, -0.01),
    "left_knee": (0.1, 0.48, 0),
    "spine2": (0, 1.16, -0.01),
    "left_ankle": (0.1, 0.08, -0.02),
    "spine3": (0, 1.22, 0),
    "left_foot": (0.11, 0.02, 0.1),
    "neck": (0, 1.43, -0.03),
    "left_collar": (0.05, 1.34, -0.02),
    "head": (0, 1.53, 0.0),
    "left_shoulder": (0.17, 1.38, -0.02),
    "left_elbow": (0.43, 1.38, -0.03),
    "left_wrist": (0.68, 1.38, -0.03),
}


@cache
def default_rest() -> RestBody:
    """Rest joints and soles of the bundled body."""
    from caphy.conventions import JOINT_NAMES, JOINT_PARENTS

    try:
        from caphy.body.bundled import default_body

        body = default_body()
        return RestBody(np.asarray(body.joints), float(body.v_template[:, 1].min()))
    except (ImportError, OSError, CaphyError):
        joints = np.zeros((55, 3))
        for i, name in enumerate(JOINT_NAMES):
            mirror = -1 if name.startswith("right") else 1
            at = _GENERIC.get(name.replace("right", "left"))
            joints[i] = joints[JOINT_PARENTS[i]] if at is None else np.array(at) * [mirror, 1, 1]
        return RestBody(joints, 0.0)
