"""What a minimisation promises, from guesses that test it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from caphy.effects.base import BodyState, Step
from caphy.effects.body_contact import braked, depth
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import irregular_cloth, moment
from caphy.errors import Diverged
from caphy.io.poses import PoseSequence
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import SDIRK2, State
from caphy.solve.newton import Curvature, Newton

ACTING = {name: {} for name in ("strain_stvk", "bending", "gravity", "inertia")}


def test_crumpled_cloth_finds_a_minimum(sheet):
    """Full Newton steps would diverge from there; at the end the exact Hessian is positive definite."""
    cloth = sheet(0.4, 0.4, 7, 7)
    newton = Newton(Potential(Model(0.2, ACTING), cloth), tolerance=1e-8)
    rng = np.random.default_rng(7)
    x = torch.from_numpy(cloth.vertices)
    for _ in range(3):
        guess = torch.from_numpy(0.5 * cloth.vertices + 0.03 * rng.normal(size=cloth.vertices.shape))
        step = Step.implicit_euler(0.05, x, x)
        found, report = newton.minimise(guess, step)
        assert report.converged, report
        energy, gradient = newton.potential.gradient(found, step)
        assert float(gradient.abs().max()) <= 1e-8
        assert float(energy) < float(newton.potential.gradient(guess, step)[0])
        hessian = newton.hessian
        assert np.linalg.eigvalsh(hessian.matrix(hessian.values(found, step, projection=0.0)).toarray())[0] > 0


def test_contact_is_balanced_where_the_cloth_has_gone(sheet):
    """Sliding 1.5 mm over a ball in one step: forces balance with the planes of the end, not those of the guess."""
    cloth = sheet(0.05, 0.05, 6, 6)
    newton = Newton(Potential(Model(0.2, ACTING | {"body_contact": {}}), cloth), tolerance=1e-7)
    radius = 0.03

    def ball(x):
        normal = x / x.norm(dim=1, keepdim=True)
        return BodyState(radius * normal, normal, torch.zeros_like(x), x)

    flat = torch.from_numpy((cloth.vertices - [0.025, 0.025, 0])[:, [0, 2, 1]] * [1, 1, -1] + [0, radius + 0.0035, 0])
    step = Step(1 / 30, flat, flat + torch.tensor([0.0015, -0.01, 0.0]), flat, torch.zeros_like(flat))
    x, report = newton.minimise(flat, step, ball)
    assert report.converged
    unbalanced = newton.potential.gradient(x, step, ball(x))[1].abs().max()
    assert float(unbalanced) < 1e-4
    assert float((x - flat).norm(dim=1).max()) > 1e-3


def test_no_step_passes_through_a_body(box_body, mat):
    """Inertia wants the cloth a metre below, behind a box 0.4 m thick."""
    poses = PoseSequence(np.zeros((2, 55, 3)), np.zeros((2, 3)), 30.0)
    motion = BodyMotion(box_body, poses, mat)
    newton = Newton(Potential(Model(0.2, ACTING | {"body_contact": {}}), Cloth.of(mat, 0.2)))
    x = torch.from_numpy(mat.vertices)
    step = Step(1 / 30, x, x - torch.tensor([0.0, 1.0, 0.0]), x, torch.zeros_like(x))
    found, report = newton.minimise(x, step, lambda positions: motion.state(0.0, positions.numpy(), 1 / 30))
    assert report.converged
    assert float(found[:, 1].min()) > -0.02


def test_tangents_project_as_little_as_they_must(sheet):
    """Cloth crumpled so far that neither the exact Hessian nor the nearest mixture is positive definite."""
    cloth = sheet(0.4, 0.4, 7, 7)
    newton = Newton(Potential(Model(0.2, ACTING), cloth))
    random, x = np.random.default_rng(7), torch.from_numpy(cloth.vertices)
    step = Step.implicit_euler(0.013, x, x)
    crumpled = torch.from_numpy(0.997 * cloth.vertices + 0.001 * random.normal(size=cloth.vertices.shape))
    lowest = {p: np.linalg.eigvalsh(_dense(newton, crumpled, step, p))[0] for p in (0.0, 1e-6, 0.5)}
    assert lowest[0.0] < 0 and lowest[1e-6] < 0 < lowest[0.5]
    right = random.normal(size=cloth.vertices.shape)
    expected = np.linalg.solve(_dense(newton, crumpled, step, 0.5), right.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(newton.factorize(crumpled, step).solve(right), expected, rtol=1e-8)


def _dense(newton, x, step, projection):
    return newton.hessian.matrix(newton.hessian.values(x, step, projection=projection)).toarray()


def test_cloth_that_strikes_a_body_is_not_pressed_in_first(sheet, monkeypatch):
    """Ball and cloth meet at 2 m/s in a stage of 5 ms. The minimum is the same, and more iterations lead there if the
    first step knows nothing of contact."""
    cloth = sheet(0.2, 0.2, 9, 9)
    newton = Newton(Potential(Model(0.2, ACTING | {"body_contact": {}}), cloth))
    radius = 0.1

    def ball(x):
        normal = x / x.norm(dim=1, keepdim=True)
        return BodyState(radius * normal, normal, torch.zeros_like(x), x)

    flat = torch.from_numpy((cloth.vertices - [0.1, 0.1, 0])[:, [0, 2, 1]] * [1, 1, -1] + [0, radius + 0.005, 0])
    step = Step(0.005, flat, flat - torch.tensor([0.0, 0.01, 0.0]), flat, torch.zeros_like(flat))
    x, report = newton.minimise(flat, step, ball)
    monkeypatch.setattr("caphy.solve.newton.braked", lambda e, p, move, hold: move)
    pressed, other = newton.minimise(flat, step, ball)
    assert report.converged and other.converged
    assert report.iterations < other.iterations
    assert float((x - pressed).abs().max()) < 1e-5
    assert float((x - flat).norm(dim=1).max()) > 5e-3


def test_a_vertex_stops_where_push_and_hold_balance():
    """3 k a u^2 = hold (U - u), told by a root finder; what moves outwards or stays above is left alone."""
    cloth = irregular_cloth()
    at = moment(cloth)
    potential = Potential(Model(0.2, {"body_contact": {}}), cloth)
    ((_, term, elements),) = potential.acting(at.x, at.step, at.body)
    normal, begun = at.body.normal, depth(elements, term.values["distance"])
    rng = np.random.default_rng(3)
    far = torch.from_numpy(rng.normal(scale=0.01, size=len(at.x)))
    move = -far[:, None] * normal + torch.linalg.cross(normal, torch.ones_like(normal)) * 1e-3
    hold = torch.from_numpy(rng.uniform(1, 50, size=len(at.x)))
    less = move.T - braked(elements, term.values, move.T, hold)
    stiffness = 3 * float(term.values["stiffness"]) * term.rest["area"]
    stopped = 0
    for vertex in range(len(at.x)):
        over = float(far[vertex] + min(float(begun[vertex]), 0.0))
        expected = 0.0
        if over > 0:
            k, h = float(stiffness[vertex]), float(hold[vertex])
            expected = over - brentq(lambda u, k=k, h=h, over=over: k * u * u - h * (over - u), 0, over)
            stopped += 1
        assert np.allclose(less[:, vertex], -expected * normal[vertex], atol=1e-12)
    assert 0 < stopped < len(at.x)


def test_the_last_factor_ends_what_is_nearly_done(sheet, monkeypatch):
    """Fewer matrices than iterations, and the minimum that a tighter tolerance finds."""
    cloth = sheet(0.4, 0.4, 9, 9)
    x = torch.from_numpy(cloth.vertices)
    shaken = torch.from_numpy(0.003 * np.sin(9 * cloth.vertices[:, [1, 2, 0]]) + [0, 0.02, 0.01])
    step = Step(0.02, x, x + shaken, x, torch.zeros_like(x))
    newton = Newton(Potential(Model(0.2, ACTING), cloth))
    factors = []
    factorize = newton.hessian.factorize
    monkeypatch.setattr(newton.hessian, "factorize", lambda *given: factors.append(1) or factorize(*given))
    found, report = newton.minimise(x, step)
    assert report.converged
    assert len(factors) < report.iterations
    exact, _ = newton.within(1e-9).minimise(found, step)
    assert float((found - exact).abs().max()) < 1e-5


def test_a_factor_is_handed_from_step_to_step(sheet, monkeypatch):
    """Fewer matrices than minimisations where steps are short, and the same motion; not to another step length."""
    cloth = sheet(0.4, 0.4, 9, 9)
    newton = Newton(Potential(Model(0.2, ACTING), cloth))
    x = torch.from_numpy(cloth.vertices)
    shaken = torch.from_numpy(0.3 * np.sin(9 * cloth.vertices[:, [1, 2, 0]]) + [0, 1.0, 0.5])
    factors = []
    factorize = newton.hessian.factorize
    monkeypatch.setattr(newton.hessian, "factorize", lambda *given: factors.append(1) or factorize(*given))

    def solved(step, curvature):
        return newton.minimise(step.target, step, least=1, curvature=curvature)[0]

    def rolled(curvature):
        factors.clear()
        state = State(0.0, x, shaken)
        for _ in range(6):
            state = SDIRK2().advance(state, 0.002, lambda step, _: solved(step, curvature))
        return state.x, len(factors)

    (alone, many), (handed, few) = rolled(None), rolled(Curvature())
    assert many >= 12 and few <= 6
    assert float((alone - handed).abs().max()) < 1e-5
    assert float((alone - x).abs().max()) > 1e-2
    curvature = Curvature()
    curvature.begin(Step.implicit_euler(0.002, x, x))
    curvature.renew(newton.factorize(x, Step.implicit_euler(0.002, x, x)))
    assert curvature.helps
    curvature.begin(Step.implicit_euler(0.001, x, x))
    assert not curvature.helps


def test_an_earlier_factor_is_corrected_along_the_moves_since(sheet):
    """The last change of a gradient asks for just the move that made it; before, it asked for another."""
    cloth = sheet(0.4, 0.4, 5, 5)
    newton = Newton(Potential(Model(0.2, ACTING), cloth))
    x, random = torch.from_numpy(cloth.vertices), np.random.default_rng(3)
    step = Step.implicit_euler(0.01, x, x)
    curvature = Curvature()
    curvature.begin(step)
    curvature.renew(newton.factorize(x, step))
    other = newton.hessian.matrix(newton.hessian.values(x, Step.implicit_euler(0.007, x, x)))
    for _ in range(3):
        move = random.normal(size=x.shape)
        change = (other @ move.ravel()).reshape(move.shape)
        assert np.abs(curvature.solve(change) + move).max() > 0.1
        curvature.learn(
            SimpleNamespace(x=x, gradient=np.zeros_like(move), residual=1.0),
            SimpleNamespace(x=x + torch.from_numpy(move), gradient=change, residual=0.1),
        )
        np.testing.assert_allclose(curvature.solve(change), -move, atol=1e-9)


@pytest.mark.parametrize("statics", [False, True])
def test_a_slope_that_is_no_number_is_named_and_not_gone_along(sheet, monkeypatch, statics):
    """As of a root at zero in an effect of one's own, whose energy is finite there."""
    cloth = sheet(0.2, 0.2, 4, 4)
    newton = Newton(Potential(Model(0.2, ACTING), cloth))
    values = newton.hessian.values

    def spoilt(*given, **more):
        found = values(*given, **more).copy()
        found[len(found) // 2, 1, 1] = np.nan
        return found

    monkeypatch.setattr(newton.hessian, "values", spoilt)
    x = torch.from_numpy(cloth.vertices)
    with pytest.raises(Diverged, match="finite slope"):
        newton.minimise(1.1 * x, None if statics else Step.implicit_euler(1 / 30, x, x))
    with pytest.raises(Diverged, match="finite slope"):
        newton.factorize(x, None)


def test_an_energy_that_falls_without_bound_is_said_to(sheet):
    """More negative stiffness of the threads than the cloth has: nothing is amiss with its derivatives."""
    cloth = sheet(0.4, 0.4, 5, 5)
    model = Model(0.2, ACTING | {"weft_warp_stiffness": {"weft": -1e4, "warp": -1e4}})
    x = torch.from_numpy(cloth.vertices)
    shaken = x + 0.01 * torch.from_numpy(np.random.default_rng(0).normal(size=x.shape))
    with pytest.raises(Diverged, match=r"falls without bound: .* negative weft_warp_stiffness\.weft and weft_warp"):
        Newton(Potential(model, cloth)).minimise(shaken, None)
