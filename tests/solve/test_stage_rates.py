"""What the second stage of SDIRK2 takes for rates: of strain, of bending, and of the body beneath."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import flat_cloth, irregular_cloth
from caphy.measure.mesh_body import MeshBody
from caphy.solve.integrators import SDIRK2, State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator

DT, SPIN = 1 / 60, 10.0


def turned(x: Tensor, time: float) -> Tensor:
    """Positions (V, 3) [m] turned about the vertical, by 10 rad/s."""
    c, s = np.cos(SPIN * time), np.sin(SPIN * time)
    return x @ torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def stages(path) -> list[tuple[Step, Tensor]]:
    """The two minimisations of a step of cloth that follows a path whatever is asked of it."""
    found = []

    def solve(step: Step, time: float) -> Tensor:
        found.append((step, path(time)))
        return path(time)

    nudge = 1e-6
    SDIRK2().advance(State(0.0, path(0.0), (path(nudge) - path(-nudge)) / (2 * nudge)), DT, solve)
    return found


RATES = ["viscous_damping", "bending_damping", "hysteresis", "plastic_crease"]


def of_effect(effect: str, cloth: Cloth) -> Potential:
    """Its potential, with the bending that creases ask for."""
    return Potential(Model(cloth.density, {"bending": {}, effect: {}}), cloth)


@pytest.mark.parametrize("effect", RATES)
def test_cloth_that_turns_without_deforming_is_not_damped(effect):
    """Against the origin of the second stage, where no cloth ever was, its strain changed by half the squared angle."""
    cloth = irregular_cloth()
    folded = torch.tensor(cloth.vertices * (1.0, 1.0, 3.0))
    potential = of_effect(effect, cloth)
    for step, x in stages(lambda time: turned(folded, time)):
        assert float(potential.energies(x, step)[effect]) < 1e-20
        assert float(potential.term_gradient(effect, x, step, None).abs().max()) < 1e-10


@pytest.mark.parametrize("effect", RATES)
def test_the_rate_of_a_stage_has_the_gradient_of_its_energy(effect):
    """Kernels included, at a lead, by differences of the effects' own energies."""
    cloth, random = irregular_cloth(), torch.Generator().manual_seed(1)
    rest = torch.tensor(cloth.vertices)
    noisy = [rest + 2e-3 * torch.randn(rest.shape, generator=random, dtype=torch.float64) for _ in range(4)]
    step = Step(0.005, noisy[1], noisy[1], noisy[2], torch.zeros_like(rest), lead=2.4)
    potential = of_effect(effect, cloth)
    gradient = potential.term_gradient(effect, noisy[0], step, None)
    along, by = noisy[3] - rest, 1e-4
    up, down = (potential.energies(noisy[0] + sign * by * along, step)[effect] for sign in (1, -1))
    assert float((gradient * along).sum()) == pytest.approx(float(up - down) / (2 * by), rel=1e-5)
    still = potential.energies(noisy[0], replace(step, lead=0.0))[effect]
    assert float(potential.energies(noisy[0], step)[effect]) != pytest.approx(float(still), rel=0.05)


def test_cloth_that_sticks_to_what_speeds_up_stays_where_it_sticks():
    """On a plate that comes to move at 1 m/s; by the plate's mean velocity of the last stage it fell behind by 5 mm."""
    flat, fps = flat_cloth(6, 5), 30.0
    lying = flat.vertices[:, [0, 2, 1]] * (1, 1, -1)
    cloth = Cloth(lying, flat.faces, flat.material, 0.2, flat.layer_thickness, flat.attached)
    times = np.arange(31) / fps
    shift = 1.07 * np.clip(times - 0.5, 0, None) ** 2  # once the cloth has come to rest
    corners = np.array([[-3, 0, 3], [3, 0, 3], [3, 0, -3], [-3, 0, -3], [0, -1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]], dtype=np.int32)
    plate = MeshBody(corners + np.stack([shift, 0 * times, 0 * times], -1)[:, None], faces, fps)
    effects = {"gravity": {}, "inertia": {}, "strain_stvk": {}, "body_contact": {}, "body_friction": {"coefficient": 2}}
    potential = Potential(Model(cloth.density, effects), cloth)
    simulator = Simulator(Newton(potential), plate)  # pyright: ignore[reportArgumentType]
    start = torch.tensor(cloth.vertices) + torch.tensor([0.0, 0.004 - cloth.vertices[:, 1].mean(), 0.0])
    state = State(0.0, start, torch.zeros_like(start))
    for _ in range(30):
        state, _ = simulator.advance(state, 1 / fps)
    slipped = (state.x - start)[:, 0] - shift[-1]
    crept = 0.5 * 0.01 * 2 * 1.07 / (2 * 9.81)  # half a second below the slip speed, by the share of friction in use
    assert float((slipped + crept).abs().max()) < 2e-4


def test_a_body_s_velocity_in_a_stage_is_that_of_cloth_on_it():
    path = np.cumsum(np.random.default_rng(0).normal(size=(12, 1, 3)), axis=0) * 0.01
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1], [0, -1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]], dtype=np.int32)
    body = MeshBody(corners + path, faces, 1 / DT)
    rest = torch.tensor([[0.1, 0.0, 0.2], [-0.2, 0.0, 0.1]])

    def on_it(time: float) -> Tensor:
        return rest + torch.from_numpy(body.vertices(4 * DT + time)[4] - body.vertices(4 * DT)[4])

    for step, x in stages(on_it):
        seen: BodyState = body.state(4 * DT + float(step.time), x.numpy(), step.dt, float(step.lead))
        torch.testing.assert_close(seen.velocity, (x - step.origin) / step.dt, rtol=0, atol=1e-9)
