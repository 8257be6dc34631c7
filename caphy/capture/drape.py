"""Clothes at rest on a posed body, by the reference solver: worn into the pose on a coarse mesh, then on the fine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from caphy.body.surface import Surface, nearest_on_surface
from caphy.capture.subject import Subject
from caphy.effects.base import BodyState
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.report.render import vertex_normals
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import ImplicitEuler, State
from caphy.solve.newton import Newton
from caphy.solve.preroll import preroll_poses
from caphy.solve.rollout import Simulator
from caphy.solve.statics import drape

STEPS_PER_SECOND = 8.0
"""Of the way from the T-pose into the pose; implicit Euler damps what would swing."""
SETTLING = 3
"""Steps of a quarter second in which the coarse cloth comes to rest."""
ROUGH, FINE = 1e-2, 2e-6
"""Tolerances of the coarse way and of the final drape [N]. A fine vertex weighs about 5e-4 N, and a shirt that does not
rub on the skin slides by 5 mm after a hundredth of that is all that is left on any vertex."""
FEW, MANY = 8, 1000
"""Most Newton iterations of a step on the coarse way and of the final drape, which takes 50 to 600; a report says
where that was not enough."""
GAP = 0.002
"""Distance of the upper garment from the lower one where it lies on it [m]."""
FARTHEST = 0.04
"""Cloth farther than this outside the skin carries nothing [m]."""


@dataclass(eq=False)
class Worn:
    """One garment of a subject, prepared for the solver."""

    subject: Subject
    label: str

    @property
    def garment(self) -> Garment:
        """The fine mesh."""
        return self.subject.garments[self.label]

    @cached_property
    def fine(self) -> Newton:
        """Solver of the fine mesh."""
        return Newton(self._potential(self.garment), tolerance=FINE, max_iterations=MANY)

    @cached_property
    def rough(self) -> Newton:
        """Solver of the coarse mesh."""
        return Newton(self._potential(self.subject.rough[self.label]), tolerance=ROUGH, max_iterations=FEW)

    def _potential(self, garment: Garment) -> Potential:
        model = self.subject.fabrics[self.label].model
        return Potential(model, Cloth.of(garment, model.density))

    @cached_property
    def _place(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners (V, 3) and weights (V, 3) on the coarse mesh of each fine vertex, and its height above it (V,)."""
        rough = self.subject.rough[self.label]
        found = nearest_on_surface(self.garment.vertices, rough.vertices, rough.faces)
        return rough.faces[found.face], found.barycentric, found.distance

    def refined(self, rough: np.ndarray) -> np.ndarray:
        """Fine positions (V, 3) that follow coarse ones."""
        corners, weights, height = self._place
        normals = vertex_normals(rough, self.subject.rough[self.label].faces)
        point = np.einsum("vk,vkc->vc", weights, rough[corners])
        normal = np.einsum("vk,vkc->vc", weights, normals[corners])
        return point + height[:, None] * normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-9)


class Dresser:
    """Puts a subject's clothes on in any of some poses, the lower garment first."""

    def __init__(self, subject: Subject, poses: PoseSequence, simulate: bool = True) -> None:
        """Without ``simulate`` clothes just follow the skeleton."""
        self.subject, self.poses, self.simulate = subject, poses, simulate
        self.worn = {label: Worn(subject, label) for label in subject.garments}

    def dressed(self, index: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Garments' vertices by label (V, 3) [m] in pose ``index``, and by label how the solver ended."""
        still = self.poses[index : index + 1]
        cloth: dict[str, np.ndarray] = {}
        report: dict[str, Any] = {}
        for label, worn in self.worn.items():
            motion = BodyMotion(self.subject.body, still, worn.garment)
            if not self.simulate:
                cloth[label] = motion.anchors(np.zeros(1))[0]
                continue
            guess = worn.refined(_worn_in(worn, still))
            skin = self._under(motion.vertices(np.zeros(1))[0], cloth, guess)
            cloth[label], report[label] = _settled(worn, motion, skin, guess)
        return cloth, report

    def _under(self, skin: np.ndarray, cloth: dict[str, np.ndarray], above: np.ndarray) -> np.ndarray:
        """Body vertices (B, 3), raised to the clothes that are on already where the next one ``above`` comes near."""
        normals = vertex_normals(skin, self.subject.body.faces)
        height = np.zeros(len(skin))
        for label, vertices in cloth.items():
            height = np.maximum(height, _height(skin, normals, vertices, self.subject.garments[label].faces))
        if not height.any():
            return skin
        from scipy.spatial import KDTree

        height[KDTree(above).query(skin, distance_upper_bound=0.08)[0] > 0.07] = 0.0
        return skin + np.maximum(_even(height, self.subject.body.faces), height)[:, None] * normals


def _worn_in(worn: Worn, still: PoseSequence) -> np.ndarray:
    """Coarse positions (v, 3) after moving from the T-pose into a pose and settling there."""
    way = preroll_poses(still).resample(STEPS_PER_SECOND)
    motion = BodyMotion(worn.subject.body, way, worn.subject.rough[worn.label])
    x = torch.from_numpy(motion.anchors(np.zeros(1))[0].copy())
    state, simulator = State(0.0, x, torch.zeros_like(x)), Simulator(worn.rough, motion, ImplicitEuler())
    for _ in range(len(way) - 1):
        state, _ = simulator.advance(state, 1 / STEPS_PER_SECOND)
    for _ in range(SETTLING):
        state, _ = simulator.advance(state, 0.25)
    return state.x.numpy()


def _settled(worn: Worn, motion: BodyMotion, skin: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Positions (V, 3) of the fine mesh at rest on ``skin`` (B, 3), and how the solver ended."""
    surface = Surface.of(motion.body.faces, motion.body.v_template)
    anchor = torch.from_numpy(motion.anchors(np.zeros(1))[0].copy())

    def seen(x: torch.Tensor) -> BodyState:
        found = surface.nearest(x.numpy(), skin)
        return BodyState(
            torch.from_numpy(found.point), torch.from_numpy(found.normal), torch.zeros_like(anchor), anchor
        )

    x, report = drape(worn.fine, torch.from_numpy(guess), seen)
    return x.numpy(), {"converged": report.converged, "residual_N": report.residual, "iterations": report.iterations}


def _height(skin: np.ndarray, normals: np.ndarray, cloth: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """How far out (B,) [m] cloth lies over each body vertex, less what contact keeps anyway; 0 where there is none."""
    from caphy.report.render import embree_scene

    found = embree_scene(cloth, faces).run(
        np.ascontiguousarray(skin, dtype=np.float32), np.ascontiguousarray(normals, dtype=np.float32), output=True
    )
    over = (found["primID"] >= 0) & (found["tfar"] < FARTHEST)
    return np.where(over, np.maximum(found["tfar"] + GAP - 0.004, 0), 0)


def _even(height: np.ndarray, faces: np.ndarray, rounds: int = 3) -> np.ndarray:
    """Heights (B,) averaged with their neighbours', so that the raised surface has no cliffs."""
    for _ in range(rounds):
        total, count = height.copy(), np.ones(len(height))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            total += np.bincount(faces[:, a], height[faces[:, b]], len(height))
            count += np.bincount(faces[:, a], minlength=len(height))
        height = total / count
    return height
