"""Depth cameras round a person: what each sees of a scene by ray casting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.capture.paint import Print
from caphy.report.camera import Camera

RINGS = ((-25.0, 10), (0.0, 16), (25.0, 16), (50.0, 10), (75.0, 4))
"""Elevation [degrees] of each ring of cameras, and how many stand on it: 56 in all."""
DISTANCE = 2.2
"""Of the cameras from the person's middle [m]."""
FIELD_OF_VIEW = 52.0
"""Full angle across the shorter side of a picture [degrees]."""
GRAZING = np.cos(np.radians(78.0))
"""A surface seen at a flatter angle gives no depth."""
LIGHT = np.array([0.25, 0.85, 0.45]) / np.linalg.norm([0.25, 0.85, 0.45])


@dataclass(frozen=True, eq=False)
class Scene:
    """All surfaces of one still as one mesh."""

    vertices: np.ndarray
    """(V, 3) [m]."""
    faces: np.ndarray
    """(F, 3)."""
    labels: np.ndarray
    """Label of each face (F,) uint8."""
    rest: np.ndarray
    """Where each vertex lies in T-pose (V, 3) [m]: prints are looked up there."""
    colours: np.ndarray
    """Colour of each vertex (V, 3), used where a face's label has no print."""
    normals: np.ndarray
    """(V, 3)."""


@dataclass(frozen=True, eq=False)
class View:
    """What one camera saw, as images of H rows and W columns."""

    origin: np.ndarray
    """(3,) [m]."""
    axes: np.ndarray
    """(3, 3): right, up, forward."""
    pixel: float
    """Slope of one pixel: its width at 1 m depth."""
    depth: np.ndarray
    """Distance along ``forward`` (H, W) float32 [m]; 0 where nothing was seen."""
    colour: np.ndarray
    """(H, W, 3) float32 in 0 to 1."""
    label: np.ndarray
    """(H, W) uint8."""
    facing: np.ndarray
    """Cosine between the ray and the surface (H, W) float32."""


def camera_rings(centre: np.ndarray, turn: float = 0.0) -> list[Camera]:
    """The cameras of :data:`RINGS` round ``centre`` (3,) [m], each ring turned against the one below."""
    cameras = []
    for ring, (elevation, count) in enumerate(RINGS):
        for azimuth in np.arange(count) * 360 / count + turn + 11.0 * ring:
            a, e = np.radians(azimuth), np.radians(elevation)
            away = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
            cameras.append(Camera(centre + DISTANCE * away, centre, FIELD_OF_VIEW))
    return cameras


class Caster:
    """A scene ready for rays."""

    def __init__(self, scene: Scene, prints: Mapping[int, Print]) -> None:
        """``prints`` of the garments by the number of their label."""
        from caphy.report.render import embree_scene

        self.scene, self.prints = scene, prints
        self._embree = embree_scene(scene.vertices, scene.faces)

    def view(self, camera: Camera, size: tuple[int, int], random: np.random.Generator, noise: float) -> View:
        """What a camera of ``size`` (width, height) sees; depths have ``noise`` [m] where seen straight on."""
        width, height = size
        axes = np.stack(camera.axes())
        rays = camera.rays(width, height).astype(np.float32)
        origin = np.broadcast_to(np.asarray(camera.eye, np.float32), rays.shape)
        found = self._embree.run(np.ascontiguousarray(origin), rays, output=True)
        hit = np.flatnonzero(found["primID"] >= 0)
        face, u, v = found["primID"][hit], found["u"][hit], found["v"][hit]
        weights = np.stack([1 - u - v, u, v], axis=1)
        normal = self._mixed(self.scene.normals, face, weights)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        facing = -np.einsum("hc,hc->h", normal, rays[hit])
        colour = self._shaded(face, weights, normal * np.sign(facing)[:, None])
        facing = np.abs(facing)
        away = found["tfar"][hit] * (rays[hit] @ axes[2].astype(np.float32))
        away = away + noise / np.maximum(facing, 0.2) * random.normal(size=len(hit)) + 0.3 * noise * random.normal()
        seen = facing > GRAZING
        colour = colour * random.uniform(0.96, 1.04) + 0.01 * random.normal(size=colour.shape)

        def image(values: np.ndarray, dtype: type) -> np.ndarray:
            flat = np.zeros((height * width, *values.shape[1:]), dtype=dtype)
            flat[hit[seen]] = values[seen]
            return flat.reshape(height, width, *values.shape[1:])

        return View(
            np.asarray(camera.eye, dtype=np.float64),
            axes,
            2 * float(np.tan(np.radians(camera.field_of_view) / 2)) / min(width, height),
            image(away, np.float32),
            image(np.clip(colour, 0, 1), np.float32),
            image(self.scene.labels[face], np.uint8),
            image(facing, np.float32),
        )

    def _mixed(self, values: np.ndarray, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.einsum("hk,hkc->hc", weights, values[self.scene.faces[face]])

    def _shaded(self, face: np.ndarray, weights: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Colours (H, 3) under soft light from above."""
        colour = self._mixed(self.scene.colours, face, weights)
        label = self.scene.labels[face]
        for number, pattern in self.prints.items():
            here = label == number
            colour[here] = pattern.colours(self._mixed(self.scene.rest, face[here], weights[here]))
        return colour * (0.72 + 0.28 * np.maximum(normal @ LIGHT, 0))[:, None]
