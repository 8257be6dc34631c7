"""Which way is up in the camera: from the straight vertical lines of rooms and streets, else from how people stand."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

TOLERANCE: Final = np.radians(1.5)
"""A line counts as vertical within this [rad]."""
LEAN: Final = np.radians(40.0)
"""No camera is taken to be held further from level than this [rad]."""
AGREE: Final = np.radians(15.0)
"""Lines that say otherwise than the standing person by more are not of a building [rad]."""
LEAST_LINES: Final = 8
LEAST_SHARE: Final = 0.25
"""Of the length of all lines near upright, what must agree: floors and people have such lines too."""
APART: Final = np.radians(4.0)
CLEAR: Final = 1.4
"""How much more must agree than the rest does with any direction further away than 4 degrees."""
FIT: Final = np.radians(0.75)
"""Spread of a line about the vertical that it shows [rad]."""
STAND: Final = np.radians(6.0)
"""How far from upright people stand in the mean of some seconds [rad]."""
LEVEL: Final = np.radians(20.0)
"""How far from level cameras are held [rad]."""
SLEW: Final = np.radians(20.0)
"""How fast the world is turned when up is known better [rad/s]: faster, and clothes would fly."""
UNSEEN: Final = 0.2
"""Before anybody is seen the camera is taken as level; one picture of somebody standing counts five times as much."""
_SHORTEST = 0.05


def up_from_lines(pixels: np.ndarray, focal: float, guess: np.ndarray, spread: float = LEVEL) -> np.ndarray | None:
    """Direction (3,) of up in the camera (right, down, ahead) from vertical lines of a picture (H, W, 3), or none.

    Every line's plane through the eye holds the vertical; the direction that most of their length agrees on within
    1.5 degrees wins (RANSAC over all pairs of the longest, those near the guess first), then least squares over those
    that agree. Lines side by side, as of one door, leave open how far up is tilted along them; there the guess counts.

    Args:
        focal: [pixels].
        guess: (3,) up as known so far; lines more than 40 degrees off it on the picture are not asked.
        spread: how far off the guess may well be [rad].
    """
    normals, lengths = _planes(pixels, focal, guess)
    if len(normals) < LEAST_LINES:
        return None
    first, second = np.triu_indices(min(len(normals), 40), 1)
    candidates = np.cross(normals[first], normals[second])
    sizes = np.linalg.norm(candidates, axis=1)
    candidates = candidates[sizes > 0.02] / sizes[sizes > 0.02, None]
    candidates *= np.where(candidates @ guess < 0, -1.0, 1.0)[:, None]
    candidates = candidates[candidates @ guess > np.cos(LEAN)]
    if not len(candidates):
        return None
    fits = abs(candidates @ normals.T) < np.sin(TOLERANCE)
    votes = fits @ lengths
    likely = np.exp((candidates @ guess - 1) / (2 * spread) ** 2)  # twice as far off is not ruled out
    chosen = (votes * likely).argmax()
    best = candidates[chosen]
    agrees = abs(normals @ best) < np.sin(TOLERANCE)
    others = (fits[candidates @ best < np.cos(APART)] @ np.where(agrees, 0.0, lengths)).max(initial=0.0)
    least = max(LEAST_SHARE * lengths.sum(), CLEAR * others)
    if agrees.sum() < LEAST_LINES or votes[chosen] < least:
        return None
    return _fitted(normals, lengths, best, guess, spread)


def _fitted(normals: np.ndarray, lengths: np.ndarray, best: np.ndarray, guess: np.ndarray, spread: float) -> np.ndarray:
    """Least squares over the lines that agree with ``best`` (3,) and, within its spread [rad], over the guess."""
    for _ in range(3):
        agrees = abs(normals @ best) < np.sin(TOLERANCE)
        trust = lengths[agrees] / lengths.max() / FIT**2
        known = (normals[agrees] * trust[:, None]).T @ normals[agrees]
        best = np.linalg.solve(known + np.eye(3) / spread**2, guess / spread**2)
        best /= np.linalg.norm(best)
    return best


def _planes(pixels: np.ndarray, focal: float, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (N, 3) of the planes through eye and line, longest first, and lengths (N,) [of the picture's height]."""
    height, width = pixels.shape[:2]
    shrink = min(1.0, 720 / max(height, width))
    grey = cv2.cvtColor(cv2.resize(pixels, None, fx=shrink, fy=shrink), cv2.COLOR_BGR2GRAY)
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    if found is None:
        return np.zeros((0, 3)), np.zeros(0)
    ends = (found.reshape(-1, 2, 2) / shrink - [width / 2, height / 2]) / focal
    along = ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(along, axis=1) * focal / height
    middle = np.concatenate([ends.mean(axis=1), np.ones((len(ends), 1))], axis=1)
    expected = guess[:2] - middle[:, :2] * guess[2]  # how the vertical through this point looks there
    cosine = abs(np.einsum("ni,ni->n", along, expected)) / (
        np.linalg.norm(along, axis=1) * np.linalg.norm(expected, axis=1) + 1e-12
    )
    chosen = np.flatnonzero((lengths > _SHORTEST) & (cosine > np.cos(np.radians(25))))
    chosen = chosen[np.argsort(-lengths[chosen], kind="stable")][:200]
    rays = np.concatenate([ends[chosen], np.ones((len(chosen), 2, 1))], axis=2)
    normals = np.cross(rays[:, 0], rays[:, 1])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), lengths[chosen]


