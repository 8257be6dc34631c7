"""Where windows start when single vertices were not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.effects.model import Model
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene
from caphy.measure.windows import StartStates, filled
from caphy.refit.responses import START_MODES, Watched

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}, "bending": {}})
FRAME = 12


@pytest.fixture(scope="module")
def cloth() -> Measurement:
    positions, keys = simulate(seconds=1.0, settle=1.5)
    return measured(positions, keys)


def holed(measurement: Measurement, share: float) -> Measurement:
    vertices = measurement.vertices.copy()
    vertices[np.random.default_rng(5).random(vertices.shape[:2]) < share] = np.nan
    return replace(measurement, vertices=vertices)


def start(measurement: Measurement) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (START_MODES, 3) of a start in the smoothest modes."""
    watched = Watched(Scene.of(measurement))
    sharp = watched._sharpened(StartStates(watched.scene, watched.scene.potential(MODEL)), FRAME)
    assert sharp is not None
    state = sharp[0]
    every = np.ones(len(state.x), bool)
    found = [watched.projection.of(field.numpy(), every)[:START_MODES] for field in (state.x, state.v)]
    return found[0], found[1]


@pytest.mark.parametrize(("share", "most_mm", "most_mm_per_s"), [(0.05, 0.1, 2.0), (0.2, 0.25, 5.0)])
def test_a_start_hardly_minds_what_was_not_seen(cloth, share, most_mm, most_mm_per_s):
    """Sharpened starts are known to 0.07 mm and 2 to 3 mm/s where everything was seen."""
    (x, v), (there, moving) = start(cloth), start(holed(cloth, share))
    assert 1e3 * np.sqrt(np.mean((there - x) ** 2)) < most_mm
    assert 1e3 * np.sqrt(np.mean((moving - v) ** 2)) < most_mm_per_s


def test_a_window_in_which_too_little_was_seen_tells_nothing(cloth):
    """Each of its frames shows a third of the vertices, others in each, so that a start can be told."""
    vertices, first = cloth.vertices.copy(), 10
    vertices[first:][np.random.default_rng(5).random(vertices[first:].shape[:2]) > 0.35] = np.nan
    watched = Watched(Scene.of(replace(cloth, vertices=vertices)))
    states = StartStates(watched.scene, watched.scene.potential(MODEL))
    assert any(states.possible(frame) for frame in range(first, len(vertices) - 9))
    assert max(watched.starts()) < first


def test_where_the_cloth_hangs_does_not_matter(cloth):
    far = np.array([4.0, 0.0, -3.0])
    moved = replace(
        holed(cloth, 0.05),
        vertices=holed(cloth, 0.05).vertices + far,
        pinned_positions=cloth.pinned_positions + far,
    )
    here, there = start(holed(cloth, 0.05)), start(moved)
    np.testing.assert_allclose(there[1], here[1], atol=1e-5)
    shift = there[0] - here[0]
    np.testing.assert_allclose(shift[0], far, atol=1e-6)
    np.testing.assert_allclose(shift[1:], 0, atol=1e-6)


@pytest.mark.parametrize("seen", ["scattered", "a corner", "nothing"])
def test_holes_are_their_harmonic_continuation(cloth, seen):
    watched = Watched(Scene.of(cloth))
    sheet, fields = watched.scene.potential(MODEL).cloth, np.random.default_rng(1).normal(size=(81, 3))
    known = {
        "scattered": np.random.default_rng(2).random(81) < 0.7,
        "a corner": np.linalg.norm(sheet.vertices - sheet.vertices[0], axis=1) > 0.3,
        "nothing": np.zeros(81, bool),
    }[seen]
    whole = filled(np.where(known[:, None], fields, np.nan), known, sheet) if known.any() else np.zeros((81, 3))
    told = watched.projection.of(np.where(known[:, None], fields, np.nan), known)
    np.testing.assert_allclose(told, watched.projection.of(whole, np.ones(81, bool)), atol=1e-12)


@pytest.mark.parametrize("frame", [FRAME - 1, FRAME, FRAME + 1])
def test_where_cloth_is_jolted_its_velocity_is_known_less(cloth, frame):
    """The whole cloth is 2 cm aside in one frame: no frames around it tell its velocity there."""

    def doubt(measurement: Measurement) -> np.ndarray:
        watched = Watched(Scene.of(measurement))
        sharp = watched._sharpened(StartStates(watched.scene, watched.scene.potential(MODEL)), FRAME)
        assert sharp is not None
        return np.asarray(sharp[1][1])

    vertices = cloth.vertices.copy()
    free = np.setdiff1d(np.arange(vertices.shape[1]), cloth.pinned)
    vertices[frame, free, 0] += 0.02
    smooth, jolted = doubt(cloth), doubt(replace(cloth, vertices=vertices))
    expected = 0.02 * 2 * cloth.fps / 12  # the quartic's weights beyond the two frames' are 1, -2, 0, 2, -1 twelfths
    assert jolted[0] > 0.9 * expected > 8 * smooth[0]
    np.testing.assert_allclose(doubt(replace(cloth, vertices=cloth.vertices + 0.02)), smooth, rtol=1e-6)
