"""Where on the body the detector sees its landmarks: ``python -m benchmarks.monocular_landmarks FOLDER``.

Of the films and records that ``make bench-monocular`` left in FOLDER. For every landmark the offset from its place by
anatomy, fixed to the bone that carries it, that brings its projections nearest to where it was seen (least squares,
far ones counting less, left and right alike). Beside it what the offset would be without one of the motions, at most.
The client's numbers are in service/clients/monocular/skeleton.py; films that the client has seen are no test of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from benchmarks.monocular_clips import CLIPS
from benchmarks.monocular_film import HEIGHT, WIDTH
from caphy.conventions import BODY_JOINT_COUNT
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle, read_bundle
from caphy.rotations import matrix_from_axis_angle
from service.clients.monocular.landmarks import LANDMARKS
from service.clients.monocular.skeleton import Skeleton, seen_from_anatomy
from service.settings import BUNDLED_AVATARS

EVERY = 4
"""Pictures from one that counts to the next: neighbours err alike."""
NOISE, USUAL, FAR = 0.1, 0.04, 0.08
"""Spread of a landmark's error, spread of offsets, and where an error begins to count less [m]."""


@dataclass(frozen=True)
class Arguments:
    """Print the offsets."""

    folder: Annotated[Path, tyro.conf.Positional]
    """With *.record.npz and the films' truth."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Of one film: how projections (T, 33, 2, 3) move with offsets, what is missing (T, 33, 2) [m], trust (T, 33)."""

    slopes: np.ndarray
    missing: np.ndarray
    trust: np.ndarray


def main(arguments: Arguments) -> None:
    """Print one line for each landmark of the left side and the middle."""
    bundle = read_bundle(BUNDLED_AVATARS / "default")
    films = {clip: _films(arguments.folder, clip, bundle) for clip in CLIPS}
    found = offsets([film for several in films.values() for film in several])
    without = [offsets([film for c, several in films.items() if c != clip for film in several]) for clip in CLIPS]
    changes = abs(np.array(without) - found).max(axis=0)
    for name, offset, change in zip(LANDMARKS, 1e3 * found, 1e3 * changes, strict=True):
        if not name.startswith("right_"):
            print(
                f'"{name}": ({", ".join(f"{value:.0f}" for value in offset)}),  # {change.max():.0f} without a motion'
            )


def _films(folder: Path, clip: str, bundle: AvatarBundle) -> list[Seen]:
    paths = sorted(folder.glob(f"{clip.replace(' ', '_')}-*.record.npz"))
    if not paths:
        raise CaphyError(f"{folder}: holds no record of {clip!r}; make bench-monocular writes them")
    return [_seen(path, path.with_name(path.name.replace(".record", "")), bundle) for path in paths]


def _seen(record_path: Path, truth_path: Path, bundle: AvatarBundle) -> Seen:
    with np.load(record_path) as record, np.load(truth_path) as truth:
        count = min(len(record["time"]), len(truth["poses"]))
        kept = [t for t in range(0, count, EVERY) if np.isfinite(record["pixels"][t]).all()]
        axes, focal = truth["axes"], float(truth["focal"])
        rotations = matrix_from_axis_angle(truth["poses"][kept, :BODY_JOINT_COUNT])
        rotations[:, 0] = axes @ rotations[:, 0]
        roots = (truth["transl"][kept] + bundle.joints[0] - truth["eye"]) @ axes.T
        places = (record["pixels"][kept] - np.array([WIDTH, HEIGHT]) / 2) / focal
        trust = record["visibility"][kept].clip(0.03, 1)
    skeleton = Skeleton.of(bundle.joints)
    sites = skeleton.sites - seen_from_anatomy()
    anatomy = Skeleton(skeleton.joints, skeleton.parents, sites, skeleton.carrier, skeleton.above)
    posed = [anatomy.posed(*pose) for pose in zip(rotations, roots, strict=True)]
    turned = np.array([turns[skeleton.carrier] for turns, _, _ in posed])
    points = np.array([points for _, _, points in posed])
    slopes = turned[:, :, :2] - places[..., None] * turned[:, :, 2:]
    return Seen(slopes, places * points[..., 2:] - points[..., :2], trust)


def offsets(films: list[Seen]) -> np.ndarray:
    """Offsets (33, 3) of all landmarks [m], those of the middle without a left or right."""
    found = np.zeros((len(LANDMARKS), 3))
    for landmark, name in enumerate(LANDMARKS):
        if name.startswith("right_"):
            continue
        twin = LANDMARKS.index(name.replace("left_", "right_"))
        matrix, vector = np.eye(3) / USUAL**2, np.zeros(3)
        for side, mirror in ((landmark, [1.0, 1.0, 1.0]), (twin, [-1.0, 1.0, 1.0])):
            for film in films:
                slopes, missing = film.slopes[:, side] * mirror, film.missing[:, side]
                far = np.linalg.norm(missing, axis=1) / FAR
                weights = film.trust[:, side] / np.maximum(1.0, far) / NOISE**2
                matrix += np.einsum("tia,tib,t->ab", slopes, slopes, weights)
                vector += np.einsum("tia,ti,t->a", slopes, missing, weights)
        found[landmark] = np.linalg.solve(matrix, vector)
        found[twin] = found[landmark] * [1.0 if twin == landmark else -1.0, 1.0, 1.0]
    return found


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
