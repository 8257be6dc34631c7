"""A cloth dropped on a sphere, against the balance of forces."""

import numpy as np
import torch

from caphy.effects.base import BodyState
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.solve.integrators import ImplicitEuler
from caphy.solve.newton import Newton
from caphy.solve.rollout import State

DENSITY, RADIUS, DISTANCE, STIFFNESS = 0.2, 0.08, 0.004, 1e8


def sphere(x):
    """A sphere at rest around the origin, as cloth at x sees it."""
    normal = x / x.norm(dim=1, keepdim=True)
    return BodyState(RADIUS * normal, normal, torch.zeros_like(x), x)


def pushes(x, area):
    """Contact forces (V, 3) [N] by the law of the effect, from the distances to the sphere: pressure 3 k d^2."""
    away = np.linalg.norm(x, axis=1)
    depth = np.clip(DISTANCE + RADIUS - away, 0, None)
    return (3 * STIFFNESS * area * depth**2 / away)[:, None] * x


def test_a_cloth_dropped_on_a_sphere_comes_to_rest(sheet):
    """Friction keeps it from sliding off, air damps its swinging."""
    cloth = sheet(0.5, 0.5, 15, 15)
    acting = ("strain_stvk", "bending", "gravity", "inertia", "body_contact", "body_friction")
    model = Model(DENSITY, {name: {} for name in acting} | {"mass_damping": {"rate": 5.0}})
    newton = Newton(Potential(model, cloth), tolerance=1e-6)
    flat = (cloth.vertices - [0.25, 0.25, 0])[:, [0, 2, 1]] * [1, 1, -1] + [0, RADIUS + 0.05, 0]
    state = State(0.0, torch.from_numpy(flat), torch.zeros(flat.shape, dtype=torch.float64))

    def solve(step, time):
        x, report = newton.minimise(step.target, step, sphere)
        assert report.converged, report
        return x

    for _ in range(60):
        state = ImplicitEuler().advance(state, 1 / 30, solve)
    x = state.x.numpy()
    assert float(state.v.norm(dim=1).max()) < 0.02
    assert x[:, 1].min() < -0.05  # it hangs down the sides
    weight = DENSITY * 0.25 * 9.81
    np.testing.assert_allclose(pushes(x, cloth.vertex_area).sum(0), [0, weight, 0], atol=2e-3 * weight)
    deepest = np.sqrt(weight / (3 * STIFFNESS * cloth.vertex_area.min()))  # were all the weight on one vertex
    assert np.linalg.norm(x, axis=1).min() > RADIUS + DISTANCE - deepest > RADIUS
