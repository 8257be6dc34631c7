"""How far the joints of a moving body turn."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conventions import JOINT_NAMES

LEFT: Final[dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]]] = {
    "spine1": ((-14, 35), (-15, 15), (-10, 10)),
    "spine2": ((-9, 9), (-18, 18), (-12, 12)),
    "spine3": ((-14, 5), (-9, 9), (-14, 14)),
    "neck": ((-26, 18), (-39, 39), (-13, 13)),
    "head": ((-19, 44), (-29, 29), (-28, 28)),
    "left_hip": ((-99, 25), (-32, 27), (-24, 31)),
    "left_knee": ((-6, 132), (-5, 5), (-2, 8)),
    "left_ankle": ((-35, 41), (-46, 36), (-20, 20)),
    "left_foot": ((-42, 47), (-1, 1), (-1, 1)),
    "left_collar": ((-5, 5), (-5, 5), (-5, 15)),
    "left_shoulder": ((-95, 60), (-60, 40), (-90, 90)),
    "left_elbow": ((-60, 60), (-150, 0), (-5, 5)),
    "left_wrist": ((-55, 55), (-50, 50), (-53, 53)),
}
"""Ranges of the angles a, b, c of R = Rx(a) Ry(b) Rz(c) [degrees], for the middle and the left side.

Trunk, legs and wrists: 0.2 % and 99.8 % quantiles over 31 clips of the CMU motion capture database (walking, running,
jumping, squatting, ball games), retargeted; left and right joined. Shoulder and elbow, whose angles wrap there, and
collar: within the norms of the American Academy of Orthopaedic Surgeons ("Joint Motion", 1965).
"""


def limits() -> np.ndarray:
    """Ranges (55, 3, 2) of the angles a, b, c of R = Rx(a) Ry(b) Rz(c) of every joint [rad]; others rest."""
    table = np.zeros((len(JOINT_NAMES), 3, 2))
    for joint, name in enumerate(JOINT_NAMES):
        ranges = np.array(LEFT.get(name.replace("right_", "left_"), ((0, 0),) * 3), dtype=np.float64)
        if name.startswith("right_"):  # mirrored at x = 0: turns about y and z change sign
            ranges[1:] = -ranges[1:, ::-1]
        table[joint] = np.radians(ranges)
    return table
