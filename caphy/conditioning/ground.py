"""Where the body stands: on the ground by its own soles, as far from where it was as its own steps reach."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from caphy.conditioning.body import Body, standing_height
from caphy.conditioning.settings import Conditioning

SINK: Final = 0.3
"""Time over which the ground is lowered to a sole that is seen below it [s]."""
RISE: Final = 5.0
"""Time over which it is raised to soles that are seen above it [s]: they may jump."""
PRIOR: Final = 0.1
"""Way times speed that must be gone before the scale is the feet's rather than one [m^2/s]."""
SCALES: Final = (0.5, 2.0)
"""Between which the estimated scale lies."""
GLIDE: Final = 0.05
"""Time over which the speed that the feet tell becomes the body's, as its inertia does [s]."""
STRIDE: Final = 0.7
"""Time over which both speeds are averaged before they are compared [s]: within a step they differ."""
LOW: Final = 0.08
"""A sole higher than this above the other does not stand [m]."""
CLOSE: Final = 0.05
"""Height over which soles are likely to stand [m]."""
STILL: Final = 0.3
"""Speed over the ground at which soles are likely to stand [m/s]."""
LEAST_SPEED: Final = 0.4
"""A slower body sways or turns, and does not walk [m/s]."""
PLANE: Final = np.array([1.0, 0.0, 1.0])
MOST_STEP: Final = 0.5
"""A step of the given translation between two frames that is longer tells nothing about the scale [m]."""


class Ground:
    """Takes frames' places one after another, and puts the body on the ground as the settings ask."""

    def __init__(self, body: Body, settings: Conditioning) -> None:
        self._body, self._settings = body, settings
        self._span = 1 / settings.fps
        self._points: np.ndarray | None = None
        self._given = self._place = np.zeros(3)
        self._speed = np.zeros(3)
        self._floor: float | None = None
        self._matched = self._went = 0.0
        self._ways = np.zeros(2)

    @property
    def scale(self) -> float:
        """Factor of the given translation's size."""
        if self._settings.scale is not None:
            return self._settings.scale
        return float(np.clip((self._matched + PRIOR) / (self._went + PRIOR), *SCALES))

    def put(self, turns: np.ndarray, given: np.ndarray, anew: bool) -> np.ndarray:
        """Where the root belongs (3,) [m] of a frame with pose (55, 4) and translation ``given`` (3,) [m].

        anew: whether the frame does not go on from the one before.
        """
        points = self._body.soles(turns)
        height = standing_height(points)
        first = self._points is None
        speeds = np.zeros_like(points) if self._points is None or anew else (points - self._points) * PLANE / self._span
        step = given - self._given
        if not (first or anew):
            self._match(speeds[low(points)], step * PLANE / self._span)
        self._carry(points, speeds)
        if first:
            place = given * (self.scale if self._settings.translation == "given" else 0.0)
        elif self._settings.translation == "feet":
            place = self._place + self._speed * self._span
        else:
            place = self._place + step * (1.0 if anew else self.scale)
        self._points, self._given, self._place = points, given, place
        return self._grounded(place, height + float(self._body.joints[0, 1]))

    def _carry(self, points: np.ndarray, speeds: np.ndarray) -> None:
        """The body's speed by the soles that are low and, if it goes on as it does, stand still."""
        over = np.einsum("pi,pi->p", speeds + self._speed, speeds + self._speed)
        shares = np.exp((over.min() - over) / STILL**2 + (points[:, 1].min() - points[:, 1]) / CLOSE)
        told = -(shares / shares.sum()) @ speeds
        self._speed = self._speed - float(np.expm1(-self._span / GLIDE)) * (told - self._speed)

    def _match(self, speeds: np.ndarray, given: np.ndarray) -> None:
        """Compare the given speed with that of the low sole that goes back fastest: the one that is trodden on."""
        size = float(np.linalg.norm(given))
        if size * self._span > MOST_STEP or size < LEAST_SPEED:
            return
        own = float((-speeds @ given).max()) / size
        share = -float(np.expm1(-self._span / STRIDE))
        self._ways += share * (np.array([own, size]) - self._ways)
        self._matched += float(self._ways[0] * self._ways[1]) * self._span
        self._went += float(self._ways[1] ** 2) * self._span

    def _grounded(self, place: np.ndarray, height: float) -> np.ndarray:
        if self._settings.translation == "feet":
            return place * PLANE - [0.0, height, 0.0]
        if not self._settings.floor:
            return place
        lowest = place[1] + height
        if self._floor is None:
            self._floor = float(lowest)
        time = SINK if lowest < self._floor else RISE
        self._floor += -float(np.expm1(-self._span / time)) * (float(lowest) - self._floor)
        return place - [0.0, self._floor, 0.0]

    def as_json(self) -> dict[str, Any]:
        """Scale and floor height [m], as far as they are used."""
        return {"scale": round(self.scale, 4), "floor": None if self._floor is None else round(self._floor, 4)}


def low(points: np.ndarray) -> np.ndarray:
    """Which points of the soles (6,) may stand."""
    return points[:, 1] < points[:, 1].min() + LOW
