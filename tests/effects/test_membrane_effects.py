"""Damping, stiffness and shrinkage in the plane of the cloth against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from situations import DENSITY, gradient, moving, rolled_out

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import flat_cloth, grid, irregular_cloth, moment
from caphy.solve.integrators import State


def stretched(cloth: Cloth, u: float, v: float = 1.0) -> torch.Tensor:
    return torch.as_tensor(cloth.vertices * (u, v, 1))


def tension(cloth: Cloth, x: torch.Tensor, axis: int, **options: Any) -> float:
    """Force per width [N/m] on the far edge of a flat cloth."""
    size = (0.12, 0.1)
    edge = cloth.vertices[:, axis] > size[axis] - 1e-9
    return float(gradient(cloth, x, **options)[edge, axis].sum()) / size[1 - axis]


def test_thread_stiffness_is_tension_along_its_thread() -> None:
    cloth, s = flat_cloth(), 1.08
    strain = (s * s - 1) / 2
    effect: Any = {"weft": 13.0, "warp": 7.0}
    for axis, k in enumerate((13.0, 7.0)):
        x = stretched(cloth, *((s, 1.0), (1.0, s))[axis])
        assert tension(cloth, x, axis, weft_warp_stiffness=effect) == pytest.approx(k * s * strain, rel=1e-12)
        assert tension(cloth, x, 1 - axis, weft_warp_stiffness=effect) == pytest.approx(0, abs=1e-12)


def test_stiffening_is_the_cube_of_strain() -> None:
    cloth, s = flat_cloth(), 1.1
    strain = (s * s - 1) / 2
    got = tension(cloth, stretched(cloth, s), 0, strain_stiffening={"stiffness": 900.0})
    assert got == pytest.approx(900 * s * strain**3, rel=1e-12)


def test_shear_stiffness_is_that_of_stvk() -> None:
    cloth = flat_cloth()
    x = torch.as_tensor(cloth.vertices).clone()
    x[:, 0] += 0.1 * x[:, 1]
    energies = Potential(Model(DENSITY, {"shear_stiffness": {"stiffness": 6.0}}), cloth).energies(x)
    assert float(energies["shear_stiffness"]) == pytest.approx(0.012 * 6 / 2 * 0.1**2, rel=1e-12)


def test_viscous_damping_of_a_stretched_strip() -> None:
    """The first axial mode decays at eta q^2 / (2 rho), q its discrete wave number, and still swings as before."""
    mu, eta, length, rows = 10.0, 0.4, 1.0, 10
    vertices, faces = grid(2, rows, 0.1, length)
    zeros = np.zeros(len(vertices))
    cloth = Cloth(vertices, faces, vertices[faces][..., :2], DENSITY, zeros, zeros)
    effects: dict[str, Any] = {
        "inertia": {},
        "strain_stvk": {"lame_lambda": 0.0, "lame_mu": mu},
        "viscous_damping": {"viscosity": eta},
    }
    y = vertices[:, 1]
    q = 2 / (length / rows) * np.sin(np.pi / (4 * rows))
    rate, free = eta * q**2 / (2 * DENSITY), q * np.sqrt(2 * mu / DENSITY)
    swing = np.sqrt(free**2 - rate**2)
    x = torch.from_numpy(vertices + np.outer(1e-5 * np.sin(np.pi / 2 * y / length), [0, 1, 0]))
    t = 2 * np.pi / swing
    state, _ = rolled_out(
        Potential(Model(DENSITY, effects), cloth),
        State(0.0, x, torch.zeros_like(x)),
        50,
        t / 50,
        fixed=y == 0,
        tolerance=1e-12,
    )
    tip = float(state.x[int(np.argmax(y)), 1] - length) / 1e-5
    assert tip == pytest.approx(np.exp(-rate * t), rel=0.01)
    assert tip < 0.4


def test_viscous_damping_spares_rotation() -> None:
    cloth = irregular_cloth()
    x = torch.as_tensor(cloth.vertices)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]], dtype=torch.float64))
    step = moving(x @ turn.T, torch.zeros(3))
    step = type(step)(step.dt, x, x, x, x)
    for name in ("viscous_damping", "hysteresis", "bending_damping"):
        assert float(gradient(cloth, x @ turn.T, step, **{name: {}}).abs().max()) < 1e-13


def test_hysteresis_takes_on_loading_what_it_withholds_on_unloading() -> None:
    cloth, s, tau = flat_cloth(), 1.05, 0.7
    for sign in (1, -1):
        before = stretched(cloth, s - sign * 1e-3)
        step = moving(before, torch.zeros(3))
        got = tension(cloth, stretched(cloth, s), 0, step=step, hysteresis={"friction": tau, "slip": 1e-5})
        assert got == pytest.approx(sign * tau * s, rel=1e-6)


STIFFENED: dict[str, Any] = {
    "weft_warp_stiffness": {"weft": 60.0, "warp": 20.0},
    "shear_stiffness": {"stiffness": 9.0},
    "strain_stiffening": {},
}


@pytest.mark.parametrize("stiffened", [{}, STIFFENED], ids=["plain", "stiffened"])
@pytest.mark.parametrize("membrane", ["strain_stvk", "strain_measured"])
@pytest.mark.parametrize(("weft", "warp"), [(0.05, 0.05), (0.08, 0.0), (-0.04, 0.1)])
def test_shrunk_cloth_is_cloth_cut_smaller(membrane: str, weft: float, warp: float, stiffened: dict) -> None:
    cloth = irregular_cloth()
    cut = Cloth(
        cloth.vertices,
        cloth.faces,
        cloth.material * (1 - weft, 1 - warp),
        cloth.density,
        cloth.layer_thickness,
        cloth.attached,
    )
    x = moment(cloth).x
    elastic = {membrane: {}, **stiffened}
    wanted = gradient(cut, x, **elastic)
    got = gradient(cloth, x, **elastic, shrinkage_directional={"weft": weft, "warp": warp})
    torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-12)
    if weft == warp:
        one = gradient(cloth, x, **elastic, shrinkage={"fraction": weft})
        torch.testing.assert_close(one, wanted, rtol=1e-9, atol=1e-12)


def test_shrunk_cloth_rests_at_its_new_lengths() -> None:
    cloth = flat_cloth()
    effects: Any = {"strain_stvk": {}, "shrinkage_directional": {"weft": 0.1, "warp": 0.04}}
    force = gradient(cloth, stretched(cloth, 0.9, 0.96), **effects)
    assert float(force.abs().max()) < 1e-14
