"""What a cloud cannot show, where cloth lies along itself, does not count against a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import normals, simulate

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.rim import Rim
from caphy.measure.scene import Scene
from caphy.refit.columns import addition
from caphy.refit.evidence import estimated_variance, whitened
from caphy.refit.modes import COUNT
from caphy.refit.responses import STEP_DOUBT, Response, Watched
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
START = 8
MOVED = 0.003
"""How far measured cloth is moved [m]."""


@pytest.fixture(scope="module")
def film() -> tuple[np.ndarray, dict]:
    return simulate(seconds=1.2, settle=2.0)


def response(
    film: tuple[np.ndarray, dict], slides: bool, along: float = 0.0, across: float = 0.0, out: float = 0.0
) -> Response:
    """The window at :data:`START`, of a film whose cloth is moved along and across itself after the window's start, and
    ends farther ``out``."""
    positions, keys = film
    normal = normals(positions, keys["faces"])
    sideways = np.cross(normal, [0.0, 1.0, 0.3])
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    moved = positions + along * sideways + across * normal
    moved[: START + 3] = positions[: START + 3]  # which the start is read from
    middle, _, outward = Rim.of(keys["rest_vertices"], keys["faces"]).frames(positions)
    ends = middle + out * outward if slides else None
    scene = replace(Scene.of(Measurement(name="film", fps=30, vertices=moved, **keys)), ends=ends)
    return next(Watched(scene).respond(MODEL, addition("shrinkage"), [START]))


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


def test_what_finer_steps_do_is_taken_from_cloth_and_rim_alike(film):
    positions, keys = film
    ends = Rim.of(keys["rest_vertices"], keys["faces"]).frames(positions)[0]
    watched = Watched(replace(Scene.of(Measurement(name="film", fps=30, vertices=positions, **keys)), ends=ends))
    whole = next(watched.respond(MODEL, (), [START]))
    of_step, of_mesh = np.moveaxis(watched._solver[START], 1, 0)
    watched._solver[START] = np.stack([0 * of_step, of_mesh], axis=1)
    bare = next(watched.respond(MODEL, (), [START]))
    taken = whole.nuisance[..., 0] / STEP_DOUBT
    assert np.linalg.norm(taken[:, COUNT:]) > 1e-4
    np.testing.assert_allclose(bare.residual - whole.residual, taken, rtol=0, atol=1e-12)


def unknown(film: tuple[np.ndarray, dict]) -> np.ndarray:
    positions, keys = film
    return np.full((len(positions), len(Rim.of(keys["rest_vertices"], keys["faces"]).edges), 3), np.nan)


def test_where_cloth_ends_counts(film):
    """A cloud that ends 3 mm farther out all round moves the rim's constant by that, and nothing of the cloth."""
    before, after = response(film, True), response(film, True, out=MOVED)
    moved = after.residual - before.residual
    assert np.abs(moved[:, :COUNT]).max() < 1e-12
    assert np.sqrt((moved[:, COUNT:] ** 2).sum((1, 2))) == pytest.approx(MOVED, rel=1e-3)  # modes are orthonormal
    assert np.abs(moved[:, COUNT, 0]) == pytest.approx(MOVED, rel=1e-3)


def test_the_rim_answers_to_what_shortens_cloth(film):
    """By far more than the cloth does across itself, and as roll-outs do."""
    positions, keys = film
    scene = replace(Scene.of(Measurement(name="film", fps=30, vertices=positions, **keys)), ends=unknown(film))
    assert not next(Watched(scene).respond(MODEL, (), [START])).residual[:, COUNT:].any()  # what is not known
    shorter = MODEL.with_effect("shrinkage", fraction=1e-4)
    watched = Watched(replace(scene, ends=Rim.of(keys["rest_vertices"], keys["faces"]).frames(positions)[0]))
    told = next(watched.respond(MODEL, addition("shrinkage"), [START]))
    other = next(watched.respond(shorter, (), [START]))  # with the errors of the solver that are known by now
    by_rolling = (told.residual - other.residual) / 1e-4
    late, rim = slice(3, None), slice(COUNT, None)
    assert told.columns[late, rim, :, 0] == pytest.approx(by_rolling[late, rim], abs=0.03 * np.abs(by_rolling).max())
    assert np.abs(told.columns[late, rim]).max() > 0.05  # 0.6 m of cloth


