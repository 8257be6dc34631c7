"""Cloths and bodies simple enough for closed forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.effects.cloth import Cloth
from caphy.garment.template import Garment

DENSITY = 0.2


def grid(length: float, width: float, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, 2) of a sheet, warp (its second coordinate) along the length, and triangles (F, 3)."""
    u, v = np.meshgrid(np.linspace(0, width, rows), np.linspace(0, length, columns))
    index = np.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return np.stack([u, v], -1).reshape(-1, 2), faces.astype(np.int32)


@pytest.fixture
def sheet() -> Callable[..., Cloth]:
    """Maker of a flat cloth in the plane z = 0, its length along y."""

    def make(length: float, width: float, columns: int, rows: int) -> Cloth:
        flat, faces = grid(length, width, columns, rows)
        count = len(flat)
        vertices = np.column_stack([flat, np.zeros(count)])
        return Cloth(vertices, faces, flat[faces], DENSITY, np.zeros(count), np.zeros(count))

    return make


@pytest.fixture
def equilateral_strip() -> Callable[..., Cloth]:
    """Maker of a strip of equilateral triangles, rows of vertices ``height`` apart; it is isotropic in bending."""

    def make(columns: int, rows: int, height: float) -> Cloth:
        flat, faces = grid((columns - 1) * height, 1.0, columns, rows)
        odd = np.round(flat[:, 1] / height).astype(int) % 2
        edge = 2 * height / np.sqrt(3)
        flat[:, 0] = edge * (np.arange(len(flat)) % rows + 0.5 * odd)
        a, b, c, d = (np.concatenate([faces[: len(faces) // 2], faces[len(faces) // 2 :, 2:]], 1)).T
        turn = odd[a][:, None] == 1  # the short diagonal leans the other way in every other row
        faces = np.concatenate(
            [
                np.where(turn, np.stack([a, b, c], 1), np.stack([a, b, d], 1)),
                np.where(turn, np.stack([a, c, d], 1), np.stack([b, c, d], 1)),
            ]
        )
        zeros = np.zeros(len(flat))
        return Cloth(np.column_stack([flat, zeros]), faces, flat[faces], DENSITY, zeros, zeros)

    return make


@pytest.fixture
def box_body() -> BodyModel:
    """A box of 1 m x 0.4 m x 1 m whose top is the plane y = 0, moved by the root alone."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.4, 0.0) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)
    weights = np.zeros((8, JOINT_COUNT))
    weights[:, 0] = 1
    return BodyModel(
        v_template=corners,
        faces=faces,
        joints=np.zeros((JOINT_COUNT, 3)),
        weights=weights,
        parents=np.array(JOINT_PARENTS, dtype=np.int32),
        shapedirs=np.zeros((8, 3, 1)),
        joint_shapedirs=np.zeros((JOINT_COUNT, 3, 1)),
        expressiondirs=np.zeros((8, 3, 0)),
        joint_expressiondirs=np.zeros((JOINT_COUNT, 3, 0)),
    )


@pytest.fixture
def mat() -> Garment:
    """A horizontal square of 20 cm, 1 cm above the box's top."""
    flat, faces = grid(0.2, 0.2, 6, 6)
    count = len(flat)
    weights = np.zeros((count, JOINT_COUNT))
    weights[:, 0] = 1
    vertices = np.column_stack([flat[:, 0] - 0.1, np.full(count, 0.01), 0.1 - flat[:, 1]])
    return Garment(
        "mat", vertices, faces, flat[faces], weights, np.full(count, "mat"), np.zeros(count), np.zeros(count)
    )
