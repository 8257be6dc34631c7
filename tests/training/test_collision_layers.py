"""Contact of two garments: heights against closed form, forces against finite differences, only where they meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_world import tube

from caphy.effects.cloth import Cloth
from caphy.training.layers import GAP, REACH, STIFFNESS, Layers, Pair


def cylinder(radius: float, low: float, high: float, around: int = 48, rings: int = 12) -> Cloth:
    """A round tube of cloth about the vertical [m]."""
    garment = tube(around, rings)
    angle = 2 * np.pi * np.arange(around) / around
    ring = radius * np.stack([np.sin(angle), np.zeros(around), np.cos(angle)], -1)
    vertices = (ring[None] + np.linspace(low, high, rings)[:, None, None] * [0, 1, 0]).reshape(-1, 3)
    return Cloth.of(replace(garment, vertices=vertices), 0.2)


def test_heights_are_those_of_round_tubes():
    """Distance between two polygons of one axis and facing corners: the difference of their apothems."""
    inner, outer = cylinder(0.150, -0.1, 0.1), cylinder(0.156, -0.1, 0.1)
    over, under = Pair.of(inner, outer).sides(inner.vertices, outer.vertices)
    apothem = np.cos(np.pi / 48)
    # From an outer corner the nearest point is the inner corner below it, from an inner one the middle of a face.
    np.testing.assert_allclose(over.height, 0.006, atol=2e-4)
    np.testing.assert_allclose(under.height, 0.006, atol=2e-4)
    swapped = Pair.of(outer, inner)
    depths = swapped.depths(outer.vertices, inner.vertices)
    assert (depths > 0.006 * apothem - 2e-4).all() and (depths < 0.0062).all()


def test_beyond_an_edge_there_is_nothing_to_be_outside_of():
    inner, outer = cylinder(0.15, -0.1, 0.1), cylinder(0.152, 0.05, 0.3)
    over, under = Pair.of(inner, outer).sides(inner.vertices, outer.vertices)
    assert len(over.vertex) and (outer.vertices[over.vertex, 1] < 0.1).all()
    assert len(under.vertex) and (inner.vertices[under.vertex, 1] > 0.05).all()
    apart = cylinder(0.15, -0.1, 0.1), cylinder(0.152, 0.2, 0.3)
    assert len(Pair.of(*apart).depths(apart[0].vertices, apart[1].vertices)) == 0


def test_only_cloth_that_may_meet_is_looked_at():
    """A sleeve that is far away at rest may be carried into a hip; what lies deep behind is another side."""
    inner, outer = cylinder(0.15, -0.1, 0.1), cylinder(0.152, -0.1, 0.1)
    pair = Pair.of(inner, cylinder(0.30, -0.1, 0.1))
    assert len(pair.depths(inner.vertices, outer.vertices)) == 0
    pair = Pair.of(inner, outer)
    assert len(pair.depths(inner.vertices, outer.vertices)) > 100
    assert len(pair.depths(inner.vertices, outer.vertices + np.array([0, 0.12, 0]))) == 0  # other places than at rest
    assert len(pair.depths(inner.vertices, outer.vertices * (0.15 - 2 * REACH) / 0.152)) == 0


def test_force_is_the_gradient_and_pushes_both_apart_equally():
    rng = np.random.default_rng(0)
    inner, outer = cylinder(0.15, -0.1, 0.1), cylinder(0.151, -0.12, 0.05)
    pair = Pair.of(inner, outer)
    a, b = (torch.tensor(c.vertices + rng.normal(scale=0.001, size=c.vertices.shape)) for c in (inner, outer))
    a.requires_grad_(True), b.requires_grad_(True)
    energy = pair.energy(a, b)
    forces = torch.autograd.grad(energy, (a, b))
    ways = [torch.tensor(rng.normal(size=x.shape)) for x in (a, b)]
    with torch.no_grad():
        up, down = (pair.energy(a + s * ways[0], b + s * ways[1]) for s in (1e-7, -1e-7))
    expected = sum(float((force * way).sum()) for force, way in zip(forces, ways, strict=True))
    assert expected == pytest.approx(float(up - down) / 2e-7, rel=1e-3)
    total = forces[0].sum(0) + forces[1].sum(0)
    torch.testing.assert_close(total, torch.zeros_like(total), atol=1e-9, rtol=0)
    radial = torch.nn.functional.normalize(b.detach() * torch.tensor([1.0, 0.0, 1.0]), dim=-1)
    assert float((forces[1] * radial).sum()) < 0  # against the gradient, outward


def test_energy_is_the_cubic_penalty_of_each_vertex_s_area():
    inner, outer = cylinder(0.15, -0.1, 0.1), cylinder(0.1515, -0.1, 0.1)
    pair = Pair.of(inner, outer)
    energy = float(pair.energy(torch.tensor(inner.vertices), torch.tensor(outer.vertices)))
    expected = 0.0
    for side, cloth in zip(pair.sides(inner.vertices, outer.vertices), (outer, inner), strict=True):
        for vertex, height in zip(side.vertex, side.height, strict=True):
            expected += STIFFNESS * cloth.vertex_area[vertex] * max(GAP - height, 0) ** 3
    assert energy == pytest.approx(expected, rel=1e-6) and energy > 0


def test_three_layers_are_three_pairs():
    cloths = [cylinder(radius, -0.1, 0.1) for radius in (0.15, 0.151, 0.152)]
    layers = Layers(cloths)
    frames = [torch.tensor(np.stack([c.vertices, 1.001 * c.vertices])[None]) for c in cloths]
    together = layers(frames)
    assert together.shape == (1, 2)
    pairs = [(0, 1), (0, 2), (1, 2)]
    alone = sum(float(Pair.of(cloths[i], cloths[j]).energy(frames[i][0, 1], frames[j][0, 1])) for i, j in pairs)
    assert float(together[0, 1]) == pytest.approx(alone, rel=1e-9)
    counts = [len(Pair.of(cloths[i], cloths[j]).depths(cloths[i].vertices, cloths[j].vertices)) for i, j in pairs]
    assert len(layers.depths([c.vertices for c in cloths])) == sum(counts)
