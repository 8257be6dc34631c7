"""Cut of what hangs from the waist: trousers, shorts and skirts."""

from __future__ import annotations

import numpy as np

from caphy.garment.cut import Cut, body_distance, folded, smooth_max, smooth_min, smooth_step
from caphy.garment.landmarks import Landmarks
from caphy.garment.sections import Sections

CLEARANCE = 0.006
"""Gap [m] where cloth lies on the body, as at the waistband and the seat."""
PARTED = 0.008
"""Distance [m] of a thigh from the middle at which cloth finds its way between both."""


def trousers(marks: Landmarks, *, rise: float, leg: float, ease: float, leg_ease: float, taper: float) -> Cut:
    """Trousers or shorts; lengths [m]. ``rise`` runs up from the crotch to the waistband, ``leg`` down from it.

    ``ease`` is the gap at the hips, ``leg_ease`` below; ``taper`` is how much the leg may narrow per
    metre (0 is straight).
    """
    waist, hem = marks.crotch + rise, marks.crotch - leg
    hips, limb = _hips(marks, waist, ease), _leg(marks, hem, ease, leg_ease, taper)
    skin = body_distance(marks)
    fork = _fork(marks)

    def surface(p: np.ndarray) -> np.ndarray:
        p = folded(p)
        seat = smooth_max(hips.distance(p), fork - 0.008 - p[:, 1], 0.02)
        between = np.clip(0.35 * (fork - p[:, 1]), 0.0, 0.014)  # half the gap between the legs
        tube = smooth_max(limb.distance(_unbent(p, marks)), between - p[:, 0], 0.004)
        return smooth_min(smooth_min(seat, tube, 0.012), skin(p) - CLEARANCE, 0.008)

    size = np.abs(hips.support).max() + 0.05
    foot = marks.joint("left_ankle")[0] + 0.16
    low = np.array([0.0, hem - 0.06, hips.origin[2] - size])
    high = np.array([max(size, foot), waist + 0.06, hips.origin[2] + size])
    openings = {"waist": lambda p: waist - p[:, 1], "hem": lambda p: p[:, 1] - hem}
    return Cut(surface, openings, low, high)


def skirt(marks: Landmarks, *, rise: float, length: float, ease: float, flare: float) -> Cut:
    """A skirt; lengths [m]. ``length`` runs down from the waistband, ``flare`` is the widening per metre."""
    waist = marks.crotch + rise
    hem = waist - length
    points = marks.mirrored("trunk", "leg")
    points = points[(points[:, 1] > hem - 0.08) & (points[:, 1] < waist + 0.08)]
    axis = np.array([0.0, 1.0, 0.0])
    origin = np.array([0.0, waist, marks.joint("pelvis")[2]])
    snug = Sections.of(points, origin, axis).hang(0.0, downstream=False)
    shape = snug.grown(lambda s, n: ease + flare * np.maximum(-0.06 - s, 0.0) + 0.0 * n[:, 0])
    skin = body_distance(marks)
    size = np.abs(shape.support).max() + 0.05
    low = np.array([0.0, hem - 0.06, origin[2] - size])
    high = np.array([size, waist + 0.06, origin[2] + size])
    openings = {"waist": lambda p: waist - p[:, 1], "hem": lambda p: p[:, 1] - hem}
    return Cut(lambda p: smooth_min(shape.distance(p), skin(p) - CLEARANCE, 0.012), openings, low, high)


def _fork(marks: Landmarks) -> float:
    """Height y at which cloth parts into two legs: at the crotch, or below it where thighs touch."""
    points = marks.samples("trunk", "leg")
    close = (np.abs(points[:, 0]) < PARTED) & (points[:, 1] > marks.joint("left_knee")[1])
    return min(marks.crotch, float(points[close, 1].min(initial=np.inf)))


def _hips(marks: Landmarks, waist: float, ease: float) -> Sections:
    points = marks.mirrored("trunk", "leg")
    points = points[(points[:, 1] > marks.crotch - 0.02) & (points[:, 1] < waist + 0.08)]
    origin = np.array([0.0, waist, marks.joint("pelvis")[2]])
    return Sections.of(points, origin, np.array([0.0, 1.0, 0.0])).grown(lambda s, n: ease + 0.0 * s + 0.0 * n[:, 0])


def _leg(marks: Landmarks, hem: float, ease: float, leg_ease: float, taper: float) -> Sections:
    """Horizontal slices of the left leg about the line from hip to ankle: see :func:`_unbent`."""
    points = _unbent(marks.left("leg"), marks)
    points = points[points[:, 1] > hem - 0.05]
    top = points[:, 1].max()
    origin = np.array([0.0, top, 0.0])

    def gap(station: np.ndarray, normal: np.ndarray) -> np.ndarray:
        loose = smooth_step(-(station + top), -marks.crotch - 0.05, -marks.crotch + 0.15)
        return ease + (leg_ease - ease) * loose + 0.0 * normal[:, 0]

    axis = np.array([0.0, 1.0, 0.0])
    return Sections.of(points, origin, axis).hang(taper, downstream=False).grown(gap)


def _unbent(points: np.ndarray, marks: Landmarks) -> np.ndarray:
    """Points shifted sideways so that the left leg's line from hip to ankle lies on x = z = 0."""
    bones = np.stack([marks.joint(n) for n in ("left_ankle", "left_hip")])
    shifted = points.copy()
    for axis in (0, 2):
        shifted[:, axis] -= np.interp(points[:, 1], bones[:, 1], bones[:, axis])
    return shifted
