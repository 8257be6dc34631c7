"""Which frames each of many parallel streams plays, window by window: a pure function of the seed."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from caphy.network.features import as_first_frames, as_held
from caphy.training.motions import Motions

WINDOW = 5
"""Poses per window: gradients flow through this many frames (CaPhy, section 4.1)."""
SCORED = 2
"""Frames of a window whose potential is taken, at random: neighbouring frames say almost the same."""
LONGEST = 24
"""Most windows a stream plays before it starts anew elsewhere."""
HELD_SHARE = 0.15
"""Share of segments that hold one pose."""
HELD_WINDOWS = 3
"""Windows for which a pose is held."""


@dataclass(frozen=True)
class Segment:
    """A stretch that one stream plays from a cold start."""

    first: int
    """Its first frame among those of :class:`Motions`; the frame before it is of the same clip, unless held."""
    windows: int
    held: bool
    """One pose is held throughout."""


@dataclass(frozen=True)
class Windows:
    """One window of each of B streams.

    frames (B, 5) indices into :class:`Motions`; before (B,) the frame preceding the window; fresh (B,) true where the
    stream starts with this window; held (B,) true where a pose is held; scored (B, K) the places in the window, 0 to 4,
    whose potential is taken.
    """

    frames: np.ndarray
    before: np.ndarray
    fresh: np.ndarray
    held: np.ndarray
    scored: np.ndarray

    def __getitem__(self, rows: slice) -> Windows:
        """Some of the streams."""
        return Windows(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def still(self) -> np.ndarray:
        """Where nothing moves in a scored frame (B, K): poses that are held, and a stream's first frame."""
        return self.held[:, None] | (self.fresh[:, None] & (self.scored == 0))

    def features(self, motions: Motions) -> Tensor:
        """What the network sees, (B, T, D)."""
        seen = motions.features[self.frames]
        fresh, held = (torch.as_tensor(flag)[:, None, None] for flag in (self.fresh, self.held))
        return torch.where(held, as_held(seen), torch.where(fresh, as_first_frames(seen), seen))


def segment(motions: Motions, seed: int, stream: int, number: int) -> Segment:
    """The ``number``-th segment of a stream. Long clips are drawn more often, by the root of their length."""
    random = np.random.default_rng([seed, stream, number])
    lengths = np.diff(motions.starts)
    share = np.sqrt(lengths)
    clip = int(random.choice(len(lengths), p=share / share.sum()))
    start, length = int(motions.starts[clip]), int(lengths[clip])
    if random.random() < HELD_SHARE or length < WINDOW + 1:
        return Segment(start + int(random.integers(length)), HELD_WINDOWS, True)
    windows = int(random.integers(1, min(LONGEST, (length - 1) // WINDOW) + 1))
    return Segment(start + 1 + int(random.integers(length - WINDOW * windows)), windows, False)


class Streams:
    """B streams, each playing segments one after another.

    The place of every stream is two numbers, so it is saved and restored exactly, and any share of the streams can be
    played by any process.
    """

    def __init__(self, motions: Motions, count: int, seed: int) -> None:
        self.motions, self.seed = motions, seed
        self.place = np.zeros((count, 2), dtype=np.int64)
        """Segment under way, and windows of it already played, of each stream."""
        self._segments = [segment(motions, seed, stream, 0) for stream in range(count)]

    def restore(self, place: np.ndarray) -> None:
        """Continue from a saved :attr:`place` (B, 2)."""
        self.place = place.copy()
        self._segments = [segment(self.motions, self.seed, i, int(n)) for i, n in enumerate(place[:, 0])]

    def advance(self) -> Windows:
        """The next window of every stream."""
        for i, current in enumerate(self._segments):
            if self.place[i, 1] == current.windows:
                self.place[i] = self.place[i, 0] + 1, 0
                self._segments[i] = segment(self.motions, self.seed, i, int(self.place[i, 0]))
        played = self.place[:, 1].copy()
        self.place[:, 1] += 1
        first = np.array([s.first for s in self._segments])
        held = np.array([s.held for s in self._segments])
        stride = np.where(held, 0, 1)
        frames = first[:, None] + stride[:, None] * (played[:, None] * WINDOW + np.arange(WINDOW))
        return Windows(frames, frames[:, 0] - stride, played == 0, held, self._scored())

    def _scored(self) -> np.ndarray:
        random = (np.random.default_rng([self.seed, i, *place, 1]) for i, place in enumerate(self.place))
        return np.stack([r.permutation(WINDOW)[:SCORED] for r in random])
