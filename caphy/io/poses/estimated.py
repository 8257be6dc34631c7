"""What the readers of video estimators' results have in common: one person, seen in some of the frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caphy.io.poses.gaps import without_gaps
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import mean_betas, rest_pelvis


def estimated(
    path: Path,
    fps: float,
    poses: np.ndarray,
    transl: np.ndarray,
    numbers: np.ndarray,
    betas: np.ndarray | None,
    model: str = "smplx",
    notes: tuple[str, ...] = (),
) -> PoseSequence:
    """A person's motion, poses (T, 55, 3) [rad] and transl (T, 3) [m], without gaps and with one shape.

    numbers: (T,) of the frames in which the person was seen. betas: (T, B), if there are any. In the axes that it came
    in. Raises :class:`CaphyError` where frames' numbers do not rise, most are missing, or betas are not finite.
    """
    shape, varies = (None, ()) if betas is None else mean_betas(betas, str(path))
    pelvis, shaped = rest_pelvis(model, "neutral", shape)
    poses, transl, gaps = without_gaps(poses, transl, numbers, str(path))
    unseen = ~np.isin(np.arange(numbers[0], numbers[0] + len(poses)), numbers) if gaps else None
    return PoseSequence(
        unseen=unseen,
        poses=poses,
        transl=transl,
        fps=fps,
        source=str(path),
        betas=shape,
        model=model,
        pelvis=pelvis,
        notes=(*notes, *varies, *shaped, *gaps),
    )
