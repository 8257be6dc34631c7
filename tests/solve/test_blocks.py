"""Compiled element Hessians against those of the effects themselves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from caphy.effects.bending import bending_stiffness
from caphy.effects.blocks import add_blocks
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import moment

ELASTIC = ["strain_stvk", "strain_measured", "bending", "bending_measured"]


def assembled(index, blocks, count):
    """The dense matrix (3 V, 3 V) of element blocks (n, k, k, 3, 3)."""
    dense = np.zeros((count, count, 3, 3))
    np.add.at(dense, (index[:, :, None], index[:, None, :]), blocks)
    return dense.swapaxes(1, 2).reshape(3 * count, 3 * count)


@pytest.mark.parametrize("name", [*ELASTIC, "bending_damping", "inertia", "gravity", "attachment", "body_contact"])
@pytest.mark.parametrize("projection", [0.0, 0.3, 1.0])
def test_compiled_blocks_are_the_effects_own(sheet, name, projection):
    cloth = replace(sheet(0.4, 0.3, 5, 4), attached=np.linspace(0, 1, 20))
    potential = Potential(Model(0.2, {name: {}}), cloth)
    at = moment(cloth, noise=0.03)
    x, step, body = at.x, at.step, at.body
    ((_, term, elements),) = potential.acting(x, step, body)
    exact, convex = term.effect.hessian(elements, term.values), term.effect.projected_hessian(elements, term.values)
    mixture = torch.lerp(exact, convex, float(projection > 0) if term.effect.element == "vertex" else projection)
    index = term.index.numpy()
    count = len(x)
    expected = assembled(index, mixture.numpy().transpose(4, 0, 2, 1, 3), count)
    slots = (index[:, :, None] * count + index[:, None, :]).astype(np.int32)
    blocks = np.zeros((count * count, 3, 3))
    add_blocks(potential, term, x, step, body, projection, slots, blocks)
    found = blocks.reshape(count, count, 3, 3).swapaxes(1, 2).reshape(3 * count, 3 * count)
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())


def test_only_stored_pairs_are_written(sheet):
    cloth = sheet(0.4, 0.3, 4, 3)
    potential = Potential(Model(0.2, {"bending": {}}), cloth)
    x = torch.from_numpy(cloth.vertices)
    term = potential.terms["bending"]
    blocks = np.zeros((1, 3, 3))
    add_blocks(potential, term, x, None, None, 1.0, np.full((len(term.index), 4, 4), -1, np.int32), blocks)
    assert not blocks.any()


def test_a_hinge_that_folds_through_itself_keeps_its_energy(sheet):
    """Wings half a micrometre on either side of flat together: pi is -pi, whatever the rest angle."""
    cloth = sheet(0.1, 0.1, 2, 2)
    edge = cloth.hinges[0]
    potential = Potential(Model(0.2, {"bending": {}}), cloth)
    potential.terms["bending"].rest["angle"] += 0.4
    closed = cloth.vertices.copy()
    a, b, c = (closed[edge[i]] for i in range(3))
    along = (b - a) / np.linalg.norm(b - a)
    closed[edge[3]] = c  # the wings coincide
    across = np.cross(along, c - a) / np.linalg.norm(np.cross(along, c - a))
    stiffness = float(bending_stiffness(potential.terms["bending"].rest, potential.terms["bending"].values)[0])
    for side in (-1, 1):
        x = closed.copy()
        x[edge[3]] += side * 5e-7 * across
        energy, _ = potential.gradient(torch.from_numpy(x))
        (defined,) = potential.energies(torch.from_numpy(x)).values()
        assert float(energy) == pytest.approx(stiffness * (np.pi - 0.4) ** 2, rel=1e-4)
        assert float(defined) == pytest.approx(float(energy), rel=1e-12)


@pytest.mark.parametrize("projection", [0.0, 0.3, 1.0])
def test_frictions_blocks_go_from_exact_to_convex(sheet, projection):
    cloth = sheet(0.4, 0.3, 5, 4)
    potential = Potential(Model(0.2, {"body_contact": {}, "body_friction": {}}), cloth)
    at, term, count = moment(cloth, noise=0.03), potential.terms["body_friction"], len(cloth.vertices)
    elements = potential.elements(term, at.x, at.step, at.body)
    exact, convex = term.effect.hessian(elements, term.values), term.effect.projected_hessian(elements, term.values)
    assert (convex - exact).abs().max() > 0.1 * exact.abs().max()
    blocks, slots = np.zeros((count, 3, 3)), np.arange(count, dtype=np.int32)[:, None, None]
    add_blocks(potential, term, at.x, at.step, at.body, projection, slots, blocks)
    expected = torch.lerp(exact, convex, projection)[0, :, 0].permute(2, 0, 1)
    np.testing.assert_allclose(blocks, expected, atol=1e-12 * float(convex.abs().max()))


@pytest.mark.parametrize("slip", [1e-3, 0.01, 0.3])
def test_frictions_convex_quadratic_is_nowhere_below_its_energy(sheet, slip):
    """So a step to its minimum never raises the energy (Lange, MM Optimization Algorithms, 2016)."""
    cloth = sheet(0.4, 0.3, 5, 4)
    friction = {"coefficient": 0.5, "slip": slip}
    potential = Potential(Model(0.2, {"body_contact": {}, "body_friction": friction}), cloth)
    at, term = moment(cloth, noise=0.03), potential.terms["body_friction"]
    elements = potential.elements(term, at.x, at.step, at.body)
    values, energy = term.values, term.effect.energy(elements, term.values)
    gradient = term.effect.gradient(elements, values)[1][0]
    hessian = term.effect.projected_hessian(elements, values)[0, :, 0]
    random = torch.Generator().manual_seed(0)
    for length in (1e-5, 1e-3, 1e-2, 0.1):
        move = length * torch.randn(elements.x.shape, dtype=torch.float64, generator=random)
        there = replace(elements, x=elements.x + move)
        quadratic = energy + (gradient * move[0]).sum(0) + torch.einsum("iv,ijv,jv->v", move[0], hessian, move[0]) / 2
        assert (term.effect.energy(there, values) <= quadratic + 1e-12 * quadratic.abs().max()).all()
