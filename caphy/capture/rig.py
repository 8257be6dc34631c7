"""The rig: a subject in many poses, each draped, photographed, fused and written, with the truth in a folder apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from caphy.capture.cameras import Caster, Scene, camera_rings
from caphy.capture.drape import Dresser
from caphy.capture.fusion import Fused, fuse
from caphy.capture.optics import Optics
from caphy.capture.paint import body_colours, random_prints
from caphy.capture.subject import Subject
from caphy.io.poses import PoseSequence
from caphy.report.render import vertex_normals

LABELS = {"body": 0, "upper": 1, "lower": 2}
"""Numbers of the labels in what is written."""


class Rig:
    """One subject before the cameras."""

    def __init__(self, subject: Subject, poses: PoseSequence, optics: Optics, seed: int, dresser: Dresser) -> None:
        self.subject, self.poses, self.optics, self.seed, self.dresser = subject, poses, optics, seed, dresser
        random = np.random.default_rng([seed, 4])
        self._skin = body_colours(subject.body, random)
        self._prints = random_prints(random, list(subject.garments))

    def still(self, index: int) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, Any]]:
        """Body vertices (B, 3), garments' vertices by label (V, 3) [m] in pose ``index``, and how the solver fared."""
        body = self.subject.body.pose(self.poses.poses[index : index + 1], self.poses.transl[index : index + 1])[0]
        cloth, report = self.dresser.dressed(index)
        return body, cloth, report

    def scan(self, index: int, body: np.ndarray, cloth: dict[str, np.ndarray]) -> Fused:
        """What the cameras make of a still."""
        random = np.random.default_rng([self.seed, 5, index])
        scene = self._scene(body, cloth)
        prints = {LABELS[label]: pattern for label, pattern in self._prints.items()}
        caster = Caster(scene, prints)
        centre = (scene.vertices.min(axis=0) + scene.vertices.max(axis=0)) / 2
        views = [
            caster.view(camera, self.optics.pixels, random, self.optics.noise)
            for camera in camera_rings(centre, random.uniform(0, 360))
        ]
        return fuse(views, self.optics.voxel, self.optics.noise, self.optics.dropouts, random)

    def _scene(self, body: np.ndarray, cloth: dict[str, np.ndarray]) -> Scene:
        meshes = [(body, self.subject.body.faces, self.subject.body.v_template, self._skin, LABELS["body"])]
        for label, vertices in cloth.items():
            garment = self.subject.garments[label]
            meshes.append((vertices, garment.faces, garment.vertices, np.zeros((len(vertices), 3)), LABELS[label]))
        starts = np.cumsum([0, *(len(mesh[0]) for mesh in meshes)])
        return Scene(
            vertices=np.concatenate([mesh[0] for mesh in meshes]),
            faces=np.concatenate([mesh[1] + start for mesh, start in zip(meshes, starts, strict=False)]),
            labels=np.concatenate([np.full(len(mesh[1]), mesh[4], np.uint8) for mesh in meshes]),
            rest=np.concatenate([mesh[2] for mesh in meshes]),
            colours=np.concatenate([mesh[3] for mesh in meshes]),
            normals=np.concatenate([vertex_normals(mesh[0], mesh[1]) for mesh in meshes]),
        )
