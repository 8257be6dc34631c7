"""Many depth images into one mesh: a truncated signed distance field and its zero surface (Curless and Levoy 1996)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.capture.cameras import View
from caphy.errors import CaphyError
from caphy.jit import compiled

LEAST_VIEWS = 2
"""Cameras that must have seen a place for it to be part of the scan."""
TRUNCATION = 2.5
"""Distance behind a surface, in voxels, at which a camera stops to say anything."""
CONFIRMED = 1.0
"""Voxels that a vertex may lie from what a camera measured in its direction for the camera to confirm it.

Without it a fringe of up to the truncation would grow along every silhouette.
"""
SMALLEST = 0.005
"""Share of all faces that a loose piece must have to stay."""


@dataclass(frozen=True, eq=False)
class Fused:
    """One mesh out of all views: vertices (V, 3) [m], faces (F, 3), colours (V, 3) uint8, labels (V,) uint8."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    labels: np.ndarray


def fuse(views: list[View], voxel: float, noise: float, dropouts: int, random: np.random.Generator) -> Fused:
    """The scan of some views on a grid of ``voxel`` [m], with ``noise`` [m] and ``dropouts`` holes of 1 to 3 cm.

    The noise of many cameras averages out in fusion; what is left in real scans is correlated over about a voxel, so
    noise of the wanted size is added to the vertices and smoothed over neighbours once.

    Raises:
        CaphyError: no surface is left.
    """
    from skimage.measure import marching_cubes

    points = _some(np.concatenate([_points(view) for view in views]))
    low = points.min(axis=0) - 4 * voxel
    shape = tuple(np.ceil((points.max(axis=0) + 4 * voxel - low) / voxel).astype(int) + 1)
    near = _near_surface(points, low, voxel, shape)
    value, count = _field(views, near, low, voxel)
    grid, seen = np.full(shape, 1.0, np.float32), np.zeros(shape, bool)
    grid[tuple(near.T)], seen[tuple(near.T)] = value, count >= LEAST_VIEWS
    _some(np.flatnonzero(seen & (grid < 0)))
    vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=seen, gradient_direction="descent")
    faces = faces[_all_corners_seen(vertices, seen)[faces].all(axis=1)]
    vertices = vertices * voxel + low
    colours, labels, views_of = _painted(views, vertices, CONFIRMED * voxel)
    faces = _some(faces[(views_of >= LEAST_VIEWS)[faces].all(axis=1)])
    faces = _some(_without_holes_of_dropouts(vertices, faces, dropouts, random))
    used, faces = _without_crumbs(len(vertices), faces)
    _some(faces)
    vertices = vertices[used] + _noise(vertices[used], faces, noise, random)
    return Fused(vertices, faces.astype(np.int32), colours[used], labels[used])


def _some(parts: np.ndarray) -> np.ndarray:
    """Parts of a surface, as they are; raises where there are none."""
    if not len(parts):
        raise CaphyError("a scan must have a surface, and has none; ask for less noise, fewer dropouts, more pixels")
    return parts


def _points(view: View) -> np.ndarray:
    """World points (N, 3) of all pixels with depth."""
    row, column = np.nonzero(view.depth)
    height, width = view.depth.shape
    depth = view.depth[row, column].astype(np.float64)
    x = (column - (width - 1) / 2) * view.pixel * depth
    y = ((height - 1) / 2 - row) * view.pixel * depth
    return view.origin + np.stack([x, y, depth], axis=1) @ view.axes


def _near_surface(points: np.ndarray, low: np.ndarray, voxel: float, shape: tuple[int, ...]) -> np.ndarray:
    """Grid indices (N, 3) of voxels within three of a point."""
    from scipy.ndimage import binary_dilation

    grid = np.zeros(shape, dtype=bool)
    grid[tuple(np.rint((points - low) / voxel).astype(int).T)] = True
    return np.argwhere(binary_dilation(grid, np.ones((3, 3, 3), bool), iterations=3)).astype(np.int32)


