"""Videos with known truth: the bundled body, dressed, filmed in a room while it does what motion capture recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.monocular_raster import rasterize
from benchmarks.monocular_room import room_picture
from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from caphy.report.render import vertex_normals

WIDTH, HEIGHT = 1280, 720
FOCAL = 1000.0
"""Focal length [pixels]: 65 degrees across the picture, a phone's main camera."""
_SAMPLES = 2
"""Pixels drawn for each pixel filmed, along each axis."""
_LIGHT = np.array([0.45, 0.75, 0.5]) / np.linalg.norm([0.45, 0.75, 0.5])
_AMBIENT = 0.62
_SKIN, _HAIR, _SHOE = (0.82, 0.60, 0.49), (0.16, 0.10, 0.07), (0.16, 0.15, 0.17)
_CLOTHES = {"tshirt": (0.70, 0.18, 0.17), "trousers": (0.17, 0.24, 0.42)}
_NOISE = 2.0
"""Sensor noise, standard deviation [of 255]."""


@dataclass(frozen=True, eq=False)
class Eye:
    """A pinhole camera in a room. position: (3,) [m]. axes: rows are right, down and forward in the world, (3, 3)."""

    position: np.ndarray
    axes: np.ndarray

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) [m] of the world in the camera: right, down, forward [m]."""
        return (points - self.position) @ self.axes.T

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Columns, rows [pixels] and depth [m], (..., 3), of points (..., 3) of the world."""
        seen = self.seen(points)
        middle = np.array([WIDTH, HEIGHT]) / 2
        return np.concatenate([FOCAL * seen[..., :2] / seen[..., 2:] + middle, seen[..., 2:]], axis=-1)


def eye_towards(target: np.ndarray, azimuth: float, height: float, distance: float, roll: float) -> Eye:
    """A camera ``height`` above the floor and ``distance`` away [m] at ``azimuth`` [degrees], rolled [degrees]."""
    a = np.radians(azimuth)
    position = np.array([target[0] + distance * np.sin(a), height, target[2] + distance * np.cos(a)])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    return Eye(position, np.stack([c * right + s * down, c * down - s * right, forward]))


@dataclass(frozen=True, eq=False)
class Figure:
    """The person: rest vertices (V, 3) [m] with hair and a painted face, faces, and colours (V, 3)."""

    rest: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    weights: np.ndarray

    @classmethod
    def bundled(cls) -> Figure:
        """The fine free body with hair, brows, eyes, lips and shoes."""
        body = default_body("fine")
        rest, normals = body.v_template.copy(), vertex_normals(body.v_template, body.faces)
        x, y, z = rest.T
        head = body.weights[:, JOINT_NAMES.index("head")] > 0.5
        speckle = np.random.default_rng(3).normal(0, 0.012, len(rest))
        colours = np.asarray(_SKIN) * (1 + speckle)[:, None]
        paint = [
            ((abs(y - 0.526) < 0.009) & (abs(x) < 0.028) & (z > 0.09) & head, (0.66, 0.32, 0.30)),
            ((abs(y - 0.604) < 0.006) & (abs(abs(x) - 0.031) < 0.016) & (z > 0.09) & head, (0.9, 0.9, 0.9)),
            ((abs(y - 0.604) < 0.006) & (abs(abs(x) - 0.031) < 0.006) & (z > 0.09) & head, (0.12, 0.08, 0.06)),
            ((abs(y - 0.623) < 0.005) & (abs(abs(x) - 0.033) < 0.021) & (z > 0.09) & head, _HAIR),
            (y < -0.915, _SHOE),
        ]
        for where, colour in paint:
            colours[where] = colour
        scalp = head & ((y > 0.655) | ((z < 0.035) & (y > 0.555) & (abs(x) < 0.077)) | ((z < 0.075) & (y > 0.63)))
        colours[scalp] = np.asarray(_HAIR) * (1 + 8 * speckle[scalp, None])
        rest[scalp] += 0.016 * normals[scalp]
        return cls(rest, body.faces, colours.clip(0, 1), body.weights)


