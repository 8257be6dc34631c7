"""Garments on moving bodies, as the challenge simulates them."""

import numpy as np
import pytest

from caphy.challenge.dressed import skirt
from caphy.challenge.hidden import ONE
from caphy.challenge.leapfrog import Leapfrog
from caphy.challenge.recording import played
from caphy.effects.cloth import Cloth
from caphy.errors import CaphyError


def test_a_blown_skirt_comes_into_the_picture_without_knots():
    """Cloth that was caught in the groin is stretched to 1.11 around its knot and squeezed to 0.86 within it."""
    stage = skirt(11, 48)
    play = next(play for play in stage.plays if play.part == "train")
    hidden = ONE["wind_normal"].drawn(np.random.default_rng([11, 1]))
    (state,) = played(stage, play, hidden, 1)
    cloth = Cloth.of(stage.truth, stage.model.density)
    a, b, c = (state.x.numpy()[cloth.faces[:, k]] for k in range(3))
    stretches = np.linalg.svd(np.stack([b - a, c - a], -1) @ cloth.face_inverse, compute_uv=False)
    assert stretches.max() < 1.08
    assert stretches.min() > 0.88


def test_cloth_that_flies_apart_is_told(monkeypatch):
    for rate in ("_stable_rate", "_kick_rate"):
        monkeypatch.setattr(Leapfrog, rate, lambda self: 300.0)
    stage = skirt(11, 48)
    with pytest.raises(CaphyError, match=r"flew apart at -.* s; 675 steps per second are too few"):
        played(stage, stage.plays[0], ONE["wind_normal"].drawn(np.random.default_rng(1)), 1)
