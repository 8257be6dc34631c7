"""What comes out of a conditioner, and how it says what it did."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import numpy as np


class Did(IntFlag):
    """What was done to a frame; the numbers go over the wire."""

    NOTHING = 0
    """The pose was smoothed, as all are, and nothing else."""
    REJECTED = 1
    """A pose that came since the frame before was not used, or a joint of it."""
    HELD = 2
    """The body was not seen at this moment: it stays where it was."""
    RESTING = 4
    """It was not seen for long: it stands, or is on its way there."""
    LIMITED = 8
    """A joint was turned further than joints turn, and was brought back."""
    RESET = 16
    """The frame is no continuation of the one before: the garment begins anew, settled on this pose."""
    PART_HELD = 32
    """Some joints were not seen; those are held, or on their way to rest."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment at the model's rate.

    time: the moment that is shown [s], on the clock of the poses' time stamps. poses: (55, 3) axis-angle [rad].
    transl: (3,) [m]. did: what was done. notes: the same in words, with joints and reasons.
    """

    time: float
    poses: np.ndarray
    transl: np.ndarray
    did: Did = Did.NOTHING
    notes: tuple[str, ...] = ()


@dataclass
class Summary:
    """What was done over a whole stream so far: frames by :class:`Did`, and poses refused by reason."""

    received: int = 0
    emitted: int = 0
    frames: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)

    def add(self, frame: Frame) -> None:
        """Count a frame that went out."""
        self.emitted += 1
        self.frames.update(flag.name.lower() for flag in Did if flag in frame.did and flag.name)

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready dictionary."""
        return {
            "received": self.received,
            "emitted": self.emitted,
            "frames": dict(self.frames),
            "refused": dict(self.refused),
        }
