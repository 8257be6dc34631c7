"""Over-trained on one short clip the network moves as the solver does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.network.garment_network import GarmentNetwork
from caphy.training.motions import Motions
from caphy.training.objective import Objective
from caphy.training.overtrain import overtrain
from caphy.training.reference import compare_with_solver
from caphy.training.validate import static_drape, stream_drift

FRAMES, STEPS = 8, 900


def test_overtrained_network_moves_as_the_solver():
    torch.manual_seed(0)
    garment, body, clip = tube(), default_body(), swaying(FRAMES)
    model = snug_model()
    potential = Potential(model, Cloth.of(garment, model.density))
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, layers=2, width=64)
    motions = Motions.of([clip], body, network.driving, 30.0)
    quick = Potential(model, potential.cloth, torch.float32)
    objective = Objective(quick, body, network.template, network.weights, 30.0)
    before = compare_with_solver(network, potential, body, garment, clip)
    assert overtrain(network, objective, motions, STEPS) == STEPS
    after = compare_with_solver(network, potential, body, garment, clip)
    assert np.median(after.correction) < 0.15 * np.median(before.correction)
    # Of each frame as low as the solver gets from the network's own past. The solver's own trajectory starts 3 mm away
    # along the static drape's flat valley, where this network does not get to: there it is lower by another 1 %.
    excess = (after.network - after.corrected).mean() / (after.template - after.corrected).mean()
    assert -1e-6 < excess < 0.005
    assert 0.98 < after.summary()["share_of_solver_s_decrease"] < 1.005


@pytest.mark.parametrize(("keep", "forgets"), [(-3.0, True), (6.0, False)])
def test_drift_tells_a_network_that_forgets_from_one_that_does_not(keep, forgets):
    """The bias of the update gate sets how much of the hidden state each frame keeps."""
    torch.manual_seed(0)
    garment, body = tube(), default_body()
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, layers=2, width=16)
    torch.nn.init.normal_(network.head.weight, std=0.01)
    for layer in range(2):
        getattr(network.gru, f"weight_hh_l{layer}").data.mul_(0.3)
        getattr(network.gru, f"bias_ih_l{layer}").data[16:32] = keep
    poses, transl = (torch.tensor(np.array(a), dtype=torch.float32) for a in (swaying(30).poses, swaying(30).transl))
    assert (stream_drift(network, poses, transl, frames=300) < 1e-5) == forgets
    early, late = (static_drape(network, poses[7], transl[7], frames) for frames in (30, 60))
    assert ((early - late).abs().max() < 1e-5) == forgets