class Film:
    """Draws frames of one dressed figure before one camera."""

    def __init__(self, eye: Eye, bundle: AvatarBundle, seed: int = 0) -> None:
        self.eye = eye
        self._figure = Figure.bundled()
        self._bundle = bundle
        self._random = np.random.default_rng(seed)
        columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        rays = np.stack([columns.ravel() - WIDTH / 2, rows.ravel() - HEIGHT / 2, np.full(columns.size, FOCAL)], axis=1)
        colours, depth = room_picture(eye.position, eye.axes, rays / FOCAL)
        self._small_room = colours.reshape(HEIGHT, WIDTH, 3).astype(np.float32)
        fine = WIDTH * _SAMPLES, HEIGHT * _SAMPLES
        self._room = cv2.resize(self._small_room, fine)
        self._depth = cv2.resize(depth.reshape(HEIGHT, WIDTH).astype(np.float32), fine)
        self._cloth_noise = {
            g.name: 1 + self._random.normal(0, 0.03, (len(g.mesh.vertices), 1)) for g in bundle.garments
        }

    def frame(self, transforms: np.ndarray, garments: dict[str, np.ndarray]) -> np.ndarray:
        """A picture (720, 1280, 3) uint8 BGR of joint transforms (55, 3, 4) and garment vertices (V, 3) [m]."""
        meshes = self._meshes(transforms, garments)
        points = np.concatenate([mesh[0] for mesh in meshes])
        counts = np.cumsum([0, *(len(mesh[0]) for mesh in meshes)])
        faces = np.concatenate([mesh[1] + start for mesh, start in zip(meshes, counts, strict=False)])
        normals = np.concatenate([vertex_normals(mesh[0], mesh[1]) for mesh in meshes])
        colours = np.concatenate([mesh[2] for mesh in meshes])
        lit = self._lit(points, faces, normals)
        box = self._box(points)
        image, depth = self._background(points, faces, box)
        corners = self.eye.pixels(points)
        corners[:, :2] = corners[:, :2] * _SAMPLES - [box[0] * _SAMPLES, box[1] * _SAMPLES]
        rasterize(corners, faces, (colours * lit[:, None]).astype(np.float32), depth, image)
        return self._exposed(image, box)

    def _meshes(self, transforms: np.ndarray, garments: dict[str, np.ndarray]) -> list:
        figure = self._figure
        blended = np.einsum("vj,jab->vab", figure.weights, transforms)
        posed = np.einsum("vab,vb->va", blended[..., :3], figure.rest) + blended[..., 3]
        meshes = [(posed, figure.faces, figure.colours)]
        for garment in self._bundle.garments:
            colour = np.asarray(_CLOTHES.get(garment.name, (0.3, 0.5, 0.35))) * self._cloth_noise[garment.name]
            meshes.append((garments[garment.name].astype(np.float64), garment.mesh.faces, colour.clip(0, 1)))
        return meshes

    def _lit(self, points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Light (V,) on the vertices: sky, a lamp with shadows, and light from the floor."""
        towards = self.eye.position - points
        normals = normals * np.where(np.einsum("vc,vc->v", normals, towards) < 0, -1.0, 1.0)[:, None]
        lamp = np.maximum(normals @ _LIGHT, 0) * self._open_to_lamp(points, faces)
        return _AMBIENT * (0.72 + 0.28 * normals[:, 1]) + 0.72 * lamp

    def _open_to_lamp(self, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Share (V,) of the lamp that reaches each vertex, by a shadow map of 5 mm."""
        across = np.cross(_LIGHT, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(_LIGHT, across)])
        flat = points @ axes.T
        flat = (flat - flat.min(axis=0)) / 0.005 + 2
        away = 10.0 - (points - points.mean(axis=0)) @ _LIGHT
        size = np.ceil(flat.max(axis=0)).astype(int) + 3
        depth = np.full((size[1], size[0]), 1e3, np.float32)
        rasterize(np.column_stack([flat, away]), faces, np.zeros((len(points), 1), np.float32), depth, depth[..., None])
        place = flat.astype(int)
        near = [depth[place[:, 1] + i, place[:, 0] + j] + 0.015 > away for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return np.mean(near, axis=0)

    def _box(self, points: np.ndarray) -> tuple[int, int, int, int]:
        """Left, top, right, bottom [pixels] of the part of the picture where the figure and its shadow are."""
        pixels = self.eye.pixels(np.concatenate([points, self._shadow(points)]))
        if (pixels[:, 2] < 0.2).any():
            raise CaphyError("the camera stands in the figure's way; move it back")
        low = np.clip(np.floor(pixels[:, :2].min(axis=0)).astype(int) - 20, 0, [WIDTH - 2, HEIGHT - 2])
        high = np.clip(np.ceil(pixels[:, :2].max(axis=0)).astype(int) + 20, low + 2, [WIDTH, HEIGHT])
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    @staticmethod
    def _shadow(points: np.ndarray) -> np.ndarray:
        return points - (points[:, 1:2] / _LIGHT[1]) * _LIGHT + [0.0, 0.002, 0.0]

    def _background(self, points: np.ndarray, faces: np.ndarray, box: tuple) -> tuple[np.ndarray, np.ndarray]:
        """Room and depth inside ``box`` at the finer resolution, with the figure's soft shadow on the floor."""
        left, top, right, bottom = (_SAMPLES * edge for edge in box)
        image = self._room[top:bottom, left:right].copy()
        depth = self._depth[top:bottom, left:right].copy()
        mask = np.zeros((*depth.shape, 1), np.float32)
        corners = self.eye.pixels(self._shadow(points))
        corners[:, :2] = corners[:, :2] * _SAMPLES - [left, top]
        rasterize(corners, faces, np.ones((len(points), 1), np.float32), depth.copy(), mask)
        soft = cv2.GaussianBlur(mask[..., 0], (0, 0), 5)
        return image * (1 - 0.45 * soft)[..., None], depth

    def _exposed(self, image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
        left, top, right, bottom = box
        frame = self._small_room.copy()
        frame[top:bottom, left:right] = cv2.resize(image, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        frame = cv2.GaussianBlur(255 * frame, (0, 0), 0.6)
        frame += self._random.normal(0, _NOISE, (HEIGHT, WIDTH, 1)).astype(np.float32)
        return np.rint(frame[..., ::-1].clip(0, 255)).astype(np.uint8)


def write_video(path: Path, frames: object, fps: float) -> None:
    """Write frames, an iterable of (720, 1280, 3) uint8 BGR, as mp4."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (WIDTH, HEIGHT))
    if not writer.isOpened():
        raise CaphyError(f"{path}: opencv cannot write mp4 here")
    for frame in frames:  # type: ignore[attr-defined]
        writer.write(frame)
    writer.release()
