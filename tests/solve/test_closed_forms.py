"""Simulated cloth against closed forms of mechanics."""

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.solve.integrators import SDIRK2, ImplicitEuler, State
from caphy.solve.newton import TOLERANCE, Newton
from caphy.solve.rollout import Simulator
from caphy.solve.statics import drape

DENSITY = 0.2


def solver(cloth, effects, fixed=None, **options):
    return Newton(Potential(Model(DENSITY, effects), cloth), fixed, **options)


@pytest.mark.parametrize(("integrator", "steps"), [(ImplicitEuler(), 7), (SDIRK2(), 7)])
def test_free_fall(sheet, integrator, steps):
    """Euler's discrete solution is -g h^2 n (n + 1) / 2; SDIRK2 is exact."""
    cloth, h = sheet(0.3, 0.3, 4, 4), 0.05
    newton = solver(cloth, {"strain_stvk": {}, "bending": {}, "gravity": {}, "inertia": {}}, tolerance=1e-11)
    x = torch.from_numpy(cloth.vertices.copy())
    state, simulator = State(0.0, x, torch.zeros_like(x)), Simulator(newton, integrator=integrator)
    for _ in range(steps):
        state, reports = simulator.advance(state, h)
        assert all(report.converged for report in reports)
    fallen = steps * (steps + 1) / 2 if isinstance(integrator, ImplicitEuler) else steps**2 / 2
    expected = x - torch.tensor([0, 9.81 * h**2 * fallen, 0], dtype=torch.float64)
    np.testing.assert_allclose(state.x, expected, atol=1e-9)


def test_fine_cloth_falls_too(sheet):
    """Where edges are 4 mm long the whole weight of a vertex is within the tolerance."""
    cloth, h, steps = sheet(0.04, 0.04, 11, 11), 1 / 60, 15
    newton = solver(cloth, {"strain_stvk": {}, "bending": {}, "gravity": {}, "inertia": {}})
    assert cloth.mass.max() * 9.81 < newton.tolerance
    x = torch.from_numpy(cloth.vertices.copy())
    state, simulator = State(0.0, x, torch.zeros_like(x)), Simulator(newton)
    for _ in range(steps):
        state, _ = simulator.advance(state, h)
    fallen = (x - state.x)[:, 1].numpy()
    np.testing.assert_allclose(fallen, 9.81 * h**2 * steps**2 / 2, rtol=1e-5)


@pytest.mark.parametrize(("length", "tolerance"), [(1.0, 1e-9), (0.08, TOLERANCE)], ids=["long", "fine"])
def test_heavy_hanging_strip(sheet, length, tolerance):
    """StVK without Poisson effect: mu s (s^2 - 1) = rho g (length below), element by element.

    The fine one's edges are 4 mm long, and the whole weight of a vertex within the tolerance.
    """
    mu, columns = 2.0 * length, 21
    cloth = sheet(length, 0.1 * length, columns, 3)
    fixed = cloth.vertices[:, 1] == 0
    newton = solver(
        cloth,
        {"strain_stvk": {"lame_lambda": 0.0, "lame_mu": mu}, "gravity": {"acceleration": (0.0, 9.81, 0.0)}},
        fixed,
        tolerance=tolerance,
    )
    x, report = drape(newton, torch.from_numpy(cloth.vertices.copy()))
    assert report.converged
    h = length / (columns - 1)
    below = length - h * (np.arange(columns - 1) + 0.5)
    stretches = [brentq(lambda s, b=b: mu * s * (s * s - 1) - DENSITY * 9.81 * b, 1, 9) for b in below]
    tip = x[cloth.vertices[:, 1] == length, 1]
    np.testing.assert_allclose(tip.mean() - length, h * np.sum(stretches) - length, rtol=1e-3)


def test_uniaxial_stretch_narrows_by_stvk_poisson_ratio(sheet):
    """Far from the clamps G_vv = -lambda / (lambda + 2 mu) G_uu."""
    lam, mu, stretch = 20.0, 10.0, 1.2
    cloth = sheet(1.0, 0.1, 61, 7)
    y = cloth.vertices[:, 1]
    fixed = (y == 0) | (y == 1)
    newton = solver(cloth, {"strain_stvk": {"lame_lambda": lam, "lame_mu": mu}}, fixed, tolerance=1e-8)
    start = cloth.vertices * [1, stretch, 1]
    x, report = drape(newton, torch.from_numpy(start))
    assert report.converged
    middle = np.abs(y - 0.5) < 1e-9
    width = np.ptp(x.numpy()[middle, 0]) / 0.1
    above = np.abs(y - 0.5) < 0.2
    along = np.polyfit(y[above], x.numpy()[above, 1], 1)[0]
    lateral = -lam / (lam + 2 * mu) * (along**2 - 1) / 2
    assert width == pytest.approx(np.sqrt(1 + 2 * lateral), rel=2e-4)


