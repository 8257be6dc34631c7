"""Frames in which a person was not detected."""

from __future__ import annotations

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.sequence import interpolate


def without_gaps(
    poses: np.ndarray, transl: np.ndarray, numbers: np.ndarray, where: str
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Poses (T, 55, 3) and translations (T, 3) of every frame from the first to the last of ``numbers`` (T,).

    Missing frames are interpolated and named in a note. Raises :class:`CaphyError` if the numbers do not rise, or
    more frames are missing than present.
    """
    if len(numbers) != len(poses) or np.any(np.diff(numbers) <= 0):
        raise CaphyError(f"{where}: frame numbers must rise, one for each of the {len(poses)} poses")
    every = np.arange(numbers[0], numbers[-1] + 1)
    missing = np.setdiff1d(every, numbers)
    if len(missing) == 0:
        return poses, transl, ()
    if len(missing) > len(poses):
        raise CaphyError(f"{where}: {len(missing)} frames are missing and only {len(poses)} present; cut it first")
    listed = ", ".join(map(str, missing[:5])) + ("..." if len(missing) > 5 else "")
    filled = interpolate(poses, transl, numbers, every)
    return *filled, (f"{len(missing)} frames were not detected and are interpolated: {listed}",)
