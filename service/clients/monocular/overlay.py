"""Clothes drawn over the picture they belong to."""

from __future__ import annotations

import cv2
import numpy as np

from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle, SkinnedMesh

COLOURS = ((150, 92, 52), (64, 140, 222), (96, 170, 110), (170, 110, 160))
"""BGR of the garments, innermost first."""
_BARE = ("neck", "head", "elbow", "wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")
_CELL = 0.03
"""Size of the body's faces that hide clothes [m]."""
_LIGHT = np.array([0.4, 0.7, 0.6]) / np.linalg.norm([0.4, 0.7, 0.6])
_FINE = 3
"""Bits of a pixel's fraction that opencv draws with."""


class Overlay:
    """Draws an avatar's garments as they would be seen; hands, forearms, head and feet before them stay visible.

    focal: [pixels]. size: width and height of the pictures [pixels].
    """

    def __init__(self, bundle: AvatarBundle, focal: float, size: tuple[int, int]) -> None:
        self._bundle, self._focal, self._size = bundle, focal, size
        self._body = _bare_parts(bundle.body)

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
        body = self._body.posed(self._bundle.transforms(poses[None], transl[None]))[0]
        meshes = [(body, self._body.faces, (0, 0, 0), 0)]
        for garment, colour in zip(self._bundle.garments, COLOURS * 4, strict=False):
            meshes.append((garments[garment.name], garment.mesh.faces, colour, 255))
        polygons, depths, colours = [], [], []
        for vertices, faces, colour, opacity in meshes:
            found = self._faces(np.asarray(vertices, np.float64) - origin, faces, turn)
            polygons.append(found[0])
            depths.append(found[1] - (0.0 if opacity else 0.01))  # skin lies on cloth's depth nearly: it wins
            shade = np.outer(found[2], colour)
            colours.append(np.column_stack([shade, np.full(len(shade), opacity)]))
        return self._painted(pixels, np.concatenate(polygons), np.concatenate(depths), np.concatenate(colours))

    def _faces(self, vertices: np.ndarray, faces: np.ndarray, turn: np.ndarray) -> tuple:
        """Corners (F, 3, 2) [pixels / 8], depth (F,) [m] and light (F,) of the faces that look at the camera."""
        seen = vertices @ turn  # the rows of turn are the world's axes in the camera
        points = self._focal * seen[:, :2] / np.maximum(seen[:, 2:], 0.05) + np.array(self._size) / 2
        corners = points[faces]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        ahead = seen[:, 2][faces].min(axis=1) > 0.1
        front = np.flatnonzero((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0) & ahead)
        triangles = vertices[faces[front]]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        light = 0.5 + 0.6 * np.maximum(normals @ _LIGHT, 0)
        return np.rint(corners[front] * 2**_FINE).clip(-(2**20), 2**20), seen[:, 2][faces[front]].mean(axis=1), light

    @staticmethod
    def _painted(pixels: np.ndarray, polygons: np.ndarray, depths: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """From far to near, then over the picture."""
        dressed = pixels.copy()
        size = np.array(pixels.shape[1::-1])
        corners = polygons.reshape(-1, 2) / 2**_FINE
        low, high = np.array([[0, 0], [0, 0]]) if not len(corners) else (corners.min(axis=0), corners.max(axis=0))
        low, high = np.clip([low - 2, high + 3], 0, size).astype(int)  # only this part is worked on
        if not (high > low).all():
            return dressed
        canvas = np.zeros((high[1] - low[1], high[0] - low[0], 4), np.uint8)
        order = np.argsort(-depths, kind="stable")
        paint = colours[order].clip(0, 255).tolist()
        for polygon, colour in zip((polygons[order] - low * 2**_FINE).astype(np.int32), paint, strict=True):
            cv2.fillConvexPoly(canvas, polygon, colour, cv2.LINE_8, _FINE)
        part = slice(low[1], high[1]), slice(low[0], high[0])
        smooth = cv2.blur(canvas, (2, 2)).astype(np.float32)
        share = smooth[..., 3:] / 255
        dressed[part] = (smooth[..., :3] + (1 - share) * dressed[part]).astype(np.uint8)
        return dressed


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
