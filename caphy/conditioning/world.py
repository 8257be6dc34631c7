"""From a camera's axes to a world with y up."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from caphy.conditioning.body import Body
from caphy.conditioning.quaternions import aligning, product, turned
from caphy.errors import CaphyError

Y_UP: Final = np.array([0.0, 1.0, 0.0])
LEVEL: Final = np.array([0.0, 1.0, 0.0, 0.0])
"""A half turn about x (4,): from a level camera's axes (x right, y down, z ahead) to y up, looking along -z."""
LEVEL_ERROR: Final = np.radians(12.0)
"""How far from level cameras are held [rad]."""
SWAY: Final = np.radians(8.0)
"""How far from up the line from foot to chest is at any one time [rad]: 3 to 12 degrees over CMU clips."""
SWAY_TIME: Final = 0.5
"""After which that is seen anew [s]."""
BIAS: Final = np.radians(2.5)
"""What of it remains in the mean over a motion [rad]."""
MEMORY: Final = 20.0
"""Time over which the mean is taken, so that a camera moved in between is followed [s]."""


class Upright:
    """Where up is in a camera's axes: told, or the mean of the body's own direction, beginning from a level camera.

    The estimate is that of a fixed camera. Its standard deviation counts what the body has shown so far, and what a
    body's mean posture leaves unknown.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._sum = np.zeros(3)
        self._seconds = 0.0
        self._told: np.ndarray | None = None
        self._looked = self._known = 0.0  # seconds, of them those that are in the mean from elsewhere

    def begin_with(self, other: Upright) -> None:
        """Know what ``other`` learnt of the same motion from its beginning on, which is not looked at again."""
        self._sum, self._seconds, self._known = other._sum, other._seconds, other._looked

    def tell(self, up: np.ndarray) -> None:
        """Up is ``up`` (3,) in the camera's axes, whatever the body does. Raises CaphyError for no direction."""
        up = np.array(up, np.float64)
        if up.shape != (3,) or not np.isfinite(up).all() or np.linalg.norm(up) < 1e-6:
            raise CaphyError(f"up must be a direction (x, y, z) in the camera's axes, got {up}")
        self._told = up / np.linalg.norm(up)

    def look(self, turns: np.ndarray, seconds: float) -> None:
        """Take in a pose (55, 4) in the camera's axes turned level, which was seen for ``seconds``."""
        self._looked += seconds
        if self._told is not None or self._looked <= self._known:
            return
        kept = np.exp(-seconds / MEMORY)
        back = aligning(self.level_up, Y_UP)  # so that the lower foot is known
        upright = np.concatenate([product(back, turns[0])[None], turns[1:]])
        up = turned(back * np.array([1.0, -1.0, -1.0, -1.0]), self._body.upward(upright))
        self._sum = kept * self._sum + seconds * up
        self._seconds = kept * self._seconds + seconds

    @property
    def level_up(self) -> np.ndarray:
        """Up (3,) as seen in the axes of a camera taken as level."""
        if self._told is not None:
            return turned(LEVEL, self._told)
        mean = Y_UP / LEVEL_ERROR**2 + self._sum / SWAY_TIME / SWAY**2
        return mean / np.linalg.norm(mean)

    @property
    def error(self) -> float:
        """Standard deviation of the estimate [rad]; 0 where it was told."""
        if self._told is not None:
            return 0.0
        return float(np.sqrt(1 / (1 / LEVEL_ERROR**2 + self._seconds / SWAY_TIME / SWAY**2) + BIAS**2))

    def rotation(self) -> np.ndarray:
        """The rotation (4,) from the camera's axes to the world's."""
        return product(aligning(self.level_up, Y_UP), LEVEL)

    def as_json(self) -> dict[str, Any]:
        """Up in the camera's axes, its standard deviation [degrees], and where it is from."""
        up = turned(LEVEL, self.level_up)
        return {
            "up": [round(float(x), 4) for x in up],
            "up_error_degrees": round(float(np.degrees(self.error)), 2),
            "up_from": "camera" if self._told is not None else "motion",
        }


def turned_root(
    rotation: np.ndarray, root: np.ndarray, transl: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Root rotation (4,) and translation (3,) [m] after a turn of the world: the root turns about the rest pelvis."""
    return product(rotation, root), turned(rotation, transl + pelvis) - pelvis
