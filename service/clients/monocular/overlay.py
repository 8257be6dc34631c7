"""Clothes drawn over the picture they belong to."""

from __future__ import annotations

import cv2
import numpy as np

from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle, SkinnedMesh
from service.clients.monocular.raster import painted

COLOURS = ((150, 92, 52), (64, 140, 222), (96, 170, 110), (170, 110, 160))
"""BGR of the garments, innermost first."""
_BARE = ("neck", "head", "elbow", "wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")
_CELL = 0.03
"""Size of the body's faces that hide clothes [m]."""
_SKIN = 0.01
"""Skin lies on cloth's depth nearly: so much nearer it is taken to be [m]."""
_LIGHT = np.array([0.4, 0.7, 0.6]) / np.linalg.norm([0.4, 0.7, 0.6])
_NEAREST = 0.1
"""What is nearer to the camera is not drawn [m]."""


class Overlay:
    """Draws an avatar's garments as they would be seen; hands, forearms, head and feet before them stay visible.

    focal: [pixels]. size: width and height of the pictures [pixels].
    """

    def __init__(self, bundle: AvatarBundle, focal: float, size: tuple[int, int]) -> None:
        self._bundle, self._focal, self._middle = bundle, focal, np.array(size)[:, None, None] / 2
        self._body = _bare_parts(bundle.body)
        self._weights, self._rest = self._body.dense_weights(), self._body.vertices.astype(np.float64)
        meshes = [self._body, *(garment.mesh for garment in bundle.garments)]
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        self._corners = np.concatenate(faces).T.astype(np.intp)  # (3, F)
        self._mesh = np.repeat(np.arange(len(meshes)), [len(part) for part in faces])
        paints = [(0, 0, 0, 0), *((*COLOURS[i % len(COLOURS)], 255) for i in range(len(bundle.garments)))]
        self._paints = np.array(paints, np.float64)

    def draw(
        self,
        pixels: np.ndarray,
        poses: np.ndarray,
        transl: np.ndarray,
        garments: dict[str, np.ndarray],
        turn: np.ndarray,
        origin: np.ndarray,
    ) -> np.ndarray:
        """A copy of ``pixels`` (H, W, 3) BGR dressed in ``garments``, vertices (V, 3) [m] by name.

        poses: (55, 3) [rad] and transl: (3,) [m] of the body. turn: (3, 3) from the camera's axes to the world's.
        origin: (3,) where the camera stands in the world [m].
        """
        body = skin(blend_transforms(self._weights, self._bundle.transforms(poses[None], transl[None])), self._rest)[0]
        vertices = np.concatenate([body, *(garments[garment.name] for garment in self._bundle.garments)])
        polygons, paints = self._faces(turn.T @ (vertices - origin).T, turn)
        return _over(pixels, polygons, paints)

    def _faces(self, seen: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners (2, 3, F) [pixels] and BGRA (F, 4) of the faces that look at the camera, far to near.

        seen: (3, V) vertices in the camera's axes [m].
        """
        corners = seen.take(self._corners, axis=1)  # (3 axes, 3 corners, F)
        normals = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        looks = np.einsum("af,af->f", normals, corners[:, 0]) < 0
        front = np.flatnonzero(looks & (corners[2].min(axis=0) > _NEAREST))
        depth = corners[2].mean(axis=0)[front] - np.where(self._mesh[front] == 0, _SKIN, 0.0)
        front = front[np.argsort(-depth, kind="stable")]
        corners, normals = corners.take(front, axis=2), normals.take(front, axis=1)
        sizes = np.sqrt(np.einsum("af,af->f", normals, normals)) + 1e-12
        light = 0.78 + 0.34 * (_LIGHT @ turn @ normals / sizes)  # the dark side has shape too
        paints = self._paints[self._mesh[front]] * np.column_stack([light, light, light, np.ones_like(light)])
        return self._focal * corners[:2] / corners[2] + self._middle, paints


def _over(pixels: np.ndarray, polygons: np.ndarray, paints: np.ndarray) -> np.ndarray:
    """Polygons (2, 3, F) [pixels] of paints (F, 4) BGRA over a copy of a picture, the last one foremost.

    Every pixel is the mean of its four corners.
    """
    dressed = pixels.copy()
    if not len(paints):
        return dressed
    size = pixels.shape[1::-1]
    places = polygons.reshape(2, -1)
    low = np.floor(places.min(axis=1)).clip(0, size).astype(int)
    high = np.ceil(places.max(axis=1)).clip(0, size).astype(int)
    if not (high > low).all():
        return dressed
    width, height = (high - low).tolist()
    found = painted(polygons - low[:, None, None], (width + 1, height + 1))
    palette = np.concatenate([paints, np.zeros((1, 4))]).clip(0, 255).astype(np.uint8)  # the last one is -1: nothing
    corners = palette.view(np.uint32).ravel()[found].view(np.uint8).reshape(*found.shape, 4)
    smooth = cv2.blur(corners, (2, 2), anchor=(0, 0))[:height, :width]
    part = dressed[low[1] : high[1], low[0] : high[0]]
    behind = cv2.cvtColor(255 - smooth[..., 3], cv2.COLOR_GRAY2BGR)
    part[:] = cv2.add(cv2.multiply(part, behind, scale=1 / 255), cv2.cvtColor(smooth, cv2.COLOR_BGRA2BGR))
    return dressed


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (3, F) of vectors (3, F)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _bare_parts(body: SkinnedMesh) -> SkinnedMesh:
    """The body's parts that clothes leave bare, coarse: vertices of one cell of 3 cm become one."""
    carrier = body.joint_index[np.arange(len(body.vertices)), body.joint_weight.argmax(axis=1)]
    bare = np.array([any(part in JOINT_NAMES[joint] for part in _BARE) for joint in carrier])
    cells = np.floor(body.vertices / _CELL).astype(int)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = cell.reshape(-1)[body.faces[bare[body.faces].all(axis=1)]]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return SkinnedMesh(
        body.vertices[first],
        np.unique(faces[kept], axis=0).astype(np.int32),
        body.joint_index[first],
        body.joint_weight[first],
        np.zeros(len(first), np.uint8),
    )
