"""The measured fabrics as an energy: the measured work along the loading, and StVK where the table says so."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from published_stretching import stretching_stiffness

from caphy.effects.membrane import Membrane
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.strain_measured import StrainMeasured, energy_density
from caphy.effects.trial import irregular_cloth, moment
from caphy.material.fabrics import fabric, fabric_names


def density(strain: np.ndarray, table: np.ndarray) -> float:
    return float(energy_density(tuple(torch.as_tensor(strain, dtype=torch.float64)), torch.as_tensor(table)))


def test_an_isotropic_table_is_stvk() -> None:
    lam, mu = 20.9, 11.1
    table = np.tile([(lam + 2 * mu) / 2, lam / 2, (lam + 2 * mu) / 2, mu], (6, 1))
    cloth = irregular_cloth()
    x = moment(cloth, noise=0.004).x
    measured = Potential(Model(0.2, {"strain_measured": {"stretching": table}}), cloth).gradient(x)
    stvk = Potential(Model(0.2, {"strain_stvk": {"lame_lambda": lam, "lame_mu": mu}}), cloth).gradient(x)
    torch.testing.assert_close(measured, stvk, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", fabric_names())
@pytest.mark.parametrize(
    "strain", [(0.1, 0, 0), (0, 0.1, 0), (0.3, 0, 0), (0.1, -0.02, 0), (0.1, 0.1, 0.1), (0.02, 0.02, -0.15)]
)
def test_energy_is_the_measured_work(name: str, strain: tuple[float, float, float]) -> None:
    """Quadrature of S(tau G) : G over the published interpolation; what differs is the rounding of its corners."""
    table, g = fabric(name).stretching, np.array(strain, dtype=float)
    tau = (np.arange(4000) + 0.5) / 4000
    k = stretching_stiffness(table, tau[:, None] * g)
    quadratic = np.array([g[0] ** 2, 2 * g[0] * g[1], g[1] ** 2, 2 * g[2] ** 2])
    work = (tau * (k @ quadratic)).mean()
    assert density(g, table) == pytest.approx(work, rel=0.05)


@pytest.mark.parametrize("name", fabric_names())
def test_energy_is_never_negative(name: str) -> None:
    table = torch.as_tensor(fabric(name).stretching)
    g, shear = torch.linspace(-0.3, 0.5, 33, dtype=torch.float64), torch.linspace(0, 0.4, 17, dtype=torch.float64)
    uu, vv, uv = torch.meshgrid(g, g, shear, indexing="ij")
    possible = (1 + 2 * uu) * (1 + 2 * vv) - 4 * uv * uv > 0
    assert float(energy_density((uu[possible], vv[possible], uv[possible]), table).min()) >= 0


def test_a_stiffness_of_nothing_that_falls_below_it_stays_nothing() -> None:
    """As one next to nothing does, and as the kernels have it."""
    table = fabric("gray-interlock").stretching.copy()
    table[1:, 1] = -5.0
    cloth = irregular_cloth()
    there, found = moment(cloth, noise=0.004), []
    for rest in (0.0, 1e-9, -1e-9):
        table[0, 1] = rest
        potential = Potential(Model(0.2, {"strain_measured": {"stretching": table}}), cloth)
        (energy,) = potential.energies(there.x, None, None).values()
        assert float(potential.gradient(there.x)[0].sum()) == pytest.approx(float(energy.sum()), rel=1e-9)
        found.append(float(energy.sum()))
    assert found == pytest.approx([found[1]] * 3, rel=1e-6)


@pytest.mark.parametrize("name", fabric_names())
def test_stress_does_not_jump(name: str) -> None:
    """All ways around at strains within and beyond the table: over a tenth of the way stress changes by a tenth."""
    table = torch.as_tensor(fabric(name).stretching)
    for mean, radius in ((0.05, 0.3), (0.1, 0.05), (0.3, 0.1), (-0.02, 0.15)):
        changes = []
        for count in (4001, 40001):
            angle = torch.linspace(0, torch.pi, count, dtype=torch.float64)
            strain = (mean + radius * angle.cos(), mean - radius * angle.cos(), radius * angle.sin())
            (suu, svv, suv), _ = StrainMeasured()._responded(strain, None, {"stretching": table})
            changes.append(float(torch.stack([suu, svv, suv]).diff(dim=1).abs().max()))
        assert changes[1] < 0.15 * changes[0]


def test_shear_of_either_sense_costs_the_same() -> None:
    table = fabric("ivory-rib-knit").stretching
    assert density(np.array([0.05, 0.02, 0.04]), table) == density(np.array([0.05, 0.02, -0.04]), table)


@pytest.mark.parametrize("name", fabric_names())
def test_compiled_stress_and_tangent_are_torch_s_derivatives_of_the_density(name: str) -> None:
    """At strains of all sizes, in both signs, some beyond the table and some where a stiffness is clamped at zero."""
    random = np.random.default_rng(0)
    sizes = 10.0 ** random.uniform(-7, -0.3, 3000)
    strain = tuple(torch.as_tensor(part) for part in random.normal(size=(3, 3000)) * sizes)
    effect, p = StrainMeasured(), {"stretching": torch.as_tensor(fabric(name).stretching)}
    for found, wanted in zip(
        effect._responded(strain, None, p), Membrane._responded(effect, strain, None, p), strict=True
    ):
        torch.testing.assert_close(torch.stack(found), torch.stack(wanted), rtol=1e-9, atol=1e-7)
