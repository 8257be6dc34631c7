"""Mean and covariance of body joint rotations over motion clips: what the pose prior knows.

    python -m caphy.register.pose_statistics CLIP... -o pose_statistics.npz

Each clip counts alike, and each pose together with its mirror image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES
from caphy.garment.template import read_npz, write_npz

PATH = Path(__file__).parent.parent / "data" / "pose_statistics.npz"
"""The bundled statistics: 26 clips of the CMU motion capture database, retargeted."""
FRAMES_A_CLIP = 200
NAMES = JOINT_NAMES[1:BODY_JOINT_COUNT]


@dataclass(frozen=True, eq=False)
class PoseStatistics:
    """Of the rotation vectors of the 21 body joints below the pelvis."""

    mean: np.ndarray
    """(63,) [rad]."""
    covariance: np.ndarray
    """(63, 63) [rad^2]."""

    @classmethod
    def over(cls, clips: Iterable[np.ndarray]) -> PoseStatistics:
        """Of poses (T, 55, 3) [rad], one array for each clip."""
        rows = []
        for poses in clips:
            kept = np.linspace(0, len(poses) - 1, FRAMES_A_CLIP).astype(int)
            body = poses[kept, 1:BODY_JOINT_COUNT]
            rows += [body.reshape(len(kept), -1), mirrored(body).reshape(len(kept), -1)]
        sample = np.concatenate(rows)
        return cls(sample.mean(axis=0), np.cov(sample.T))

    @classmethod
    @lru_cache(maxsize=1)
    def bundled(cls) -> PoseStatistics:
        """Those that come with the package."""
        arrays = read_npz(PATH)
        return cls(arrays["mean"].astype(np.float64), arrays["covariance"].astype(np.float64))


def mirrored(body: np.ndarray) -> np.ndarray:
    """Poses (..., 21, 3) [rad] with left and right exchanged: turns about y and z change sign."""
    swap = {"left": "right", "right": "left"}
    twins = [
        NAMES.index(name.replace(side, swap[side])) if (side := name.split("_")[0]) in swap else place
        for place, name in enumerate(NAMES)
    ]
    return body[..., twins, :] * [1.0, -1.0, -1.0]


@dataclass(frozen=True)
class Options:
    """Which clips, and where to."""

    clips: tyro.conf.Positional[tuple[Path, ...]]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = PATH


def main(options: Options) -> None:
    """Write the statistics of pose files."""
    from caphy.io.poses import read_poses

    found = PoseStatistics.over(read_poses(clip).poses for clip in options.clips)
    source = f"{len(options.clips)} clips: {', '.join(clip.stem for clip in options.clips)}"
    arrays = {"mean": found.mean.astype(np.float32), "covariance": found.covariance.astype(np.float32)}
    write_npz(options.output, {**arrays, "source": np.array(source)})
    print(f"{options.output}: {source}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
