"""Where the body stands: on the ground by its own soles, as far from where it was as its own steps reach."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from caphy.conditioning.body import Body, bearing
from caphy.conditioning.settings import Conditioning

SINK: Final = 0.3
"""Time over which the ground is lowered to a sole that is seen below it [s]."""
RISE: Final = 5.0
"""Time over which it is raised to soles that are seen above it [s]: they may jump."""
PRIOR: Final = 0.1
"""Way times speed that must be gone before the scale is the feet's rather than one [m^2/s]."""
SCALES: Final = (0.5, 2.0)
"""Between which the estimated scale lies."""
GLIDE: Final = 0.1
"""Time over which the speed that the feet tell becomes the body's, as its inertia does [s]."""
STRIDE: Final = 0.7
"""Time over which both ways are averaged before they are compared [s]: within a step they differ."""
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
        self._ways = np.zeros((2, 3))

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
        shares, height = bearing(points)
        first = self._points is None
        walked = np.zeros(3) if self._points is None else -shares @ (points - self._points) * PLANE
        step = given - self._given
        if anew:
            walked = np.zeros(3)
        elif not first:
            self._match(walked, step)
        if first:
            place = given * (self.scale if self._settings.translation == "given" else 0.0)
        elif self._settings.translation == "feet":
            self._speed += -float(np.expm1(-self._span / GLIDE)) * (walked / self._span - self._speed)
            place = self._place + self._speed * self._span
        else:
            place = self._place + step * (1.0 if anew else self.scale)
        self._points, self._given, self._place = points, given, place
        return self._grounded(place, height + float(self._body.joints[0, 1]))

    def _match(self, walked: np.ndarray, step: np.ndarray) -> None:
        """Compare the feet's speed with the given one."""
        flat = step * PLANE
        if float(flat @ flat) > MOST_STEP**2:
            return
        share = -float(np.expm1(-self._span / STRIDE))
        self._ways += share * (np.stack([walked, flat]) / self._span - self._ways)
        own, given = self._ways
        self._matched += float(own @ given) * self._span
        self._went += float(given @ given) * self._span

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
