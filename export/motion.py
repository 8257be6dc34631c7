"""A dressed motion: what every format for whole motions is written from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caphy.io.bundle import AvatarBundle, SkinnedMesh
from caphy.io.poses import PoseSequence
from service.engine import GarmentEngine


@dataclass(frozen=True, eq=False)
class DressedMotion:
    """An avatar over time.

    poses (T, 55, 3) [rad] and transl (T, 3) [m] at the bundle's frame rate, y up; vertices: (T, V, 3) [m] per garment,
    as the service answers them.
    """

    bundle: AvatarBundle
    poses: np.ndarray
    transl: np.ndarray
    vertices: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.poses)

    def meshes(self) -> Iterator[tuple[str, SkinnedMesh, np.ndarray]]:
        """Name, mesh at rest and vertices (T, V, 3) float32 [m] of the body and each garment."""
        posed = self.bundle.body.posed(self.bundle.transforms(self.poses, self.transl))
        yield "body", self.bundle.body, posed.astype(np.float32)
        for garment in self.bundle.garments:
            yield garment.name, garment.mesh, self.vertices[garment.name]


def dressed_motion(bundle: AvatarBundle, motion: PoseSequence) -> DressedMotion:
    """The avatar on a motion, resampled to its frame rate, root for root; raises CaphyError where the world is a
    camera's."""
    motion = motion.require_world().to_y_up().about(bundle.joints[0]).resample(bundle.fps)
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    vertices = {}
    for garment in bundle.garments:
        engine = GarmentEngine(garment)
        vertices[garment.name], _ = engine.run(poses, transl, engine.initial_state())
    return DressedMotion(bundle, poses, transl, vertices)
