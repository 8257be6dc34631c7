"""Cut of tops: a trunk that hangs from the chest, sleeves that hang from the arms, a neckline, a hem."""

from __future__ import annotations

from functools import reduce

import numpy as np

from caphy.garment.cut import Cut, body_distance, folded, smooth_max, smooth_min, smooth_step
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import Field
from caphy.garment.sections import Sections, slice_frame

CLEARANCE = 0.007
"""Gap [m] where cloth rests on the body: on the shoulders and along the top of the sleeves."""


def top(
    marks: Landmarks,
    *,
    sleeve: float,
    length: float,
    ease: float,
    sleeve_ease: float,
    flare: float,
    neck_width: float,
    neck_depth: float,
) -> Cut:
    """A top; all lengths [m]. ``sleeve`` runs from the shoulder joint along the arm, 0 makes armholes.

    ``length`` runs down from the base of the neck, ``ease`` is the gap between the chest's convex section and the
    cloth (so the chest girth grows by ``2 pi ease``), ``flare`` is how much a slice may be narrower than the one above
    it, per metre: 0 hangs straight down.
    """
    neck, shoulder = marks.joint("neck"), marks.joint("left_shoulder")
    hem = neck[1] - length
    skin = body_distance(marks)
    parts = [_trunk(marks, hem, ease, flare)]
    openings = {"neck": neckline(marks, neck_width, neck_depth), "hem": lambda p: p[:, 1] - hem}
    if sleeve > 0:
        parts.append(_sleeve(marks, sleeve_ease))
        out = slice_frame(marks.joint("left_wrist") - shoulder)[0]
        openings["cuff"] = lambda p: sleeve - (folded(p) - shoulder) @ out
    else:
        openings["armhole"] = _armhole(marks)

    def surface(p: np.ndarray) -> np.ndarray:
        p = folded(p)
        cloth = reduce(lambda a, b: smooth_min(a, b, 0.05), [part(p) for part in parts])
        return smooth_min(cloth, skin(p) - CLEARANCE, 0.012)

    depth, width = np.abs(marks.samples("trunk", "leg")[:, [2, 0]]).max(axis=0) + ease + 0.05
    low = np.array([0.0, hem - 0.06, -depth])
    high = np.array([max(width, shoulder[0] + sleeve + 0.06), neck[1] + 0.07, depth])
    return Cut(surface, openings, low, high)


def _trunk(marks: Landmarks, hem: float, ease: float, flare: float) -> Field:
    points = marks.mirrored("trunk", "leg")
    points = points[points[:, 1] > hem - 0.08]
    shoulder = marks.joint("left_shoulder")[1]
    centre = np.array([0.0, shoulder, marks.joint("spine3")[2]])

    def gap(station: np.ndarray, normal: np.ndarray) -> np.ndarray:
        rest = smooth_step(station + shoulder, marks.armpit - 0.03, shoulder + 0.03)
        return ease + (CLEARANCE - ease) * rest + 0.0 * normal[:, 0]

    trunk = Sections.of(points, centre, np.array([0.0, 1.0, 0.0])).hang(flare, downstream=False).grown(gap)
    # above the shoulders cloth follows the body, not its convex sections
    return lambda p: smooth_max(trunk.distance(p), p[:, 1] - shoulder - 0.03, 0.03)


def _sleeve(marks: Landmarks, ease: float, taper: float = 0.12) -> Field:
    shoulder, wrist = marks.joint("left_shoulder"), marks.joint("left_wrist")
    arm = Sections.of(marks.left("arm"), shoulder, wrist - shoulder).hang(taper, downstream=True)
    up = np.array([0.0, 1.0, 0.0])
    # cloth rests on the top of the arm, so the ease collects below
    arm = arm.grown(lambda _, normal: CLEARANCE + ease * (1.0 - normal @ up))
    return lambda p: smooth_max(arm.distance(p), -0.02 - (p - shoulder) @ arm.frame[0], 0.02)


def neckline(marks: Landmarks, width: float, depth: float) -> Field:
    """Positive outside an elliptic cylinder round the neck, tilted forward and closed below at the nape.

    ``width`` and ``depth`` [m]: the gap beside the neck, and how far it dips in front.
    """
    tilt = np.radians(40.0)
    axis = np.array([0.0, np.cos(tilt), np.sin(tilt)])
    forward = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    neck = marks.joint("neck")
    middle = marks.samples("neck", "trunk") - neck
    middle = middle[np.abs(middle[:, 0]) < 0.02]
    front = (middle[np.abs(middle @ axis) < 0.012] @ forward).max() + depth
    nape = middle[np.abs(middle[:, 1]) < 0.012]
    lid = (nape[nape[:, 2].argmin()] + [0.0, -0.01, -CLEARANCE]) @ axis
    back = -0.09  # well behind the neck: there the lid ends the cloth
    half = np.array([marks.neck_half_width + width, 0.5 * (front - back)])
    centre = neck + forward * 0.5 * (back + front)

    def keep(p: np.ndarray) -> np.ndarray:
        q = p - centre
        flat = np.stack([q[:, 0], q @ forward], axis=1) / half
        outside = (np.linalg.norm(flat, axis=1) - 1.0) * half.min()
        return smooth_max(outside, lid - q @ axis, 0.06)

    return keep


def _armhole(marks: Landmarks) -> Field:
    """Positive outside a quarter ellipse that runs from the shoulder down and out to below the armpit."""
    shoulder = marks.joint("left_shoulder")
    bottom = marks.armpit - 0.03
    edge, outer = shoulder[0] - 0.035, shoulder[0] + 0.03
    half = np.array([outer - edge, shoulder[1] - bottom])

    def keep(p: np.ndarray) -> np.ndarray:
        inward = np.minimum(np.abs(p[:, 0]) - outer, 0.0) / half[0]
        down = np.minimum(p[:, 1] - shoulder[1], 0.0) / half[1]
        return (np.hypot(inward, down) - 1.0) * half.min()

    return keep
