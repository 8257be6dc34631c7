"""Small scans of dressed bodies with the truth beside them, made without the code under test.

The bundled garments are carried onto a body of random shape and smooth random displacement, skinned to poses, blown up
by smooth random folds that never enter the body; what forty cameras round them see is sampled, with noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caphy.body.bundled import default_body, default_body_path
from caphy.body.model import BodyModel
from caphy.body.surface import Surface
from caphy.garment.template import Garment
from caphy.report.render import vertex_normals
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

GARMENTS = default_body_path().parent / "garments"
CAMERAS = 40


@dataclass
class Subject:
    """A person: body, clothes on it in T-pose, and how far its skin lies from the model's."""

    body: BodyModel
    betas: np.ndarray
    displacement: np.ndarray
    garments: list[Garment]

    def naked(self, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
        """True skin (T, V, 3)."""
        own = BodyModel(**{**vars(self.body), "v_template": self.body.v_template + self.displacement})
        return own.pose(poses, transl, self.betas)


@dataclass
class Sight:
    """What the cameras saw of one moment, and the truth of it."""

    points: np.ndarray
    normals: np.ndarray
    labels: np.ndarray
    pose: np.ndarray
    transl: np.ndarray
    skin: np.ndarray
    """True skin (V, 3)."""
    cloth: list[tuple[np.ndarray, np.ndarray]]
    """True garments: vertices (V, 3), faces (F, 3)."""


def smooth_field(points: np.ndarray, rng: np.random.Generator, wavelength: float, count: int = 24) -> np.ndarray:
    """A random field (N,) of standard deviation one over points (N, 3)."""
    waves = rng.standard_normal((count, 3)) * 2 * np.pi / wavelength / np.sqrt(3)
    phases = rng.uniform(0, 2 * np.pi, count)
    return np.sqrt(2 / count) * np.cos(points @ waves.T + phases).sum(axis=1)


def subject(
    seed: int, garments: tuple[str, ...] | list[Garment] = ("tshirt", "trousers"), resolution: str = "medium"
) -> Subject:
    """A random person in bundled or given garments (lying on the bundled body's mean shape)."""
    rng = np.random.default_rng(seed)
    body = default_body(resolution)
    betas = np.clip(rng.standard_normal(body.shapedirs.shape[2]), -1.5, 1.5)
    rest = body.rest(betas)[0]
    size = 0.004 * smooth_field(rest, rng, 0.25)
    displacement = np.clip(size, -0.008, 0.008)[:, None] * vertex_normals(rest, body.faces)
    mean, own = body.v_template, rest + displacement
    worn = []
    for name in garments:
        garment = name if isinstance(name, Garment) else Garment.load(GARMENTS / f"{name}.npz")
        near = Surface.of(body.faces, mean).nearest(garment.vertices, mean)
        corners = body.faces[near.face]
        moved = garment.vertices + np.einsum("nk,nkc->nc", near.barycentric, (own - mean)[corners])
        worn.append(Garment(**{**vars(garment), "vertices": moved}))
    return Subject(body, betas, displacement, worn)


def look(person: Subject, pose: np.ndarray, transl: np.ndarray, seed: int, count: int, noise: float = 0.001) -> Sight:
    """What is seen of a subject in pose (55, 3) [rad] at transl (3,): about ``count`` noisy points [m]."""
    rng = np.random.default_rng(seed)
    skin = person.naked(pose[None], transl[None])[0]
    transforms = person.body.transforms(pose[None], person.betas)[0]
    surface = Surface.of(person.body.faces, skin)
    meshes, cloth = [(skin, person.body.faces)], []
    for garment in person.garments:
        blend = np.tensordot(garment.weights, transforms, axes=1)
        vertices = np.einsum("vij,vj->vi", blend[..., :3], garment.vertices) + blend[..., 3] + transl
        folds = 0.006 * np.maximum(smooth_field(garment.vertices, rng, 0.1) + 1, 0)
        vertices = vertices + folds[:, None] * vertex_normals(vertices, garment.faces)
        for _ in range(2):
            near = surface.nearest(vertices, skin)
            vertices = vertices + np.maximum(0.004 - near.distance, 0)[:, None] * near.normal
        cloth.append((vertices, garment.faces))
        meshes.append(cloth[-1])
    points, normals, labels = sampled(meshes, rng, 3 * count)
    seen = visible(points, normals, meshes)
    kept = rng.permutation(np.flatnonzero(seen))[:count]
    points = points[kept] + noise * rng.standard_normal((len(kept), 3))
    return Sight(points, normals[kept], labels[kept], pose, transl, skin, cloth)


def sampled(meshes, rng, count):
    """About so many points, normals and numbers of the mesh (N,), spread evenly over meshes."""
    points, normals, labels = [], [], []
    areas = [np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) for v, f in meshes]
    total = sum(a.sum() for a in areas)
    for label, ((vertices, faces), area) in enumerate(zip(meshes, areas, strict=True)):
        face = rng.choice(len(faces), int(count * area.sum() / total), p=area / area.sum())
        share = rng.dirichlet(np.ones(3), len(face))
        points.append(np.einsum("nk,nkc->nc", share, vertices[faces[face]]))
        corner = np.einsum("nk,nkc->nc", share, vertex_normals(vertices, faces)[faces[face]])
        normals.append(corner / np.linalg.norm(corner, axis=1, keepdims=True))
        labels.append(np.full(len(face), label))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(labels)


def visible(points, normals, meshes):
    """Which points (N, 3) any of the cameras sees."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    for vertices, faces in meshes:
        TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    step = np.arange(CAMERAS) + 0.5
    height, angle = 1 - 1.6 * step / CAMERAS, np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - height**2)
    eyes = points.mean(axis=0) + 3 * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)
    seen = np.zeros(len(points), bool)
    for eye in eyes:
        ray = eye - points
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        todo = np.flatnonzero(~seen & ((ray * normals).sum(axis=1) > 0.15))
        start = (points[todo] + 1e-4 * normals[todo]).astype(np.float32)
        seen[todo] = scene.run(start, ray[todo].astype(np.float32), query="OCCLUDED") != 0
    return seen


def disturbed(pose: np.ndarray, degrees: float, rng: np.random.Generator) -> np.ndarray:
    """A pose (55, 3) [rad] with every body joint turned by ``degrees`` about a random axis."""
    axis = rng.standard_normal((22, 3))
    axis *= np.radians(degrees) / np.linalg.norm(axis, axis=1, keepdims=True)
    turned = matrix_from_axis_angle(pose)
    turned[:22] = turned[:22] @ matrix_from_axis_angle(axis)
    return axis_angle_from_matrix(turned)


def mocap(folder: Path, count: int, seed: int) -> np.ndarray:
    """Poses (count, 55, 3) [rad] drawn from all clips of a folder."""
    from caphy.io.poses import read_poses

    files = sorted((folder / "cmu_mocap" / "bvh_from_expmap").glob("*.bvh"))
    rng = np.random.default_rng(seed)
    picked = []
    for i in range(count):
        clip = read_poses(files[i % len(files)]).poses
        picked.append(clip[rng.integers(len(clip) // 10, len(clip))])
    return np.stack(picked)
