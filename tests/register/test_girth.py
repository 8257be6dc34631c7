"""Girth told by area."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ellipe

from caphy.register.girth import Sheet, Shown, area_gains, eases_step, shown
from caphy.report.render import vertex_normals
from caphy.scan.scan import LOWER, UPPER, Scan

HEIGHT, RADIUS = 0.6, 0.15


def tube(radius, around: int, along: int, height: float = HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    """An open tube whose radius [m] is a function of the angle; faces outwards."""
    angle, y = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(0, height, along), indexing="ij")
    r = radius(angle)
    vertices = np.stack([r * np.sin(angle), y, r * np.cos(angle)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along - 1), indexing="ij")
    a, b = (i * along + j).ravel(), ((i + 1) % around * along + j).ravel()
    return vertices, np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)]).astype(np.int32)


def plain(angle: np.ndarray) -> np.ndarray:
    return np.full_like(angle, RADIUS)


def scan(radius, noise: float = 1e-3, hole: bool = False) -> Scan:
    """What a scanner makes of a tube, at edges of 6 mm."""
    vertices, faces = tube(radius, 157, 101)
    vertices = vertices + np.random.default_rng(0).normal(0, noise, vertices.shape)
    middle = vertices[faces].mean(axis=1)
    if hole:
        faces = faces[np.linalg.norm(middle - [0.0, 0.3, RADIUS], axis=1) > 0.06]
    return Scan("tube", vertices, faces, labels=np.full(len(vertices), UPPER, np.uint8))


def test_folds_show_the_girth_that_they_take_up():
    """An ellipse of the girth of a wider circle, whose circumference is a complete elliptic integral."""
    wide, narrow = 1.25 * RADIUS, 0.75 * RADIUS
    girth = 4 * wide * ellipe(1 - (narrow / wide) ** 2)

    def ellipse(angle: np.ndarray) -> np.ndarray:
        return wide * narrow / np.hypot(narrow * np.cos(angle), wide * np.sin(angle))

    found = shown(*tube(plain, 27, 17), Sheet.of(scan(ellipse), "upper"))
    coarse = 27 / np.pi * np.sin(np.pi / 27)  # a polygon's circumference over its circle's
    assert found.scanned.sum() / found.own.sum() == pytest.approx(girth / (2 * np.pi * RADIUS) / coarse, abs=0.01)


def test_noise_adds_no_girth():
    """A millimetre of it adds 5 % as it comes."""
    vertices, faces = tube(plain, 27, 17)
    rough, noisy = scan(plain), Sheet.of(scan(plain), "upper")
    as_it_comes = shown(vertices, faces, Sheet(rough.vertices, rough.faces))
    evened = shown(vertices, faces, noisy)
    exact = shown(vertices, faces, Sheet(*tube(plain, 157, 101)))
    ratios = [each.scanned.sum() / each.own.sum() for each in (as_it_comes, evened, exact)]
    assert ratios[0] > ratios[2] + 0.03
    assert ratios[1] == pytest.approx(ratios[2], abs=0.012)


def test_what_no_camera_saw_is_no_lack_of_cloth():
    vertices, faces = tube(plain, 60, 40)
    whole, holed = (shown(vertices, faces, Sheet.of(scan(plain, hole=hole), "upper")) for hole in (False, True))
    assert holed.own.sum() < whole.own.sum() - 0.008  # of a hole of 0.011 m^2
    assert holed.scanned.sum() / holed.own.sum() == pytest.approx(whole.scanned.sum() / whole.own.sum(), abs=0.01)
    shirt = scan(plain)
    labels = np.where(shirt.vertices[:, 1] < 0.3, LOWER, UPPER).astype(np.uint8)  # trousers over the lower half
    half = shown(vertices, faces, Sheet.of(Scan("half", shirt.vertices, shirt.faces, labels=labels), "upper"))
    assert half.own.sum() == pytest.approx(0.5 * whole.own.sum(), rel=0.1)
    # a row of faces is 5 % of the half, and its middle decides
    assert half.scanned.sum() / half.own.sum() == pytest.approx(whole.scanned.sum() / whole.own.sum(), abs=0.025)


def test_what_no_camera_could_see_of_hung_cloth_is_no_surplus_of_it():
    """A fold of 9 cm laid flat under its neighbour, of which a scan has nothing, though it has cloth near it; and what
    a sleeve over the lower half covers."""
    tuck, around, along = 0.6, 90, 24
    run = np.arange(around) * (2 * np.pi + 2 * tuck) / around
    knots = [0, 3, 3 + tuck, 2 * np.pi + 2 * tuck]  # there, back and there again
    angle = np.interp(run, knots, [0, 3, 3 - tuck, 2 * np.pi])
    r = np.interp(run, knots, [RADIUS, RADIUS, RADIUS - 0.004, RADIUS])
    ring = np.stack([r * np.sin(angle), np.zeros(around), r * np.cos(angle)], axis=-1)
    heights = np.linspace(0, HEIGHT, along)[:, None] * [0.0, 1.0, 0.0]
    cloth = (ring[:, None] + heights).reshape(-1, 3), tube(plain, around, along)[1]

    sheet = Sheet.of(scan(plain), "upper")
    found = shown(*cloth, sheet)
    assert found.scanned.sum() / found.own.sum() == pytest.approx(1.0, abs=0.02)  # 0.92 with the fold
    sleeve = tube(lambda angle: plain(angle) + 0.01, 60, 20, HEIGHT / 2)
    assert shown(*cloth, sheet, [sleeve]).own.sum() == pytest.approx(0.5 * found.own.sum(), rel=0.12)


def test_a_scan_without_that_garment_shows_nothing():
    vertices, faces = tube(plain, 27, 17)
    found = shown(vertices, faces, Sheet.of(scan(plain), "lower"))
    assert found.share == found.own.sum() == found.scanned.sum() == 0


def test_area_gains_are_differences_of_areas():
    vertices, faces = tube(lambda angle: RADIUS * (1 + 0.2 * np.sin(3 * angle)), 40, 20)
    random = np.random.default_rng(1)
    slopes = random.normal(size=(len(vertices), 2))
    gains = area_gains(vertices, faces, slopes)
    step, normals = 1e-6, vertex_normals(vertices, faces)
    for k in range(2):
        moved = [vertices + sign * step * slopes[:, k : k + 1] * normals for sign in (1, -1)]
        difference = (_areas(moved[0], faces) - _areas(moved[1], faces)) / (2 * step)
        np.testing.assert_allclose(gains[:, k], difference, atol=1e-7)


def test_the_step_is_that_of_least_squares():
    """With the areas that given eases would make in each part, those are told; a firm belief is kept."""
    random = np.random.default_rng(0)
    gains, own, wanted = random.normal(0.01, 0.01, (200, 2)), random.uniform(1e-3, 2e-3, 200), np.array([0.02, -0.01])
    own[:50], parts = 0.0, np.arange(200) % 3  # a quarter is not seen
    scanned = np.where(own > 0, own + gains @ wanted, 0.0)
    still = np.zeros(2)

    def step(scanned: np.ndarray, grown: np.ndarray, spread: float) -> np.ndarray:
        return eases_step([Shown(own, scanned, 1.0)], gains, parts, grown, np.full(2, spread))

    np.testing.assert_allclose(step(scanned, still, 1e3), wanted, rtol=1e-5)
    assert np.abs(step(scanned, still, 1e-9)).max() < 1e-9
    moved = scanned.copy()
    for part in range(3):  # which face of a part a fold lies over does not matter
        moved[parts == part] = random.permutation(scanned[parts == part])
    np.testing.assert_allclose(step(moved, still, 1e3), wanted, rtol=1e-5)


def test_steps_one_after_another_forget_nothing_of_what_was_known_before():
    """Where areas follow the eases, the second step finds nothing left to do, whatever was believed."""
    random = np.random.default_rng(1)
    gains, own, wanted = random.normal(0.01, 0.01, (200, 2)), random.uniform(1e-3, 2e-3, 200), np.array([0.02, -0.01])
    parts, spread = np.arange(200) % 3, np.array([0.01, 0.003])
    first = eases_step([Shown(own, own + gains @ wanted, 1.0)], gains, parts, np.zeros(2), spread)
    assert np.abs(first - wanted).max() > 1e-3  # the belief counts
    wider = own + gains @ first
    second = eases_step([Shown(wider, own + gains @ wanted, 1.0)], gains, parts, first, spread)
    assert np.abs(second).max() < 0.02 * np.abs(first).max()  # what is left is in the weights, which go by the area


def test_what_one_ease_may_not_do_the_others_do():
    """Two that widen one ring alike, the second barely: at its limit the first does the rest."""
    gains, own, parts = np.tile([1e-2, 1.2e-2], (50, 1)), np.full(50, 2e-3), np.zeros(50, int)
    seen, still, spread = [Shown(own, own + gains @ [0.02, 0.0], 1.0)], np.zeros(2), np.full(2, 1e3)
    free = eases_step(seen, gains, parts, still, spread)
    assert free[1] > 0.005
    held = eases_step(seen, gains, parts, still, spread, (np.full(2, -1.0), np.array([1.0, 0.001])))
    np.testing.assert_allclose(held, [0.02 - 1.2 * 0.001, 0.001], rtol=1e-4)


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
