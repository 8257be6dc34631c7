"""Inverse kinematics: the posture of the avatar's skeleton whose landmarks are those of the picture.

Gauss-Newton over the rotations of 22 joints and the place of the pelvis, in the camera's axes (right, down, ahead).
The residuals of one picture:

    pixels   the landmark's projection against where it was seen, as metres at the landmark's depth
    depths   the landmark's place against the hips, against the detector's guess in space (mostly its depth)
    usual    axis-angles of all joints together against what bodies do (posture.py)
    past     the turn of each joint since the last picture
    limits   joints that turn further than joints turn

each divided by how far it is trusted; landmarks count by their visibility, and pixels that fit no body count less
(Geman and McClure 1987). The camera's perspective is in the first term, so what is near is larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.clients.monocular.landmarks import LANDMARKS, Landmarks
from service.clients.monocular.posture import limits, postures, usual_posture
from service.clients.monocular.rotations import best_turn, inverse_jacobians, smallest_turn, turns, turns_inverse
from service.clients.monocular.skeleton import Skeleton

PIXEL_SPREADS = {
    **dict.fromkeys(("eye_inner", "eye", "eye_outer", "ear", "mouth", "nose"), 0.02),
    "shoulder": 0.025,
    "elbow": 0.025,
    "wrist": 0.02,
    "pinky": 0.035,
    "index": 0.03,
    "thumb": 0.035,
    "hip": 0.03,
    "knee": 0.03,
    "ankle": 0.025,
    "heel": 0.035,
    "foot_index": 0.035,
}
"""Trust in a landmark's place on the picture [m at its depth]."""
SPACE_SPREAD = np.array([0.10, 0.10, 0.07])
"""Trust in a landmark's place in space against the hips: across, down, away [m]."""
OUTLIER = 4.0
"""Pixels further off than so many spreads count less and less."""
TURN_RATE = 30.0
"""Speed of a joint's turn that is nothing unusual [rad/s]: trust in the last picture's posture. It hardly pulls, for
what is calm, and how late that makes poses, is the conditioning's to decide; it chooses where the picture does not."""
MOVE_RATE = 12.0
"""The same of the pelvis [m/s]."""
LIMIT_SPREAD = np.radians(3.0)
LOST = 0.1
"""A misfit above which a fresh start is tried [m]."""

_SPREAD = np.array([PIXEL_SPREADS[name.removeprefix("left_").removeprefix("right_")] for name in LANDMARKS])
_TORSO = [LANDMARKS.index(name) for name in ("left_shoulder", "right_shoulder", "left_hip", "right_hip")]
_HIPS = [LANDMARKS.index(name) for name in ("left_hip", "right_hip")]


@dataclass(frozen=True, eq=False)
class Posture:
    """rotations: (22, 3, 3) of each joint against its parent, the pelvis against the camera. root: (3,) the pelvis [m].

    misfit: root mean square distance of the landmarks from where they were seen [m at their depth].
    """

    rotations: np.ndarray
    root: np.ndarray
    misfit: float