def test_what_is_not_known_of_a_rim_makes_it_no_surer(film):
    """Two windows of three do not see the rim; it stays as uncertain as the third one says, and so if none sees it."""
    random, one = np.random.default_rng(0), response(film, True)
    noise = random.normal(0, 1e-3, (3, *one.residual.shape))
    noise[:, :, COUNT:] *= 3
    seeing = [replace(one, residual=each, columns=one.columns[..., :0]) for each in noise]
    blind = [replace(each, residual=each.residual * (np.arange(COUNT + 5) < COUNT)[:, None]) for each in seeing]
    full = estimated_variance(seeing, 0.0)[:, COUNT:].mean()
    some = estimated_variance([seeing[0], *blind[1:]], 0.0)[:, COUNT:].mean()
    assert 0.6 * full < some < 1.6 * full
    assert np.isfinite(estimated_variance(blind, 0.0)).all()


def test_a_loop_of_which_little_is_known_says_nothing(film):
    positions, keys = film
    rim = Rim.of(keys["rest_vertices"], keys["faces"])
    ends = rim.frames(positions)[0]
    scene = Scene.of(Measurement(name="film", fps=30, vertices=positions, **keys))
    for known, says in ((12, False), (20, True)):
        partly = np.where((np.arange(32) < known)[:, None], ends, np.nan)
        told = next(Watched(replace(scene, ends=partly)).respond(MODEL, (), [START]))
        assert told.residual[:, COUNT:].any() == says


def test_clouds_and_registered_measurements_are_not_mixed(film):
    positions, keys = film
    scene = Scene.of(Measurement(name="film", fps=30, vertices=positions, **keys))
    cloud = replace(scene, ends=unknown(film))
    with pytest.raises(CaphyError, match="must not be mixed"):
        Study([scene, cloud])
    told = next(Watched(cloud).respond(MODEL, (), [START]))
    with pytest.raises(CaphyError, match="must not be mixed"):
        whitened(told, np.ones((len(told.residual), COUNT)))


def test_noise_explains_less_where_only_distances_across_count(film):
    positions, keys = film
    scene = Scene.of(Measurement(name="film", fps=30, vertices=positions, noise_mm=2.0, **keys))
    assert Study([scene]).floor_mm == pytest.approx(2 * 1.538172, rel=1e-4)  # of three normal numbers
    assert Study([replace(scene, ends=unknown(film))]).floor_mm == pytest.approx(2 * 0.674490, rel=1e-4)


def test_the_noise_of_several_films_is_that_of_all_their_windows(film):
    """As errors are pooled: the noisiest film's own would be more than is left of all."""
    positions, keys = film
    sizes = (1.0, 1.0, 4.0)
    scenes = [
        Scene.of(Measurement(name=f"film {k}", fps=30, vertices=positions, noise_mm=size, **keys))
        for k, size in enumerate(sizes)
    ]
    random = np.random.default_rng(0)
    pooled = np.concatenate([np.linalg.norm(size * random.normal(size=(200_000, 3)), axis=1) for size in sizes])
    assert Study(scenes).floor_mm == pytest.approx(np.median(pooled), rel=5e-3)
    each = np.where(np.arange(positions.shape[1]) % 10 < 4, 5e-3, 3e-4)  # [m], as a file may state it of each vertex
    stated = Scene.of(Measurement(name="mixed", fps=30, vertices=positions, noise=each, **keys))
    pooled = np.linalg.norm(1e3 * random.choice(each, (400_000, 1)) * random.normal(size=(400_000, 3)), axis=1)
    assert Study([stated]).floor_mm == pytest.approx(np.median(pooled), rel=1e-2)
    noiseless = Scene.of(Measurement(name="clean", fps=30, vertices=positions, noise_mm=0.0, **keys))
    assert Study([noiseless]).floor_mm == pytest.approx(0.0, abs=1e-6)
