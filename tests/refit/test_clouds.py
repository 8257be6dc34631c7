"""What a cloud cannot show, where cloth lies along itself, does not count against a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import normals, simulate

from caphy.effects.model import Model
from caphy.io.measurements import Measurement
from caphy.measure.noise import MEDIAN_NORM, MEDIAN_ONE
from caphy.measure.scene import Scene
from caphy.refit.responses import Response, Watched
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
START = 8
MOVED = 0.003
"""How far measured cloth is moved [m]."""


@pytest.fixture(scope="module")
def film() -> tuple[np.ndarray, dict]:
    return simulate(seconds=1.2, settle=2.0)


def response(film: tuple[np.ndarray, dict], slides: bool, along: float = 0.0, across: float = 0.0) -> Response:
    """The window at :data:`START`, of a film whose cloth is moved along and across itself after the window's start."""
    positions, keys = film
    normal = normals(positions, keys["faces"])
    sideways = np.cross(normal, [0.0, 1.0, 0.3])
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    moved = positions + along * sideways + across * normal
    moved[: START + 3] = positions[: START + 3]  # which the start is read from
    scene = replace(Scene.of(Measurement(name="film", fps=30, vertices=moved, **keys)), slides=slides)
    return next(Watched(scene).respond(MODEL, (), [START]))


def test_what_lies_along_the_cloth_counts_where_it_was_measured_alone(film):
    plain, known = response(film, False), response(film, True)
    late = slice(3, None)
    for slides, before in ((False, plain), (True, known)):
        along, across = response(film, slides, along=MOVED), response(film, slides, across=MOVED)
        changes = [np.linalg.norm((r.residual - before.residual)[late]) for r in (along, across)]
        assert changes[1] > 5e-3
        assert (changes[0] < 0.15 * changes[1]) == slides
        moved = [np.median(np.abs(r.error - before.error)[late]) for r in (along, across)]
        assert moved[1] > 0.3 * MOVED
        assert (moved[0] < 0.1 * MOVED) == slides
    assert np.nanmedian(known.error) < np.nanmedian(plain.error)


def test_noise_explains_less_where_only_distances_across_count(film):
    positions, keys = film
    scene = Scene.of(Measurement(name="film", fps=30, vertices=positions, noise_mm=2.0, **keys))
    assert Study([scene]).floors_mm == pytest.approx([2 * MEDIAN_NORM])
    assert Study([replace(scene, slides=True)]).floors_mm == pytest.approx([2 * MEDIAN_ONE])
