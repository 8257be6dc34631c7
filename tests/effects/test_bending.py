"""Bending against closed forms: one fold, a cylinder, and the direction of the threads."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from caphy.effects.cloth import Cloth
from caphy.effects.hinge import dihedral
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import flat_cloth, irregular_cloth, moment
from caphy.material.fabrics import bending_stiffness, fabric, fabric_names

K = 3.96e-5


def energy(name: str, cloth: Cloth, x: np.ndarray | torch.Tensor, **values: object) -> float:
    potential = Potential(Model(0.2, {name: values}), cloth)  # pyright: ignore[reportArgumentType]
    return float(potential.energies(torch.as_tensor(x))[name])


def rolled(cloth: Cloth, radius: float, axis: int) -> np.ndarray:
    """A flat cloth rolled into a cylinder of a radius; its ``axis`` coordinate goes round."""
    angle = cloth.vertices[:, axis] / radius
    x = cloth.vertices.copy()
    x[:, axis], x[:, 2] = radius * np.sin(angle), radius * (np.cos(angle) - 1)
    return x


def test_one_fold_has_its_closed_form() -> None:
    vertices = np.array([[0, 0, 0], [0, 0.02, 0], [-0.01, 0.01, 0], [0.01, 0.01, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    cloth = Cloth(vertices, faces, vertices[faces][..., :2], 0.2, np.zeros(4), np.zeros(4))
    folded = vertices.copy()
    folded[3] = (0, 0.01, -0.01)
    area = 2 * 0.5 * 0.02 * 0.01
    assert energy("bending", cloth, folded) == pytest.approx(K * 0.02**2 / (8 * area) * (np.pi / 2) ** 2, rel=1e-12)


@pytest.mark.parametrize("name", ["bending", "bending_measured"])
def test_faces_folded_onto_each_other_unfold_one_way(name: str) -> None:
    """At exactly half a turn either way is right, but kernels and torch's formula must take the same."""
    vertices = np.array([[0, 0, 0], [0, 0.02, 0], [-0.01, 0.01, 0], [0.01, 0.01, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    cloth = Cloth(vertices, faces, vertices[faces][..., :2], 0.2, np.zeros(4), np.zeros(4))
    folded = torch.from_numpy(vertices * [-1, 1, 1])
    folded[2] = folded[3]
    potential = Potential(Model(0.2, {name: {}}), cloth)
    compiled = potential.gradient(folded)[1]
    x = folded.clone().requires_grad_(True)
    (plain,) = torch.autograd.grad(sum(potential.energies(x).values()), x)
    assert plain.abs().max() > 1e-4
    torch.testing.assert_close(compiled, plain)


def test_a_ridge_seen_from_outside_is_positive() -> None:
    x = np.array([[0, 0, 0], [0, 0.02, 0], [-0.01, 0.01, -0.004], [0.01, 0.01, -0.004]])
    outward = np.cross(x[1] - x[0], x[2] - x[0])
    assert outward[2] > 0
    assert float(dihedral(torch.as_tensor(x)[..., None])) == pytest.approx(2 * np.arctan(0.4), rel=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_cylinder_costs_an_eighth_of_the_squared_curvature(axis: int) -> None:
    cloth = flat_cloth(48, 40)
    area = 0.12 * 0.1
    across = 1 - 1 / (48, 40)[axis]  # share of the rows whose edges are folded: the outermost are not hinges
    wanted = K * area * across / (8 * 0.05**2)
    assert energy("bending", cloth, rolled(cloth, 0.05, axis)) == pytest.approx(wanted, rel=2e-3)


def test_the_threads_that_bend_are_the_ones_that_count() -> None:
    cloth = flat_cloth(24, 20)
    stiff = {"stiffness_weft": 1e-4, "stiffness_warp": 2e-5}
    weft, warp = (energy("bending", cloth, rolled(cloth, 0.05, axis), **stiff) for axis in (0, 1))
    plain = [energy("bending", cloth, rolled(cloth, 0.05, axis)) / K for axis in (0, 1)]
    assert weft / plain[0] == pytest.approx(1e-4, rel=1e-9)
    assert warp / plain[1] == pytest.approx(2e-5, rel=1e-9)


def test_a_constant_table_is_plain_bending() -> None:
    cloth = irregular_cloth()
    x = moment(cloth).x
    measured = Potential(Model(0.2, {"bending_measured": {"bending": np.full((3, 5), K)}}), cloth).gradient(x)
    plain = Potential(Model(0.2, {"bending": {}}), cloth).gradient(x)
    torch.testing.assert_close(measured, plain, rtol=1e-10, atol=1e-16)


@pytest.mark.parametrize("name", fabric_names())
@pytest.mark.parametrize("edge_angle", [0.0, 0.3, np.pi / 2, 2.2])
def test_measured_energy_is_the_integral_of_the_measured_moment(name: str, edge_angle: float) -> None:
    flat = np.array([[0, 0], [0.02, 0], [0.011, 0.012], [0.008, -0.01]], dtype=float)
    c, s = np.cos(edge_angle), np.sin(edge_angle)
    vertices = np.column_stack([flat, np.zeros(4)])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    material = (flat @ np.array([[c, s], [-s, c]]))[faces]
    cloth = Cloth(vertices, faces, material, 0.2, np.zeros(4), np.zeros(4))
    turn, area, length = 0.9, 0.5 * 0.02 * 0.022, 0.02
    x = vertices.copy()
    x[3] = (0.008, -0.01 * np.cos(turn), -0.01 * np.sin(turn))
    table = fabric(name).bending

    def moment_at(theta: float) -> float:
        k = bending_stiffness(table, edge_angle, theta * length / (2 * area))
        return float(k) * length**2 / (4 * area) * theta

    corners = [5 * i * 2 * area / length for i in range(1, 5)]
    wanted, _ = quad(moment_at, 0, turn, points=[corner for corner in corners if corner < turn])
    assert energy("bending_measured", cloth, x, bending=table) == pytest.approx(wanted, rel=1e-8)
