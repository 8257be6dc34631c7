"""Where clouds end, against clouds spread evenly over flat cloth whose size is known."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.body.surface import nearest_on_surface
from caphy.challenge.sheets import SIDE, users_square
from caphy.measure.rim import FEWEST, Rim, reached
from caphy.refit.modes import rim_modes


def found_ends(scale: float, count: int, noise: float, frames: int) -> np.ndarray:
    """How far out of the user's square (K, E) [m] each frame's cloud, of a square ``scale`` times as large, ends."""
    cloth, random, found = users_square(), np.random.default_rng(0), []
    rim = Rim.of(cloth.vertices, cloth.faces)
    middle, _, out = rim.frames(cloth.vertices)
    centre = cloth.vertices.mean(0)
    for _ in range(frames):
        cloud = centre + np.c_[random.uniform(-0.5, 0.5, (count, 2)) * SIDE * scale, np.zeros(count)]
        cloud += random.normal(0, noise, cloud.shape)
        face = nearest_on_surface(cloud, cloth.vertices, cloth.faces).face
        found.append(((rim.ends(cloth.vertices, cloud, face, noise) - middle) * out).sum(1))
    return np.array(found)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("scale", [0.97, 1.0, 1.03])
def test_ends_are_found_without_bias(scale: float, noise: float):
    """A twentieth of the gap between points off in the mean, and one gap from edge to edge."""
    gap = SIDE**2 / 2500 / (SIDE / 16)
    ends = found_ends(scale, 2500, noise, 40)
    assert np.nanmean(ends) == pytest.approx(0.5 * (scale - 1) * SIDE, abs=0.05 * gap)
    assert 0.7 * gap < np.nanstd(ends) < 1.3 * gap
    assert np.isfinite(ends).mean() > 0.99


def test_what_few_points_lie_behind_is_not_known():
    cloth = users_square()
    rim = Rim.of(cloth.vertices, cloth.faces)
    middle, _, out = rim.frames(cloth.vertices)
    for count in (FEWEST - 1, FEWEST):
        cloud = middle[5] - 0.002 * np.arange(1, count + 1)[:, None] * out[5]
        face = nearest_on_surface(cloud, cloth.vertices, cloth.faces).face
        known = np.isfinite(rim.ends(cloth.vertices, cloud, face, 0.0)).all(1)
        assert known.sum() == (count >= FEWEST)
        assert known[5] == (count >= FEWEST)


def test_what_is_folded_beside_an_edge_is_not_its_end():
    """A flap that stands on the cloth and leans outwards, as of a folded corner."""
    cloth, random = users_square(), np.random.default_rng(2)
    rim = Rim.of(cloth.vertices, cloth.faces)
    middle, along, out = rim.frames(cloth.vertices)
    even = np.c_[random.uniform(0, SIDE, (2500, 2)), np.zeros(2500)]
    beside, up = random.uniform(-0.5, 0.5, (200, 1)) * rim.length[7], random.uniform(0.02, 0.05, (200, 1))
    flap = middle[7] + beside * along[7] + up * ([0, 0, 1] + 0.4 * out[7])
    ends = []
    for cloud in (even, np.concatenate([even, flap])):
        face = nearest_on_surface(cloud, cloth.vertices, cloth.faces).face
        ends.append(rim.ends(cloth.vertices, cloud, face, 0.0))
    np.testing.assert_array_equal(ends[1], ends[0])


@pytest.mark.parametrize("gap", [1e-4, 1e-3, 4e-3])
def test_how_far_the_outermost_point_reaches(gap: float):
    random, noise = np.random.default_rng(1), 1e-3
    outermost = []
    for _ in range(4000):
        count = random.poisson(0.05 / gap)
        outermost.append((random.uniform(-0.05, 0, count) + random.normal(0, noise, count)).max())
    error = np.std(outermost) / np.sqrt(len(outermost))
    assert reached(np.array([gap]), noise)[0] == pytest.approx(np.mean(outermost), abs=3 * error)


def test_noise_that_is_next_to_none_moves_no_end():
    gap = np.array([1e-4, 4e-3])
    for noise in (1e-6, 1e-7, 1e-9, 1e-12):
        np.testing.assert_allclose(reached(gap, noise), reached(gap, 0.0), rtol=0, atol=0.01 * noise)


def test_the_rim_faces_out_of_the_cloth():
    cloth = users_square()
    rim = Rim.of(cloth.vertices, cloth.faces)
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    middle, along, out = rim.frames(np.stack([cloth.vertices, cloth.vertices @ turn]))
    assert len(rim.edges) == 64
    assert rim.length.sum() == pytest.approx(4 * SIDE)
    assert (along * out).sum(-1) == pytest.approx(0, abs=1e-12)
    assert ((middle - middle.mean(1, keepdims=True)) * out).sum(-1) == pytest.approx(SIDE / 2)


def tube(around: int = 14, rings: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3), open at both ends."""
    angle, height = 2 * np.pi * np.arange(around) / around, np.linspace(0, 0.25, rings)
    ring = 0.2 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    i, k = np.divmod(np.arange((rings - 1) * around), around)
    a, b = i * around + k, i * around + (k + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    return (ring[None] + height[:, None, None] * [0, 1, 0]).reshape(-1, 3), faces


def test_modes_of_a_rim_are_orthonormal_and_hold_its_loops_apart():
    rim = Rim.of(*tube())
    modes, weight = rim_modes(rim), rim.length / rim.length.sum()
    assert modes.shape[1] % 3 == 0
    np.testing.assert_allclose((modes * weight[:, None]).T @ modes, np.eye(modes.shape[1]), atol=1e-12)
    for loop in (0, 1):
        own, other = modes[rim.loop == loop], modes[rim.loop != loop]
        mine = np.abs(own).max(0) > 0
        assert mine.sum() == modes.shape[1] // 2
        assert not other[:, mine].any()
        moved = np.ones(len(own))  # out everywhere
        assert own @ np.linalg.lstsq(own, moved, rcond=None)[0] == pytest.approx(moved)