def test_axial_frequency_of_a_strip(sheet):
    """Fixed-free bar: omega = pi / (2 L) sqrt(2 mu / rho), lumped masses lower it by (k h)^2 / 24."""
    mu, length, columns = 10.0, 1.0, 11
    cloth = sheet(length, 0.1, columns, 3)
    y = cloth.vertices[:, 1]
    newton = solver(cloth, {"strain_stvk": {"lame_lambda": 0.0, "lame_mu": mu}, "inertia": {}}, y == 0, tolerance=1e-9)
    wave = np.pi / (2 * length)
    omega = 2 / (length / 10) * np.sin(wave * length / 20) * np.sqrt(2 * mu / DENSITY)
    shape = 1e-4 * np.sin(wave * y)
    x = torch.from_numpy(cloth.vertices + np.outer(shape, [0, 1, 0]))
    state, simulator = State(0.0, x, torch.zeros_like(x)), Simulator(newton, integrator=SDIRK2())
    period = 2 * np.pi / omega
    for _ in range(100):
        state, _ = simulator.advance(state, 1.25 * period / 100)
    tip = int(np.flatnonzero(y == length)[0])
    moved = (state.x.numpy() - cloth.vertices)[tip, 1] / 1e-4  # a quarter past a period: cos is zero, slope is -omega
    assert moved == pytest.approx(0, abs=0.01)
    assert float(state.v[tip, 1]) / 1e-4 == pytest.approx(-omega, rel=0.01)


def test_cantilever(equilateral_strip):
    """Small deflection of a narrow plate strip under its weight, w = rho g L^4 / (8 D (1 - nu^2)).

    Summed over the hinges of an equilateral mesh, k / 72 (3 kappa_n - kappa_t)^2 per direction is the energy of a
    plate of D = k / 4 and nu = -1/3 (on a cylinder k kappa^2 / 8, as the effect says). Square cells would do worse:
    their diagonals couple bending and twist, which softens a narrow strip to 0.8 k / 4.
    """
    k, columns, h = 4e-4, 41, 0.0025
    length = (columns - 1) * h
    cloth = equilateral_strip(columns, 5, h)
    y = cloth.vertices[:, 1]
    newton = solver(
        cloth,
        {
            "strain_stvk": {"lame_lambda": 0.0, "lame_mu": 50.0},
            "bending": {"stiffness_weft": k, "stiffness_warp": k},
            "gravity": {"acceleration": (0.0, 0.0, -0.2)},
        },
        y < 1.5 * h,  # two rows clamp the slope, so the strip bends from half a row behind the second
        tolerance=1e-10,
        max_iterations=200,
    )
    x, report = drape(newton, torch.from_numpy(cloth.vertices.copy()))
    assert report.converged
    tip = -float(x[y > length - h / 2, 2].mean())
    stiffness = k / 4 * (1 - 1 / 9)
    assert tip == pytest.approx(DENSITY * 0.2 * (length - h / 2) ** 4 / (8 * stiffness), rel=0.03)


@pytest.mark.parametrize("integrator", [ImplicitEuler(), SDIRK2()])
def test_momentum_is_conserved(sheet, integrator):
    cloth = sheet(0.4, 0.4, 7, 7)
    newton = solver(cloth, {"strain_stvk": {}, "bending": {}, "inertia": {}}, tolerance=1e-10)
    rng = np.random.default_rng(0)
    x = torch.from_numpy(cloth.vertices + 0.01 * rng.normal(size=cloth.vertices.shape))
    state = State(0.0, x, torch.from_numpy(rng.normal(size=x.shape)))
    mass = cloth.mass[:, None]
    before = (mass * state.v.numpy()).sum(0)
    simulator = Simulator(newton, integrator=integrator)
    for _ in range(5):
        state, _ = simulator.advance(state, 1 / 60)
    np.testing.assert_allclose((mass * state.v.numpy()).sum(0), before, atol=1e-9)


def test_pins_follow_their_path(sheet):
    cloth = sheet(0.3, 0.1, 7, 3)
    fixed = cloth.vertices[:, 1] == 0
    newton = solver(cloth, {"strain_stvk": {}, "bending": {}, "gravity": {}, "inertia": {}}, fixed)
    x = torch.from_numpy(cloth.vertices.copy())

    def path(time):
        return x[torch.from_numpy(fixed)] + torch.tensor([0.5 * time, 0, 0], dtype=torch.float64)

    simulator = Simulator(newton, pins=path)
    state, _ = simulator.advance(State(0.0, x, torch.zeros_like(x)), 0.1)
    np.testing.assert_allclose(state.x[torch.from_numpy(fixed)], path(0.1))
