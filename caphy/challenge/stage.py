"""What a scene offers: a cloth as the user has it, the same cloth meshed otherwise, and motions to play."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from caphy.challenge.leapfrog import Drive
from caphy.effects.model import Model
from caphy.garment.template import Garment
from caphy.solve.integrators import State

FPS = 30.0
"""Of all measurements [Hz]."""

CALM = 15 / FPS
"""Time [s] in which cloth comes to rest under what is hidden, before anything moves."""
RUN_UP = 20 / FPS
"""Time in motion before the recording [s]."""

Part = Literal["train", "held_out", "base"]


@dataclass(frozen=True, eq=False)
class Play:
    """One motion of a scene.

    Attributes:
        part: what the measurement is for.
        number: place among the motions of its part.
        drive: what holds and moves the cloth; recording begins at time zero.
        start: state of the truth's cloth before it calms down, moves and is recorded; its time is negative.
        keys: the measurement's own keys about pins and body.
    """

    part: Part
    number: int
    drive: Drive
    start: State
    keys: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Stage:
    """A cloth and its motions.

    Attributes:
        name: of the scene.
        user: the cloth as the user has meshed it.
        truth: the same cloth on another mesh.
        model: what acts on it, and the user knows of.
        plays: the motions.
    """

    name: str
    user: Garment
    truth: Garment
    model: Model
    plays: tuple[Play, ...]
