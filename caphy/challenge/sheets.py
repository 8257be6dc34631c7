"""Meshes of the same square of cloth: the user's, and one that differs in every vertex but the corners."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from caphy.conventions import JOINT_COUNT
from caphy.garment.template import Garment
from caphy.garment.topology import edges

SIDE = 0.4
"""Side of the square [m]."""


def users_square(count: int = 17) -> Garment:
    """A regular grid of count^2 vertices, its diagonals alternating; it hangs in the plane z = 0, the warp upright."""
    u, v = np.meshgrid(np.linspace(0, SIDE, count), np.linspace(0, SIDE, count))
    flat = np.stack([u.ravel(), v.ravel()], 1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count + 1, corner + count
    even = ((corner // count + corner % count) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(even, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return _sheet(flat, np.concatenate([first, second]))


def other_square(edge: float = 0.0125) -> Garment:
    """An irregular mesh of the same square: a triangular lattice askew, evened out to meet an evenly spaced rim."""
    spaces = round(SIDE / edge)
    along = np.linspace(0, SIDE, spaces + 1)[:-1]
    rim = np.concatenate(
        [
            np.stack(pair, 1)
            for pair in (
                (along, 0 * along),
                (SIDE + 0 * along, along),
                (SIDE - along, SIDE + 0 * along),
                (0 * along, SIDE - along),
            )
        ]
    )
    i, j = np.meshgrid(np.arange(-2 * spaces, 2 * spaces), np.arange(-2 * spaces, 2 * spaces))
    lattice = edge * np.stack([(i + 0.5 * j).ravel(), np.sqrt(0.75) * j.ravel()], 1)
    lattice = lattice @ np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]]) + SIDE / 2
    inner = lattice[(np.abs(lattice - SIDE / 2) < SIDE / 2 - 0.6 * edge).all(1)]
    points = np.concatenate([rim, inner])
    for _ in range(20):
        pairs = edges(Delaunay(points).simplices)
        total, degree = np.zeros_like(points), np.bincount(pairs.ravel(), minlength=len(points))
        np.add.at(total, pairs, points[pairs[:, ::-1]])
        points[len(rim) :] = (total / degree[:, None])[len(rim) :]
    faces = Delaunay(points).simplices
    doubled = _cross(points[faces])
    faces = np.where(doubled[:, None] < 0, faces[:, ::-1], faces)[np.abs(doubled) > 1e-9]
    return _sheet(points, faces)


def corners(garment: Garment) -> np.ndarray:
    """The vertices of the two upper corners, left one first."""
    flat = garment.vertices[:, :2] + (SIDE / 2, 0)
    return np.array([np.linalg.norm(flat - place, axis=1).argmin() for place in ((0, SIDE), (SIDE, SIDE))])


def _cross(corner: np.ndarray) -> np.ndarray:
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _sheet(flat: np.ndarray, faces: np.ndarray) -> Garment:
    count, weights = len(flat), np.zeros((len(flat), JOINT_COUNT))
    weights[:, 0] = 1
    vertices = np.column_stack([flat[:, 0] - SIDE / 2, flat[:, 1], np.zeros(count)])
    return Garment(
        "square",
        vertices,
        faces.astype(np.int32),
        flat[faces],
        weights,
        np.full(count, "all"),
        np.zeros(count),
        np.zeros(count),
    )
