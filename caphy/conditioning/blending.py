"""Offsets that die away, so that what is found again is approached and not jumped to.

In games this is called inertialization (Bollo, "Inertialization: High-Performance Animation Transitions in Gears of
War", GDC 2018).
"""

from __future__ import annotations

from typing import Final

import numpy as np

QUICK: Final = 16.0
"""Rate at which small offsets die away [1/s]: within 0.3 s."""


class Offsets:
    """Vectors (C, 3) that a value differs from what it should be; each falls to zero no faster than ``speed``."""

    def __init__(self, channels: int, speed: float) -> None:
        self._start = np.zeros((channels, 3))
        self._since = np.zeros(channels)
        self._rate = np.full(channels, QUICK)
        self._speed = speed

    def begin(self, chosen: np.ndarray, offsets: np.ndarray, time: float) -> None:
        """From ``time`` on, channels ``chosen`` (C,) have ``offsets`` (C, 3) to lose."""
        length = np.sqrt(np.einsum("ci,ci->c", offsets, offsets))
        rate = np.minimum(QUICK, self._speed * np.e / np.maximum(length, 1e-6))  # (1 + rt) e^-rt falls at r / e
        self._start = np.where(chosen[:, None], offsets, self._start)
        self._since = np.where(chosen, time, self._since)
        self._rate = np.where(chosen, rate, self._rate)

    def clear(self) -> None:
        """Nothing is left to lose."""
        self._start = np.zeros_like(self._start)

    def at(self, time: float) -> np.ndarray:
        """What is left (C, 3)."""
        phase = self._rate * np.maximum(time - self._since, 0)
        return ((1 + phase) * np.exp(-phase))[:, None] * self._start


def eased(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 with no velocity and no acceleration at both ends (Perlin 2002)."""
    share = np.clip(share, 0, 1)
    return share**3 * (10 + share * (6 * share - 15))
