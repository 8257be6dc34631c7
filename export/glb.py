"""A dressed motion as one animated GLB (glTF 2.0) that any viewer plays.

The body is a skinned mesh; each garment is a skinned mesh with morph targets, which glTF applies before skinning as
the network does, so the file shows the service's vertices within the tolerance it states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from caphy.io.bundle import AvatarBundle
from caphy.report.avatar_glb import Morphs, add_mesh, start_avatar
from caphy.report.gltf import Gltf
from caphy.report.render import CLOTH, SKIN
from caphy.rotations import quaternion_from_axis_angle
from export.morph import Morph, motion_morph

TOLERANCE = 1e-4
"""Largest distance of a vertex from the service's [m]."""


@dataclass(frozen=True, eq=False)
class AnimatedGlb:
    """The file's bytes, and per garment the largest distance of a vertex [m] and the number of morph targets."""

    content: bytes
    errors: Mapping[str, float]
    targets: Mapping[str, int]


def animated_glb(
    bundle: AvatarBundle,
    poses: np.ndarray,
    transl: np.ndarray,
    vertices: Mapping[str, np.ndarray],
    tolerance: float = TOLERANCE,
) -> AnimatedGlb:
    """The motion of ``poses`` (T, 55, 3) [rad] and ``transl`` (T, 3) [m] at the bundle's frame rate.

    ``vertices`` are the garments' (T, V, 3) [m], as the service answers them.
    """
    transforms = bundle.transforms(poses, transl)
    gltf, skin = start_avatar(bundle)
    animation = _Animation(gltf, len(poses), bundle.fps)
    animation.add_joints(poses, transl, bundle.joints[0])
    roots = [0, add_mesh(gltf, "body", bundle.body, skin, colour=SKIN)]
    morphs = {}
    for garment, colour in zip(bundle.garments, CLOTH * len(bundle.garments), strict=False):
        if garment.name in vertices:
            morph = motion_morph(garment.mesh, transforms, vertices[garment.name], tolerance)
            roots.append(add_mesh(gltf, garment.name, garment.mesh, skin, colour=colour, morphs=_morphs(morph)))
            animation.add_weights(roots[-1], morph.weights)
            morphs[garment.name] = morph
    animation.finish()
    gltf.document["scene"] = gltf.add("scenes", {"name": bundle.name, "nodes": roots})
    errors = {name: morph.error for name, morph in morphs.items()}
    gltf.document["extras"] = {"worst_vertex_error_mm": {name: round(1e3 * e, 4) for name, e in errors.items()}}
    return AnimatedGlb(gltf.glb(), errors, {name: len(morph.targets) for name, morph in morphs.items()})


def _morphs(morph: Morph) -> Morphs:
    return Morphs(
        base=morph.base,
        base_normals=morph.base_normals,
        targets=morph.targets,
        target_normals=morph.target_normals,
        weights=morph.weights[0],
        extras={"worst_vertex_error_mm": round(1e3 * morph.error, 4)},
    )


class _Animation:
    """Samplers that share one time line, and their channels."""

    def __init__(self, gltf: Gltf, frames: int, fps: float) -> None:
        self._gltf = gltf
        self._times = gltf.accessor((np.arange(frames) / fps).astype(np.float32), bounds=True)
        self._entry: dict[str, Any] = {"name": "motion", "channels": [], "samplers": []}

    def add_joints(self, poses: np.ndarray, transl: np.ndarray, root: np.ndarray) -> None:
        """Rotations of the joints that turn at all, and the root's translation."""
        quaternions = quaternion_from_axis_angle(np.asarray(poses, np.float64))
        quaternions = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
        turned = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0
        sign = np.cumprod(np.concatenate([np.ones((1, turned.shape[1])), np.where(turned, -1, 1)]), axis=0)
        quaternions = (quaternions * sign[..., None])[..., [1, 2, 3, 0]]
        for joint in np.flatnonzero(np.any(poses != 0, axis=(0, 2))).tolist():
            self._add(joint, "rotation", quaternions[:, joint])
        self._add(0, "translation", root + np.asarray(transl, np.float64))

    def add_weights(self, node: int, weights: np.ndarray) -> None:
        """Morph target weights (T, R) of a mesh's node."""
        if weights.shape[1]:
            self._add(node, "weights", weights.ravel())

    def finish(self) -> None:
        """Put the animation into the document."""
        self._gltf.add("animations", self._entry)

    def _add(self, node: int, path: str, values: np.ndarray) -> None:
        sampler = {"input": self._times, "output": self._gltf.accessor(values.astype(np.float32))}
        self._entry["samplers"].append(sampler)
        target = {"node": node, "path": path}
        self._entry["channels"].append({"sampler": len(self._entry["samplers"]) - 1, "target": target})
