"""Making measurements with something hidden in them."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.challenge.hidden import HIDDEN
from caphy.challenge.world import make
from caphy.errors import CaphyError


def test_motions_simulated_side_by_side_are_the_same_ones() -> None:
    worlds = [make("square", HIDDEN["air_drag_normal"], 3, frames=3, processes=count) for count in (1, 2)]
    for part in ("train", "held_out", "base"):
        alone, together = (getattr(world, part) for world in worlds)
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one.vertices, other.vertices)
    assert worlds[0].answer == worlds[1].answer


def test_what_has_a_place_in_space_is_not_hidden_from_people_who_walk_away_from_it() -> None:
    with pytest.raises(CaphyError, match="attraction does nothing in the scene skirt; it acts in square"):
        make("skirt", HIDDEN["attraction"], 3, frames=3)
