"""A dressed motion as one animated GLB (glTF 2.0) that any viewer plays.

The body is a skinned mesh; each garment is a skinned mesh with morph targets, which glTF applies before skinning as
the network does, so the file shows the service's vertices within the tolerance it states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import caphy
from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle, SkinnedMesh
from caphy.report.render import CLOTH, SKIN, vertex_normals
from caphy.rotations import quaternion_from_axis_angle
from export.gltf import INDICES, VERTEX_DATA, Gltf
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
    gltf = Gltf(f"caphy {caphy.__version__}")
    gltf.document["asset"]["copyright"] = bundle.licence
    skin = _add_skeleton(gltf, bundle)
    animation = _Animation(gltf, len(poses), bundle.fps)
    animation.add_joints(poses, transl, bundle.joints[0])
    roots = [0, _add_mesh(gltf, "body", bundle.body, skin, colour=SKIN)]
    morphs = {}
    for garment, colour in zip(bundle.garments, CLOTH * len(bundle.garments), strict=False):
        if garment.name in vertices:
            morph = motion_morph(garment.mesh, transforms, vertices[garment.name], tolerance)
            roots.append(_add_mesh(gltf, garment.name, garment.mesh, skin, colour=colour, morph=morph))
            animation.add_weights(roots[-1], morph.weights)
            morphs[garment.name] = morph
    animation.finish()
    gltf.document["scene"] = gltf.add("scenes", {"name": bundle.name, "nodes": roots})
    errors = {name: morph.error for name, morph in morphs.items()}
    gltf.document["extras"] = {"worst_vertex_error_mm": {name: round(1e3 * e, 4) for name, e in errors.items()}}
    return AnimatedGlb(gltf.glb(), errors, {name: len(morph.targets) for name, morph in morphs.items()})


def _add_skeleton(gltf: Gltf, bundle: AvatarBundle) -> int:
    """The joints as nodes 0 to 54 at rest, and the skin that binds to them; returns the skin's index."""
    for joint, name in enumerate(JOINT_NAMES):
        parent = bundle.parents[joint]
        at = bundle.joints[joint] - (bundle.joints[parent] if parent >= 0 else 0)
        node: dict[str, Any] = {"name": name, "translation": at.tolist()}
        if children := np.flatnonzero(bundle.parents == joint).tolist():
            node["children"] = children
        gltf.add("nodes", node)
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(JOINT_NAMES), 1, 1))
    inverse[:, :3, 3] = -bundle.joints
    binding = gltf.accessor(inverse)
    return gltf.add("skins", {"joints": list(range(len(JOINT_NAMES))), "inverseBindMatrices": binding, "skeleton": 0})


def _add_mesh(
    gltf: Gltf,
    name: str,
    mesh: SkinnedMesh,
    skin: int,
    *,
    colour: tuple[float, float, float],
    morph: Morph | None = None,
) -> int:
    """A skinned mesh with its material, and morph targets if any; returns its node's index."""
    points = mesh.vertices if morph is None else morph.base
    normals = vertex_normals(mesh.vertices, mesh.faces) if morph is None else morph.base_normals
    indices = mesh.faces.astype(np.uint16 if len(points) < 65535 else np.uint32).ravel()
    primitive: dict[str, Any] = {
        "attributes": {
            **_points(gltf, points, normals),
            "JOINTS_0": gltf.accessor(mesh.joint_index, VERTEX_DATA),
            "WEIGHTS_0": gltf.accessor(mesh.joint_weight, VERTEX_DATA),
        },
        "indices": gltf.accessor(indices, INDICES),
        "material": _add_material(gltf, name, colour),
    }
    entry: dict[str, Any] = {"name": name, "primitives": [primitive]}
    if morph is not None and len(morph.targets):
        primitive["targets"] = [_points(gltf, *pair) for pair in zip(morph.targets, morph.target_normals, strict=True)]
        entry["weights"] = morph.weights[0].astype(np.float32).tolist()
        entry["extras"] = {"worst_vertex_error_mm": round(1e3 * morph.error, 4)}
    return gltf.add("nodes", {"name": name, "mesh": gltf.add("meshes", entry), "skin": skin})


def _points(gltf: Gltf, points: np.ndarray, normals: np.ndarray) -> dict[str, int]:
    return {
        "POSITION": gltf.accessor(points.astype(np.float32), VERTEX_DATA, bounds=True),
        "NORMAL": gltf.accessor(normals.astype(np.float32), VERTEX_DATA),
    }


def _add_material(gltf: Gltf, name: str, colour: tuple[float, float, float]) -> int:
    linear = [round(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4, 4) for c in colour]
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.9}
    return gltf.add("materials", {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True})


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
