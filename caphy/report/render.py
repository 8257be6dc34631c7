"""Pictures of meshes by ray casting (embreex), without a display or a graphics card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes
from caphy.report.camera import Camera

BACKGROUND = (0.97, 0.97, 0.98)
SKIN = (0.80, 0.66, 0.58)
CLOTH = ((0.30, 0.33, 0.42), (0.33, 0.52, 0.75), (0.78, 0.45, 0.35), (0.45, 0.62, 0.45))
"""Colours [sRGB, 0 to 1] for the body and for up to four garments, innermost first."""

_AMBIENT, _SHADOW = 0.35, 0.45
_LIGHT = np.array(
    [-0.45, 0.75, -0.75]
)  # direction towards the light as right, up, forward of the camera: over the shoulder
_SAMPLES = 2  # rays per pixel and axis


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh to picture."""

    vertices: np.ndarray
    """(V, 3) [m]."""
    faces: np.ndarray
    """(F, 3)."""
    colour: Any = SKIN
    """One sRGB colour (3,) in 0 to 1, or one per vertex (V, 3)."""


def render(
    shapes: Sequence[Shape],
    camera: Camera | None = None,
    size: tuple[int, int] = (512, 512),
    ground: float | None = None,
    shadows: bool = False,
) -> np.ndarray:
    """An image (height, width, 3) uint8 RGB of ``shapes``: diffuse shading, smooth normals, 2x2 rays per pixel.

    Args:
        camera: by default one in front of the body that frames everything.
        size: width and height [pixels].
        ground: height y [m] of a floor to draw under the shapes.
        shadows: cast shadows of the one light (a second ray per hit).

    Raises:
        CaphyError: embreex is not installed, or there is nothing finite to picture.
    """
    if not shapes or not all(np.isfinite(shape.vertices).all() for shape in shapes):
        raise CaphyError("render needs at least one mesh, and finite vertices in all of them")
    width, height = size
    points = np.concatenate([shape.vertices for shape in shapes])
    camera = camera or Camera.framing(points, aspect=width / height)
    if ground is not None:
        shapes = [*shapes, _floor(points, ground)]
    scene = _Scene(shapes)
    rays = camera.rays(width * _SAMPLES, height * _SAMPLES)
    light = _LIGHT @ np.stack(camera.axes())
    hit, colour = scene.shade(camera.eye, rays, light / np.linalg.norm(light), shadows)
    pixels = np.tile(np.asarray(BACKGROUND, dtype=np.float32), (len(rays), 1))
    pixels[hit] = colour
    samples = pixels.reshape(height, _SAMPLES, width, _SAMPLES, 3)
    pixels = np.einsum("hiwjc->hwc", samples) / _SAMPLES**2
    return np.rint(255 * pixels.clip(0, 1)).astype(np.uint8)


class _Scene:
    """Shapes merged into one ray-casting structure."""

    def __init__(self, shapes: Sequence[Shape]):
        counts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
        self.vertices = np.concatenate([shape.vertices for shape in shapes]).astype(np.float64)
        self.faces = np.concatenate([np.asarray(s.faces) + c for s, c in zip(shapes, counts, strict=False)])
        self.normals = np.concatenate([vertex_normals(s.vertices, s.faces) for s in shapes]).astype(np.float32)
        self.colours = np.concatenate(
            [np.broadcast_to(np.asarray(s.colour, dtype=np.float32), (len(s.vertices), 3)) for s in shapes]
        )
        self._embree = embree_scene(self.vertices, self.faces)

    def shade(
        self, eye: np.ndarray, rays: np.ndarray, light: np.ndarray, shadows: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Indices (H,) of the rays that hit something, and what they see (H, 3)."""
        origins = np.broadcast_to(eye, rays.shape).astype(np.float32)
        found = self._embree.run(np.ascontiguousarray(origins), rays.astype(np.float32), output=True)
        hit = np.flatnonzero(found["primID"] >= 0)
        corners = self.faces[found["primID"][hit]]
        u, v = found["u"][hit], found["v"][hit]
        weights = np.stack([1 - u - v, u, v]).astype(np.float32)
        normals = _interpolated(self.normals, corners, weights)
        normals /= np.sqrt(np.einsum("hc,hc->h", normals, normals))[:, None] + 1e-12
        facing = -np.einsum("hc,hc->h", normals, rays[hit])
        normals[facing < 0] *= -1  # the inside of cloth is lit like its outside
        lit = np.maximum(normals @ light, 0)
        if shadows:
            lit *= 1 - _SHADOW * self._shadowed(eye + rays[hit] * found["tfar"][hit, None], normals, light)
        fill = 0.5 + 0.5 * np.abs(facing)  # edges a little darker than middles
        shade = _AMBIENT * fill + (1 - _AMBIENT) * lit
        return hit, _interpolated(self.colours, corners, weights) * shade[:, None].astype(np.float32) * 1.15

    def _shadowed(self, points: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        origins = (points + 2e-3 * normals).astype(np.float32)
        towards = np.broadcast_to(light.astype(np.float32), origins.shape)
        return self._embree.run(origins, np.ascontiguousarray(towards), query="OCCLUDED") == 0


def _interpolated(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vertex values (V, 3) at hits with corners (H, 3) and weights (3, H)."""
    return np.einsum("kh,hkc->hc", weights, values[corners])


def embree_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A mesh of vertices (V, 3) [m] and faces (F, 3), ready for rays; raises CaphyError without the embreex package."""
    try:
        scene = import_module("embreex.rtcore_scene").EmbreeScene()
        mesh = import_module("embreex.mesh_construction").TriangleMesh
    except ModuleNotFoundError:
        raise CaphyError("pictures need the embreex package; install it with: pip install 'caphy[render]'") from None
    mesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (V, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [sum(np.bincount(faces[:, i], face_normals[:, axis], len(vertices)) for i in range(3)) for axis in range(3)],
        axis=-1,
    )
    return normals / (np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-30)


def _floor(points: np.ndarray, height: float) -> Shape:
    low, high = points.min(axis=0), points.max(axis=0)
    centre, reach = (low + high) / 2, 8 * max(high[0] - low[0], high[2] - low[2])
    corners = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], dtype=np.float64) * reach
    corners += [centre[0], height, centre[2]]
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]), (0.88, 0.88, 0.90))


def contact_sheet(images: Sequence[np.ndarray], columns: int, labels: Sequence[str] | None = None) -> np.ndarray:
    """Images (height, width, 3) of one size, row by row in ``columns`` columns, each with its label below."""
    import cv2

    strip = 0 if labels is None else 24
    height, width, _ = images[0].shape
    rows = -(-len(images) // columns)
    sheet = np.full((rows * (height + strip), columns * width, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        top, left = i // columns * (height + strip), i % columns * width
        sheet[top : top + height, left : left + width] = image
        if labels is not None:
            place = (left + 6, top + height + 17)
            cv2.putText(sheet, labels[i], place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
    return sheet


def write_png(image: np.ndarray, path: str | Path) -> Path:
    """Write an RGB image (height, width, 3) uint8 as PNG."""
    import cv2

    path = Path(path)
    done, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise CaphyError(f"{path}: this image cannot be written as PNG, shape {image.shape}, {image.dtype}")
    write_bytes(path, data.tobytes())
    return path
