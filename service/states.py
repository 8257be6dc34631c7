"""States of garments' networks: joined in what clients send, one by one in engines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from caphy.conventions import MOTION_STATE
from caphy.io.bundle import FPS
from caphy.io.poses.sequence import MAX_DISTANCE
from service.engine import GarmentEngine
from service.errors import Problem

MAX_MEMORY: Final = 1.001
"""A GRU's memory lies between -1 and 1, and cloth flies off for good from what does not; rounding may add something."""
MAX_MOTION: Final = 2 * MAX_DISTANCE * FPS[1]
"""Of the last frame's translation [m] and velocity [m/s]: a leap through all there is in one frame."""


def require_states(joined: np.ndarray, engines: Sequence[GarmentEngine]) -> None:
    """Raise Problem unless ``joined`` (S,) are states that ``engines`` can have answered, one by one, or none."""
    size = sum(engine.state_size for engine in engines)
    if joined.size not in (0, size):
        raise Problem(422, f"state: must hold {size} floats for these garments, or none, got {joined.size}")
    for engine, state in zip(engines, _parts(engines, joined), strict=False):
        for what, part, most in (
            ("memory", state[:-MOTION_STATE], MAX_MEMORY),
            ("motion", state[-MOTION_STATE:], MAX_MOTION),
        ):
            with np.errstate(invalid="ignore"):  # signalling NaN
                bad = np.flatnonzero(~(np.abs(part) <= most))
            if len(bad):
                raise Problem(
                    422,
                    f"state: {engine.name}'s {what} must be finite and within {most:g}, got {part[bad[0]]:g}; pass on "
                    "what the last answer held, garment by garment in its order",
                )


def split_states(engines: Sequence[GarmentEngine], joined: np.ndarray) -> dict[str, np.ndarray]:
    """The state (S,) of each engine's garment from all of them one after another, or the first states from none."""
    if not joined.size:
        return {engine.name: engine.initial_state() for engine in engines}
    return {e.name: part.astype(np.float32) for e, part in zip(engines, _parts(engines, joined), strict=True)}


def _parts(engines: Sequence[GarmentEngine], joined: np.ndarray) -> list[np.ndarray]:
    return np.split(joined, np.cumsum([engine.state_size for engine in engines])[:-1]) if joined.size else []
