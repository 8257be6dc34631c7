"""Garments that begin anew in the middle of a motion: put on the body at rest in that pose, and not thrown onto it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from service.engine import GarmentEngine

SETTLE: Final = 30
"""Frames that a pose is held, unseen, before a garment is shown that begins with it: a second at 30 per second."""

Run = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def run_settling(
    engine: GarmentEngine,
    weights: bool,
    poses: np.ndarray,
    transl: np.ndarray,
    state: np.ndarray,
    settle: Sequence[int],
) -> tuple[np.ndarray, np.ndarray]:
    """As ``engine.run``, or ``engine.blend`` for ``weights``, beginning anew at each frame of ``settle``.

    The garment of such a frame comes from the first state and :data:`SETTLE` frames of the frame's own pose, so that
    nothing of the motion before is in it, neither its velocity nor the garment's memory.
    """
    run: Run = engine.blend if weights else engine.run
    starts = sorted({0, *settle} & set(range(len(poses))))
    shown = []
    for start, end in zip(starts, [*starts[1:], len(poses)], strict=True):
        if start in settle:
            pose, place = (np.repeat(array[start : start + 1], SETTLE, axis=0) for array in (poses, transl))
            state = run(pose, place, engine.initial_state())[1]
        part, state = run(poses[start:end], transl[start:end], state)
        shown.append(part)
    return (shown[0] if len(shown) == 1 else np.concatenate(shown)), state
