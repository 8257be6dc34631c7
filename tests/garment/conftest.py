"""Garments are made once per session: six families on two bodies."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from caphy.body.bundled import default_body
from caphy.garment.families import FAMILIES, make
from caphy.garment.landmarks import Landmarks

SHAPES = {"average": None, "other": np.array([1.0, -2.0, 2.0, -1.0])}


@pytest.fixture(scope="session")
def made():
    """``made(family, shape)``: the garment with default options and the landmarks of the body it was made on."""

    @cache
    def get(family: str, shape: str):
        body = default_body("medium")
        return make(FAMILIES[family](), body, SHAPES[shape]), Landmarks.of(body, SHAPES[shape])

    return lambda family, shape="average": get(family, shape)  # one key, whether the shape is given or not


@pytest.fixture
def strip():
    """A flat 4 x 8 strip of triangles: vertices (45, 3), faces (64, 3), standing upright, 0.4 m by 0.8 m."""
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.4, 0.4, 9))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.3)], axis=1)
    a = (np.arange(8)[:, None] * 5 + np.arange(4)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 6], 1), np.stack([a, a + 6, a + 5], 1)])
    return vertices, faces
