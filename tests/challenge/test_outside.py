"""Forces from outside the library act on cloth of every scene."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.challenge.hidden import HIDDEN
from caphy.challenge.outside import FORCES, shaker
from caphy.challenge.square import square
from caphy.challenge.world import SCENES
from caphy.effects.cloth import Cloth


def cloth_of(scene: str) -> Cloth:
    """The truth's cloth."""
    stage = SCENES[scene](3, 3, False)
    return Cloth.of(stage.truth, stage.model.density)


@pytest.mark.parametrize("scene", ["square", "skirt"])
def test_what_is_sewn_into_a_place_of_the_cloth_pulls_there(scene):
    """A skirt is a tube: the middle of its coordinates is in the air."""
    cloth = cloth_of(scene)
    pull = np.linalg.norm(shaker(cloth.vertices, np.zeros_like(cloth.vertices), 0.1, cloth), axis=1)
    full = np.linalg.norm((3.0, 1.0, 6.0)) * cloth.mass
    assert (pull / full).max() == pytest.approx(1.0)
    felt = pull > 0.1 * full
    assert 0.02 < cloth.mass[felt].sum() / cloth.mass.sum() < 0.3


def test_each_changes_cloth_by_a_force_worth_noticing():
    """At rest and turning, on the square: a twentieth of its weight on some vertex."""
    stage = square(3, 3, False)
    cloth = Cloth.of(stage.truth, stage.model.density)
    turning = np.cross((0.0, 3.0, 1.0), cloth.vertices)
    for name, force in FORCES.items():
        pull = force(cloth.vertices, turning, 0.1, cloth)
        assert pull.shape == cloth.vertices.shape and np.isfinite(pull).all(), name
        assert (np.linalg.norm(pull, axis=1) > 0.05 * 9.81 * cloth.mass).any(), name
    assert {HIDDEN[name].outside for name in FORCES} == set(FORCES)
