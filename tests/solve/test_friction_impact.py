"""Friction of cloth that strikes a body and leaves it: however short the contact, friction takes mu times as much
momentum along the body as the push gave across it (Coulomb's law, integrated over the impact)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.io.poses import PoseSequence
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import SDIRK2, ImplicitEuler
from caphy.solve.newton import Newton, Report
from caphy.solve.rollout import Simulator, State

MU, SPEED, SIDEWAYS = 0.3, 1.0, 2.0
EFFECTS = {"inertia": {}, "strain_stvk": {}, "body_contact": {}, "body_friction": {"coefficient": MU, "slip": 1e-3}}


RATES = [(ImplicitEuler, 30), (ImplicitEuler, 60), (SDIRK2, 30), (SDIRK2, 60)]


@pytest.mark.parametrize(
    ("integrator", "rate", "height"),
    [*((*each, height) for each in RATES for height in (0.010, 0.015, 0.020)), (SDIRK2, 7680, 0.015)],
)
def test_an_impact_slows_the_slide_by_mu_times_what_it_gives_back(integrator, rate, height, box_body, mat):
    still = PoseSequence(np.zeros((2, 55, 3)), np.zeros((2, 3)), 30.0)
    motion, potential = BodyMotion(box_body, still, mat), Potential(Model(0.2, EFFECTS), Cloth.of(mat, 0.2))
    x = torch.from_numpy(mat.vertices * [1, 0, 1] + [-0.1, height, 0])
    v = torch.tensor([SIDEWAYS, -SPEED, 0.0], dtype=torch.float64).expand_as(x)
    simulator = Simulator(Newton(potential, tolerance=1e-9), motion, integrator())
    state, reports = simulator.advance(State(0.0, x, v), 0.1, round(0.1 * rate))
    assert all(report.converged for report in reports)
    along, up = state.v[:, 0].mean().item(), state.v[:, 1].mean().item()
    assert SIDEWAYS - along == pytest.approx(MU * (up + SPEED), rel=0.02)


class HandedToAndFro:
    """Stands for a solver whose minimum jumps by ``jumps`` [m], one after the other, whatever the push."""

    fixed = None

    def __init__(self, potential, jumps):
        self.potential, self.jumps, self.asked = potential, list(jumps), 0

    def minimise(self, guess, step, body, least=0, curvature=None):
        self.asked += 1
        return guess + self.jumps[self.asked - 1], Report(True, 1, 0.0, "converged")


@pytest.mark.parametrize(
    ("jumps", "asked"),
    [([0.0, 3e-3, -3e-3, 3e-3, -3e-3], 3), ([0.0, 3e-3, -1e-3, 1e-6, 0], 4), ([0.0, 4e-3, -3e-3, 2e-3, -1e-3], 5)],
)
def test_friction_is_told_anew_while_that_moves_less_and_less(jumps, asked, box_body, mat):
    still = PoseSequence(np.zeros((2, 55, 3)), np.zeros((2, 3)), 30.0)
    motion, potential = BodyMotion(box_body, still, mat), Potential(Model(0.2, EFFECTS), Cloth.of(mat, 0.2))
    solver, x = HandedToAndFro(potential, jumps), torch.from_numpy(mat.vertices)
    _, (report,) = Simulator(solver, motion, ImplicitEuler()).advance(State(0.0, x, torch.zeros_like(x)), 1 / 30)
    assert solver.asked == report.iterations == asked