class Gravity:
    """Keeps the camera's turn against the world: up by lines, looked for now and then, or by the mean person.

    The heading is the camera's: the world's z axis points from the scene to the camera.
    """

    def __init__(self, focal: float, every: float = 2.0) -> None:
        self._focal, self._every = focal, every
        self.by_lines = False
        self.forget()

    def forget(self) -> None:
        """The camera may have moved, as after a cut."""
        self._up = self._goal = np.array([0.0, -1.0, 0.0])
        self._people, self._weight = UNSEEN * self._up, UNSEEN
        self._next, self._time = -np.inf, -np.inf
        self.by_lines = False

    def see(self, time: float, pixels: np.ndarray, body_up: np.ndarray | None, weight: float = 1.0) -> None:
        """A picture (H, W, 3) at ``time`` [s], and the way (3,) up along the body in it where somebody stands."""
        if body_up is not None:
            self._people += weight * body_up / np.linalg.norm(body_up)
            self._weight += weight
        if time >= self._next:
            self._look(pixels)
            self._next = time + (self._every if self.by_lines else self._every / 4)
        if not self.by_lines:
            self._goal = self._people / np.linalg.norm(self._people)
        self._approach(time)

    def _look(self, pixels: np.ndarray) -> None:
        guess = self._people / np.linalg.norm(self._people)
        known = self._weight > 5
        up = up_from_lines(pixels, self._focal, guess, STAND if known else LEVEL)
        if up is not None and (not known or up @ guess > np.cos(AGREE)):
            if not self.by_lines or up @ self._goal < np.cos(np.radians(1.0)):  # a turn of less is noise
                self._goal = up
            self.by_lines = True

    def _approach(self, time: float) -> None:
        """Turn towards what is known by now: at once in the first picture, slowly later."""
        angle = float(np.arccos(np.clip(self._up @ self._goal, -1, 1)))
        most = SLEW * (time - self._time)
        self._time = time
        if angle <= most or angle < 1e-6:
            self._up = self._goal
        else:
            mixed = self._up * np.sin(angle - most) + self._goal * np.sin(most)
            self._up = mixed / np.linalg.norm(mixed)

    @property
    def turn(self) -> np.ndarray:
        """Rotation (3, 3) from the camera's axes (right, down, ahead) to the world's (y up)."""
        back = np.array([0.0, 0.0, -1.0]) + self._up * self._up[2]
        back /= np.linalg.norm(back)
        return np.stack([np.cross(self._up, back), self._up, back])
