"""The pinned square, as the challenge simulates it."""

import numpy as np
import pytest

from caphy.challenge.hidden import HIDDEN
from caphy.challenge.leapfrog import FlewApart
from caphy.challenge.recording import played, simulator
from caphy.challenge.square import square


def test_cloth_that_flies_apart_is_simulated_in_shorter_steps():
    """Light where its mass grades off, this one is stiffer where it moves than at rest, where steps are chosen."""
    stage = square(40, 48)
    play = [play for play in stage.plays if play.part == "train"][1]
    hidden = HIDDEN["air_drag_tangential and mass_gradient"].drawn(np.random.default_rng([40, 1]))
    with pytest.raises(FlewApart):
        simulator(stage, play, hidden).run(play.start, 12, 30.0, calming=8.0)
    (state,) = played(stage, play, hidden, 1)
    corners = state.x.numpy()[stage.truth.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() < 0.03
