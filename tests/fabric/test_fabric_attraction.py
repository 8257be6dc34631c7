"""The pull to scanned points: its derivatives, and what it leaves out."""

import numpy as np
import pytest
import torch

from benchmarks._panel import panel
from caphy.effects.cloth import Cloth
from caphy.effects.presets import fabric_model
from caphy.fabric.attraction import TERM, AttractedPotential, find_hits


@pytest.fixture
def pulled():
    """A rumpled panel's potential aimed at points around it, its positions, and the points."""
    random = np.random.default_rng(0)
    garment = panel(5)
    cloth = Cloth.of(garment, 0.2)
    x = garment.vertices + 0.004 * random.normal(size=garment.vertices.shape)
    points = garment.vertices[garment.faces].mean(axis=1) + np.array([0, 0.003, 0])
    hits = find_hits(points, np.tile([0.0, 1.0, 0.0], (len(points), 1)), x, cloth, 0.02)
    potential = AttractedPotential(fabric_model("gray-interlock"), cloth)
    potential.aim(hits, 700.0)
    return potential, torch.from_numpy(x), hits


def test_energy_is_half_the_pressure_times_squared_distance(pulled):
    potential, x, hits = pulled
    expected = 0.5 * 700.0 * (hits.area * hits.residual(x.numpy()) ** 2).sum()
    assert float(potential.energies(x)[TERM]) == pytest.approx(expected, rel=1e-9)
    assert hits.area.sum() == pytest.approx(potential.cloth.face_area.sum())  # every face of the panel has its point


def test_gradient_and_hessian_are_the_energy_s(pulled):
    potential, x, _ = pulled
    term = potential.terms[TERM]
    elements = potential.elements(term, x, None, None)
    gradient = potential.term_gradients(x)[TERM]
    moved = x.clone().requires_grad_(True)
    potential.elements(term, moved, None, None)
    energy = term.effect.energy(potential.elements(term, moved, None, None), {}).sum()
    (expected,) = torch.autograd.grad(energy, moved)
    np.testing.assert_allclose(gradient, expected, atol=1e-9)
    auto = super(type(term.effect), term.effect).hessian(elements, {})
    np.testing.assert_allclose(term.effect.hessian(elements, {}), auto, atol=1e-6)


def test_points_beyond_a_rim_on_the_other_side_or_far_away_pull_nothing():
    cloth = Cloth.of(panel(5), 0.2)
    x = cloth.vertices
    points = np.array([[0.0, 0.003, 0.01], [0.2, 0.0, 0.01], [0.0, 0.003, 0.01], [0.0, 0.5, 0.0]])
    facing = np.array([[0, 1, 0], [0, 1, 0], [0, -1, 0], [0, 1, 0]], float)
    hits = find_hits(points, facing, x, cloth, 0.1)
    assert len(hits) == 1
    assert hits.residual(x)[0] == pytest.approx(0.003)
