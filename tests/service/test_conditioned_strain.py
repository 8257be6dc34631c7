"""Clothes of the default avatar on poses that are garbage: conditioned, they stay clothes."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.conditioning import Conditioner, Conditioning, Did, condition
from caphy.conditioning.likelihood import MOST, unlikeliness
from caphy.io.procedural import procedural_motion
from service.avatars import Avatar, load_avatars
from service.settings import BUNDLED_AVATARS

COUNT = 40
MOST_STRETCH = 3.0
"""Length of a stretched edge or diagonal of any face against the template's. Captured motions reach 1.3."""


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    (avatar,) = load_avatars(BUNDLED_AVATARS, 8).values()
    return avatar


def garbage(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, poses, translations and confidences with everything wrong that an estimator can send."""
    rng = np.random.default_rng(seed)
    motion = procedural_motion(seed, COUNT / 30 + 0.1, 30.0)
    poses, transl, trust = motion.poses[:COUNT].copy(), motion.transl[:COUNT].copy(), np.ones((COUNT, 55))
    for i in range(COUNT):
        match rng.integers(7):
            case 0:
                poses[i] = rng.normal(0, 2, (55, 3))
            case 1:
                transl[i] += rng.normal(0, 300, 3)
            case 2:
                poses[i, 0] += [0, np.pi, 0]
            case 3:
                trust[i] = 0
            case 4:
                poses[i, rng.integers(55)] = np.nan
            case 5:
                trust[i, rng.random(55) < 0.5] = 0
    return np.cumsum(rng.choice([1 / 30, 1 / 30, 1 / 10, -0.02, 0.6], COUNT)), poses, transl, trust


def worn(avatar: Avatar, poses: np.ndarray, transl: np.ndarray, anew: set[int]) -> dict[str, np.ndarray]:
    """Vertices (T, V, 3) of every garment, settled where it begins anew, as the service does."""
    poses, transl = poses.astype(np.float32), transl.astype(np.float32)
    shown = {}
    for engine in avatar.engines.values():
        state, vertices = engine.initial_state(), []
        for i in range(len(poses)):
            if i in anew:
                held = np.repeat(poses[i : i + 1], 30, 0), np.repeat(transl[i : i + 1], 30, 0)
                state = engine.run(*held, engine.initial_state())[1]
            found, state = engine.run(poses[i : i + 1], transl[i : i + 1], state)
            vertices.append(found[0])
        shown[engine.name] = np.array(vertices, np.float64)
    return shown


def largest_stretch(avatar: Avatar, shown: dict[str, np.ndarray]) -> float:
    """Largest singular value of the faces' deformation against the template."""
    most = 0.0
    for garment in avatar.bundle.garments:
        rest, vertices = (
            np.stack([v[..., garment.mesh.faces[:, k], :] - v[..., garment.mesh.faces[:, 0], :] for k in (1, 2)], -1)
            for v in (garment.mesh.vertices.astype(np.float64), shown[garment.name])
        )
        bent = vertices @ np.linalg.inv(np.linalg.qr(rest)[1])
        uu, vv, uv = (np.einsum("tfi,tfi->tf", bent[..., i], bent[..., j]) for i, j in ((0, 0), (1, 1), (0, 1)))
        most = max(most, float(np.sqrt((uu + vv) / 2 + np.hypot((uu - vv) / 2, uv)).max()))
    return most


def test_garbage_never_tears_the_clothes(avatar):
    times, poses, transl, trust = garbage(0)
    conditioner = Conditioner(Conditioning(fps=30.0), longest=1.0)
    frames = condition(conditioner, times, poses, transl, trust)
    anew = {i for i, frame in enumerate(frames) if Did.RESET in frame.did}
    shown = worn(avatar, np.array([f.poses for f in frames]), np.array([f.transl for f in frames]), anew)
    assert all(np.isfinite(vertices).all() for vertices in shown.values())
    assert largest_stretch(avatar, shown) < MOST_STRETCH
    assert conditioner.summary.refused["posture"] > 0
    assert any("no posture of a body" in note for frame in frames for note in frame.notes)
    sound = np.isfinite(poses).all(axis=(1, 2))
    raw = worn(avatar, poses[sound], transl[sound], {0})
    assert largest_stretch(avatar, raw) > 1.5 * MOST_STRETCH  # the bound means something


def test_what_bodies_do_is_a_posture():
    crouched = np.zeros((55, 3))
    crouched[[1, 2], 0], crouched[[4, 5], 0], crouched[[3, 6, 9], 0] = -2.1, 2.4, 0.5
    split = np.zeros((55, 3))
    split[[1, 2], 2] = 1.4, -1.4
    for vectors in (np.zeros((55, 3)), crouched, split, *procedural_motion(3, 3.0, 10.0).poses):
        assert unlikeliness(vectors, np.ones(55)) < 0.75 * MOST
    wild = np.random.default_rng(0).normal(0, 1, (50, 55, 3))
    assert min(unlikeliness(vectors, np.ones(55)) for vectors in wild) > 1.5 * MOST
    assert unlikeliness(wild[0], np.zeros(55)) == 0  # what is not seen says nothing
