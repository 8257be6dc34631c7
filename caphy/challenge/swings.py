"""How pins and balls move: smooth, energetic, and never the same way twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Path = Callable[[float], np.ndarray]
"""Positions (3,) or (P, 3) [m] at a time [s]."""


@dataclass(frozen=True)
class Swing:
    """What a motion of the square is made of.

    Attributes:
        facing: heading of the cloth's front about the vertical [degrees].
        reach: size of the swings to the side, up, and to the front [m].
        turn: size of the swings in heading [degrees].
        tempo: lowest and highest frequency [1/s].
        ball: whether a ball swings through the cloth.
    """

    facing: float
    reach: tuple[float, float, float]
    turn: float
    tempo: tuple[float, float]
    ball: bool = False


TRAINING = (
    Swing(0, (0.03, 0.01, 0.06), 8, (0.5, 1.6)),
    Swing(100, (0.05, 0.01, 0.03), 18, (0.5, 1.6), ball=True),
    Swing(220, (0.02, 0.02, 0.04), 10, (0.5, 1.4), ball=True),
)
HELD_OUT = (
    Swing(310, (0.04, 0.03, 0.05), 14, (0.8, 1.8)),
    Swing(160, (0.03, 0.02, 0.05), 12, (0.6, 1.6), ball=True),  # what acts in contact only is proven here
)
BASE = (Swing(60, (0.03, 0.015, 0.05), 10, (0.5, 1.6)), Swing(270, (0.03, 0.02, 0.04), 10, (0.5, 1.6), ball=True))

WAVES = 4
RADIUS = 0.09
"""Of the ball [m]."""


def wander(size: np.ndarray, tempo: tuple[float, float], random: np.random.Generator) -> Path:
    """A sum of waves in each direction, zero at time zero, about ``size`` (3,) [m] large."""
    frequency = random.uniform(*tempo, (WAVES, 3))
    phase = random.uniform(0, 2 * np.pi, (WAVES, 3))
    weight = random.uniform(0.5, 1.0, (WAVES, 3)) / np.sqrt(WAVES) * size

    def place(time: float) -> np.ndarray:
        return (weight * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase))).sum(0)

    return place


def pin_path(swing: Swing, pins: np.ndarray, random: np.random.Generator, start: float) -> Path:
    """Positions (P, 3) [m] of pins that rest at ``pins`` (P, 3), turned to the facing, until a time ``start`` [s]."""
    shift = wander(np.array(swing.reach), swing.tempo, random)
    turn = wander(np.full(3, np.radians(swing.turn)), swing.tempo, random)
    middle = pins.mean(0)

    def place(time: float) -> np.ndarray:
        since = max(time - start, 0.0)
        eased = 1 - np.exp(-((since / 0.25) ** 3))
        heading = about_vertical(np.degrees(eased * turn(since)[1]))
        return (middle + (pins - middle) @ heading.T + eased * shift(since)) @ about_vertical(swing.facing).T

    return place


def ball_path(swing: Swing, random: np.random.Generator) -> Path:
    """Centre (3,) [m] of a ball that swings through the lower half of the hanging cloth, from behind and back."""
    period, phase = random.uniform(1.1, 1.5), random.uniform(0.1, 0.3)
    height, side = random.uniform(0.1, 0.2), random.uniform(-0.06, 0.06)

    def centre(time: float) -> np.ndarray:
        depth = -0.15 + 0.15 * np.sin(2 * np.pi * (time / period - phase))
        return np.array([side, height, depth]) @ about_vertical(swing.facing).T

    return centre


def about_vertical(degrees: float) -> np.ndarray:
    """Rotation (3, 3) about the y axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