class Kinematics:
    """Follows one person from picture to picture.

    focal: [pixels]. size: width and height of the pictures [pixels]. scale: the person's landmarks in space are of
    another person's size; they are scaled to the avatar's by a slow mean of the bones' lengths.
    """

    def __init__(self, skeleton: Skeleton, focal: float, size: tuple[int, int]) -> None:
        self._skeleton = skeleton
        self._focal, self._middle = focal, np.array(size) / 2
        self._mean, _ = usual_posture()
        self._usual, self._precision = postures()
        self._low, self._high = limits()
        self._last: Posture | None = None
        self._scale, self._scales = 1.0, 0
        self._lengths = _bone_lengths(skeleton.sites)

    def forget(self) -> None:
        """The next picture shows somebody else, or somewhere else."""
        self._last, self._scales = None, 0

    def fit(self, seen: Landmarks, step: float) -> Posture:
        """The posture in the next picture, ``step`` seconds after the last; after infinitely many the last picture's
        is only where the search begins, and weighs nothing."""
        places = (seen.pixels - self._middle) / self._focal
        space = self._in_camera(seen.world, places)
        weights = seen.visibility.clip(0.03, 1)
        known = None if self._last is None else self._refined(self._last, places, space, weights, step)
        if known is None or known.misfit > LOST:
            fresh = self._refined(self._first(space, places, weights), places, space, weights, None)
            known = fresh if known is None or fresh.misfit < 0.7 * known.misfit else known
        self._last = known
        return known

    def _refined(
        self, start: Posture, places: np.ndarray, space: np.ndarray, weights: np.ndarray, step: float | None
    ) -> Posture:
        """Gauss-Newton from ``start``; ``step`` [s] after it, or none where it is only a guess."""
        rotations, root, misfit = start.rotations, start.root, np.inf
        for _ in range(4 if step is not None else 25):
            turn, move, misfit = self._step(rotations, root, places, space, weights, step)
            rotations, root = rotations @ turns(turn), root + move
            root[2] = max(root[2], 0.3)
            if max(abs(turn).max(), abs(move).max()) < 2e-3:
                break
        return Posture(rotations, root, misfit)

    def _in_camera(self, world: np.ndarray, places: np.ndarray) -> np.ndarray:
        """The detector's landmarks in space (33, 3) in the camera's axes, of the avatar's size, about the hips."""
        lengths = _bone_lengths(world)
        ratio = float(np.median(self._lengths / np.maximum(lengths, 1e-3)))
        self._scales = min(self._scales + 1, 60)
        self._scale += (ratio - self._scale) / self._scales
        ray = np.append(places[_HIPS].mean(axis=0), 1.0)
        return self._scale * world @ smallest_turn(np.array([0.0, 0.0, 1.0]), ray).T

    def _first(self, space: np.ndarray, places: np.ndarray, weights: np.ndarray) -> Posture:
        """A standing start: the usual posture, turned as the torso is, where its landmarks are seen."""
        rotations = turns(self._mean)
        rotations[0] = best_turn(self._skeleton.sites[_TORSO], space[_TORSO], np.ones(4))
        root = self._placed(space - space[_HIPS].mean(axis=0), places, weights)
        return Posture(rotations, root, np.inf)

    @staticmethod
    def _placed(points: np.ndarray, places: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Where (3,) points (33, 3) must be moved to be seen at ``places`` (33, 2): linear least squares."""
        rows = np.zeros((len(points), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1
        rows[:, :, 2] = -places
        wanted = places * points[:, 2:] - points[:, :2]
        w = weights[:, None]
        found = np.linalg.lstsq((rows * w[..., None]).reshape(-1, 3), (wanted * w).ravel(), rcond=None)[0]
        return found if found[2] > 0.5 else np.array([0.0, 0.0, 3.0])

    def _step(
        self,
        rotations: np.ndarray,
        root: np.ndarray,
        places: np.ndarray,
        space: np.ndarray,
        weights: np.ndarray,
        step: float | None,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Turns (22, 3) [rad], move (3,) [m] and the misfit [m] before them."""
        world, joints, sites = self._skeleton.posed(rotations, root)
        slopes = self._slopes(world, joints, sites)
        size = slopes.shape[-1]
        matrix, vector, misfit = self._pixel_terms(sites, slopes, places, weights)
        share = weights / weights.sum()  # against the middle of all landmarks: the hips alone are seen badly
        offset = sites - space
        offset -= share @ offset
        trust = np.sqrt(weights)[:, None] / SPACE_SPREAD
        rows = (slopes - np.einsum("n,nis->is", share, slopes)) * trust[..., None]
        rows = rows.reshape(-1, size)
        matrix += rows.T @ rows
        vector += rows.T @ (offset * trust).ravel()
        angles = turns_inverse(rotations)
        self._add_usual(matrix, vector, angles)
        if step is not None and self._last is not None:
            self._add_past(matrix, vector, rotations, root, step)
        matrix[np.diag_indices(size)] += 1e-3
        found = -np.linalg.solve(matrix, vector)
        return found[3:].reshape(-1, 3).clip(-0.6, 0.6), found[:3], misfit

    def _slopes(self, world: np.ndarray, joints: np.ndarray, sites: np.ndarray) -> np.ndarray:
        """How landmarks move (33, 3, 3 + 66) with the pelvis' place and small turns of every joint."""
        arms = np.where(self._skeleton.above[..., None], sites[:, None] - joints, 0.0)  # (33, 22, 3)
        axes = np.swapaxes(world, 1, 2)  # (22, 3 axes, 3)
        x, y, z = (arms[..., None, i] for i in range(3))
        a, b, c = (axes[None, ..., i] for i in range(3))
        moved = np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)  # axis x arm: (33, 3, 22, 3 axes)
        slopes = np.empty((len(sites), 3, 3 + 3 * len(joints)))
        slopes[:, :, :3] = np.eye(3)
        slopes[:, :, 3:] = moved.reshape(len(sites), 3, -1)
        return slopes

    def _pixel_terms(
        self, sites: np.ndarray, slopes: np.ndarray, places: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        depth = np.maximum(sites[:, 2:], 0.2)
        off = sites[:, :2] - places * depth
        square = np.einsum("ni,ni->n", off, off)
        trust = np.sqrt(weights) / _SPREAD / (1 + square / (OUTLIER * _SPREAD) ** 2)
        rows = (slopes[:, :2] - places[..., None] * slopes[:, 2:]) * trust[:, None, None]
        rows = rows.reshape(-1, slopes.shape[-1])
        misfit = float(np.sqrt(weights @ square / weights.sum()))
        return rows.T @ rows, rows.T @ (off * trust[:, None]).ravel(), misfit

    def _add_usual(self, matrix: np.ndarray, vector: np.ndarray, angles: np.ndarray) -> None:
        """The terms "usual" and "limits"; the pelvis may turn as it likes."""
        over = (angles - angles.clip(self._low, self._high))[1:]
        held = ((over != 0) / LIMIT_SPREAD**2).ravel()
        pull = self._precision @ (angles[1:].ravel() - self._usual) + over.ravel() / LIMIT_SPREAD**2
        inverse = inverse_jacobians(angles)[1:]
        trust = (self._precision + np.diag(held)).reshape(len(over), 3, len(over), 3)
        trust = np.einsum("jca,jckd,kdb->jakb", inverse, trust, inverse, optimize=True)
        matrix[6:, 6:] += trust.reshape(len(held), len(held))
        vector[6:] += np.einsum("jca,jc->ja", inverse, pull.reshape(-1, 3)).ravel()

    def _add_past(
        self, matrix: np.ndarray, vector: np.ndarray, rotations: np.ndarray, root: np.ndarray, step: float
    ) -> None:
        assert self._last is not None
        turned = turns_inverse(np.swapaxes(self._last.rotations, 1, 2) @ rotations)
        trust = np.full(len(vector), 1 / (TURN_RATE * step) ** 2)
        trust[:3] = 1 / (MOVE_RATE * step) ** 2
        vector += trust * np.concatenate([root - self._last.root, turned.ravel()])
        matrix[np.diag_indices(len(vector))] += trust


_BONES = np.array(
    [
        [LANDMARKS.index(f"{side}_{end}") for end in bone]
        for side in ("left", "right")
        for bone in (
            ("shoulder", "elbow"),
            ("elbow", "wrist"),
            ("hip", "knee"),
            ("knee", "ankle"),
            ("shoulder", "hip"),
        )
    ]
)


def _bone_lengths(points: np.ndarray) -> np.ndarray:
    """Lengths (10,) [m] of arms, legs and flanks of landmarks (33, 3)."""
    return np.linalg.norm(points[_BONES[:, 0]] - points[_BONES[:, 1]], axis=-1)