def _field(views: list[View], near: np.ndarray, low: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance over the truncation (N,), positive in the open, and how many cameras spoke (N,)."""
    total, weight, count = np.zeros(len(near)), np.zeros(len(near)), np.zeros(len(near), np.int32)
    for view in views:
        _integrate(
            *(near, low, voxel, TRUNCATION * voxel, view.origin, view.axes, view.pixel, view.depth, view.facing),
            *(total, weight, count),
        )
    return np.where(weight > 0, total / np.maximum(weight, 1e-12), 1.0).astype(np.float32), count


@compiled()
def _integrate(
    near, low, voxel, reach, origin, axes, pixel, depth, facing, total, weight, count
):  # pragma: no cover - compiled
    height, width = depth.shape
    for i in range(len(near)):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(3):
            offset = low[k] + voxel * near[i, k] - origin[k]
            x += axes[0, k] * offset
            y += axes[1, k] * offset
            z += axes[2, k] * offset
        if z <= 0:
            continue
        column = int(np.round(x / z / pixel + (width - 1) / 2))
        row = int(np.round((height - 1) / 2 - y / z / pixel))
        if column < 0 or row < 0 or column >= width or row >= height or depth[row, column] == 0:
            continue
        gap = depth[row, column] - z
        cosine = facing[row, column]
        if gap * cosine < -reach:
            continue
        w = cosine * cosine
        total[i] += w * min(gap * cosine / reach, 1.0)
        weight[i] += w
        if gap * cosine < reach:
            count[i] += 1


def _all_corners_seen(vertices: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Whether the voxels on both ends of the edge that each vertex (V, 3) lies on were seen."""
    below, above = np.floor(vertices).astype(int), np.ceil(vertices).astype(int)
    return seen[tuple(below.T)] & seen[tuple(above.T)]


def _without_holes_of_dropouts(
    vertices: np.ndarray, faces: np.ndarray, dropouts: int, random: np.random.Generator
) -> np.ndarray:
    """Faces without those in a few balls where the scanner failed."""
    keep = np.ones(len(vertices), dtype=bool)
    for centre, radius in zip(
        random.choice(len(vertices), dropouts), random.uniform(0.01, 0.03, dropouts), strict=True
    ):
        keep &= np.linalg.norm(vertices - vertices[centre], axis=1) > radius
    return faces[keep[faces].all(axis=1)]


def _without_crumbs(count: int, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``count`` vertices stay, and the faces among them, without loose pieces below :data:`SMALLEST`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), (count, count))
    _, piece = connected_components(graph, directed=False)
    size = np.bincount(piece[faces[:, 0]], minlength=piece.max() + 1)
    faces = faces[size[piece[faces[:, 0]]] >= SMALLEST * len(faces)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return used, renumbered.reshape(-1, 3)


def _painted(views: list[View], vertices: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (V, 3) uint8 and true labels (V,) uint8 from the cameras that see each vertex, the straightest most.

    And how many cameras (V,) do: their depth there differs by less than ``reach`` [m].
    """
    views_of = np.zeros(len(vertices), dtype=int)
    colour, votes, weight = np.zeros((len(vertices), 3)), np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for view in views:
        offset = (vertices - view.origin) @ view.axes.T
        height, width = view.depth.shape
        column = np.rint(offset[:, 0] / offset[:, 2] / view.pixel + (width - 1) / 2).astype(int)
        row = np.rint((height - 1) / 2 - offset[:, 1] / offset[:, 2] / view.pixel).astype(int)
        inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        at = row[inside], column[inside]
        seen = np.abs(view.depth[at] - offset[inside, 2]) < reach
        at, inside = (at[0][seen], at[1][seen]), inside[seen]
        w = view.facing[at].astype(np.float64) ** 2
        colour[inside] += w[:, None] * view.colour[at]
        votes[inside, view.label[at]] += w
        weight[inside] += w
        views_of[inside] += 1
    colour /= np.maximum(weight, 1e-12)[:, None]
    return np.rint(255 * colour).astype(np.uint8), votes.argmax(axis=1).astype(np.uint8), views_of


def _noise(vertices: np.ndarray, faces: np.ndarray, size: float, random: np.random.Generator) -> np.ndarray:
    """Displacement (V, 3) [m] with standard deviation ``size`` in each coordinate, shared a little by neighbours."""
    white = random.normal(size=vertices.shape)
    total, count = white.copy(), np.ones(len(vertices))
    for a, b in ((0, 1), (1, 2), (2, 0)):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, a], white[faces[:, b], axis], len(vertices))
        count += np.bincount(faces[:, a], minlength=len(vertices))
    total /= count[:, None]
    return size * total / (total.std() + 1e-12)
