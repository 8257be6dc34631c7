"""Of recordings of many frames a second some frames are used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.pace import FASTEST, paced
from caphy.measure.scene import Scene

FRAMES, PREROLL = 41, 7


@pytest.fixture(scope="module")
def film() -> Measurement:
    return measured(*simulate(settle=1.0, tempo=1.2))


@pytest.mark.parametrize(("fps", "step"), [(25, 1), (30, 1), (45, 1), (48, 2), (60, 2), (100, 3), (240, 8)])
def test_the_rate_that_is_used(film, fps, step):
    fewer = paced(replace(film, fps=float(fps)))
    assert fewer.fps == fps / step
    assert (fewer is paced(fewer)) and len(fewer) == -(-len(film) // step)
    assert len(fewer.notes) - len(film.notes) == (fps > FASTEST)


def test_a_film_of_which_no_used_frame_shows_anything_is_told_so(film):
    vertices = film.vertices.copy()
    vertices[::2] = np.nan
    with pytest.raises(CaphyError, match=r"one in 2 is used, from frame 0 on, and none of these shows anything"):
        paced(replace(film, vertices=vertices, fps=60.0))


def test_frames_that_are_used_are_those_that_were_given(film):
    scene = Scene.of(replace(film, fps=120.0))
    used = scene.measurement
    np.testing.assert_array_equal(used.vertices, film.vertices[::4])
    np.testing.assert_allclose(scene.pins(1 / used.fps).numpy(), film.pinned_positions[4][np.argsort(film.pinned)])
    assert [used.number(frame) for frame in (0, 3)] == [0, 12]
    assert "has 120 frames a second, of which one of 4 is used" in used.notes[-1]


def test_clouds_bodies_and_what_led_to_them_keep_step():
    random = np.random.default_rng(0)
    counts = random.integers(3, 6, FRAMES)
    frame = np.repeat(np.arange(FRAMES), counts)
    steady = np.arange(-PREROLL, FRAMES, dtype=float)
    transl = np.stack([steady, 0 * steady, 0 * steady], axis=1)
    poses = np.zeros((len(steady), 55, 3))
    given = Measurement(
        name="cloud", fps=90.0, points=np.stack([frame, frame, frame], axis=1).astype(float),
        offsets=np.r_[0, np.cumsum(counts)], noise=1e-3 * (1 + frame), poses=poses[PREROLL:], transl=transl[PREROLL:],
        preroll_poses=poses[:PREROLL], preroll_transl=transl[:PREROLL],
    )  # fmt: skip
    fewer = paced(given)
    assert fewer.fps == 30 and len(fewer) == 14
    np.testing.assert_array_equal(np.r_[fewer.preroll_transl, fewer.transl][:, 0], np.arange(-6, FRAMES, 3))
    for number in range(len(fewer)):
        np.testing.assert_array_equal(fewer.cloud(number), given.cloud(3 * number))
    np.testing.assert_array_equal(fewer.noise, 1e-3 * (1 + fewer.points[:, 0]))
