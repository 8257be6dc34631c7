"""What each explanation would do to the cloth: its force, drawn at the moment that is worst explained."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from caphy.diagnose.diagnosis import Diagnosis
from caphy.diagnose.outside import Outside
from caphy.diagnose.probes import STEADY, probe_places, probe_pushes
from caphy.diagnose.screen import Score
from caphy.effects.base import BodyState, Step
from caphy.effects.model import Model
from caphy.measure.mesh_body import MeshBody
from caphy.measure.scene import Scene
from caphy.measure.windows import StartStates
from caphy.refit.columns import extended, forces
from caphy.report.camera import Camera
from caphy.report.page.colours import error_colours
from caphy.report.page.compose import Picture
from caphy.report.render import Shape, render

SIDE = 300
"""Pixels of one picture."""
SHOWN = 6
"""Explanations that are drawn."""

_ARROWS = 90
_INK = (0.12, 0.12, 0.16)
_BODY = (0.80, 0.76, 0.72)


class Moment:
    """The cloth in the middle of the window that the model explains worst, of those that count."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        screen = diagnosis.search.screens[0]
        worst = int((screen.evidence.weight * screen.evidence.c).argmax())
        response = screen.responses[worst]
        self.frame = response.start + len(response.seen) // 2
        watched = diagnosis.study.watched[response.scene]
        self.scene, self.modes, self.model = watched.scene, watched.projection.modes, screen.model
        starts = StartStates(self.scene, self.scene.potential(screen.model))
        before, self.x, after = (torch.from_numpy(starts.positions(self.frame + k)) for k in (-1, 0, 1))
        fps = self.scene.measurement.fps
        self.time = self.frame / fps
        speed = 0.5 * fps * (after - before)
        self.step = Step(1 / fps, self.x - speed / fps, self.x, before, speed, self.time)
        self.body: BodyState | None = None
        if self.scene.motion is not None:
            self.body = self.scene.motion.state(self.time, self.x.numpy(), 1 / fps)

    def pressure(self, score: Score) -> np.ndarray:
        """Force per area (V, 3) [Pa] of an explanation at its first estimate."""
        columns = score.group.columns
        potential = self.scene.potential(extended(self.model, columns))
        gradient = forces(potential, columns, self.x, self.step, self.body).numpy()
        return -np.tensordot(score.change, gradient, 1) / potential.cloth.vertex_area[:, None]

    def flexible(self, found: Outside) -> np.ndarray:
        """Force per area (V, 3) [Pa] of the best probe."""
        name, change = found.best, found.change
        if found.beat is not None:
            phase = 2 * np.pi * found.beat * self.time
            name, change = STEADY, np.tensordot((np.cos(phase), np.sin(phase)), change.reshape(2, -1), 1)
        cloth = self.scene.potential(Model(1.0)).cloth
        pushes = probe_pushes(cloth, self.modes, self.x, self.step, self.body)[probe_places()[name]].numpy()
        return -np.tensordot(change, pushes, 1) / cloth.vertex_area[:, None]

    def picture(self, pressure: np.ndarray, caption: str) -> Picture:
        """The cloth coloured by the size of a force, with arrows along it."""
        size = np.linalg.norm(pressure, axis=1)
        largest = float(np.quantile(size, 0.98))
        points, faces = self.x.numpy(), self.scene.garment.faces
        reach = 0.12 * float(np.ptp(points, axis=0).max())
        arrows = _arrows(points, pressure * (reach / max(largest, 1e-300)), reach)
        shapes = [Shape(points, faces, error_colours(size, largest))]
        if arrows is not None:
            shapes.append(Shape(*arrows, _INK))
        shapes += _body(self.scene, self.time)
        camera = Camera.framing(points, azimuth=_face_on(points), elevation=12, margin=1.35)
        return Picture(_png(render(shapes, camera, (SIDE, SIDE))), f"{caption}: up to {largest:.2g} Pa", self.frame)


def force_pictures(diagnosis: Diagnosis) -> list[Picture]:
    """The forces of the best explanations, and of the best flexible force where none of them is the answer."""
    moment = Moment(diagnosis)
    pictures = []
    if diagnosis.depends_on is not None:
        found = diagnosis.outside
        pictures.append(moment.picture(moment.flexible(found), f"by {found.best}"))
    scores = {score.group.label: score for score in diagnosis.search.screens[0].scores}
    for best in diagnosis.ranking[: SHOWN - len(pictures)]:
        score = scores[best.label]
        pressure = moment.pressure(score)
        if pressure.any():
            pictures.append(moment.picture(pressure, score.group.label.replace("_", " ").replace(".", ": ")))
    return pictures


def _arrows(points: np.ndarray, vectors: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Slender pyramids (V, 3), (F, 3) from evenly chosen points along vectors [m], shortened to ``reach``."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors = vectors * np.minimum(1, reach / np.maximum(length, 1e-300))
    chosen = np.unique(np.linspace(0, len(points) - 1, _ARROWS).round().astype(int))
    chosen = chosen[np.linalg.norm(vectors[chosen], axis=1) > 0.05 * reach]
    if not len(chosen):
        return None
    along = vectors[chosen] / np.linalg.norm(vectors[chosen], axis=1, keepdims=True)
    across = np.cross(along, np.where(np.abs(along[:, :1]) < 0.7, (1.0, 0, 0), (0, 1.0, 0)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sides = (across, np.cross(along, across))
    width = 0.06 * reach
    base = [points[chosen] + width * (np.cos(a) * sides[0] + np.sin(a) * sides[1]) for a in 2.1 * np.arange(3)]
    corners = np.stack([*base, points[chosen] + vectors[chosen]], axis=1)  # (n, 4, 3)
    faces = np.array([(0, 1, 3), (1, 2, 3), (2, 0, 3), (2, 1, 0)])
    return corners.reshape(-1, 3), (4 * np.arange(len(chosen))[:, None, None] + faces).reshape(-1, 3)


def _body(scene: Scene, time: float) -> Sequence[Shape]:
    if isinstance(scene.motion, MeshBody):
        return [Shape(scene.motion.vertices(time), scene.motion.faces, _BODY)]
    if scene.motion is None:
        return []
    return [Shape(scene.motion.vertices(np.array([time]))[0], scene.motion.body.faces, _BODY)]


def _face_on(points: np.ndarray) -> float:
    """Azimuth [degrees] from which the cloth shows the largest side, a little turned."""
    flat = (points - points.mean(axis=0))[:, [0, 2]]
    side = np.linalg.eigh(flat.T @ flat)[1][:, 0]
    return float(np.degrees(np.arctan2(*(side * np.sign(side[1] or 1.0))))) + 20


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
