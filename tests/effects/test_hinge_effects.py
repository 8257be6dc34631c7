"""Damping, friction and natural curvature of bending against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from situations import DENSITY

from caphy.effects.base import Step
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import dihedral
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.effects.trial import flat_cloth, grid, irregular_cloth, moment

LENGTH, AREA = 0.02, 2 * 0.5 * 0.02 * 0.01


def fold(rest: float = 0.0) -> Cloth:
    flat = np.array([[0, 0, 0], [0, LENGTH, 0], [-0.01, 0.01, 0], [0.01, 0.01, 0]])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    vertices = flat.copy()
    vertices[3] = (0.01 * np.cos(rest), 0.01, -0.01 * np.sin(rest))
    return Cloth(vertices, faces, flat[faces][..., :2], DENSITY, np.zeros(4), np.zeros(4))


def folded(angle: float) -> torch.Tensor:
    x = fold().vertices.copy()
    x[3] = (0.01 * np.cos(angle), 0.01, -0.01 * np.sin(angle))
    return torch.as_tensor(x)


def moment_at(angle: float, before: float, rest: float = 0.0, **effects: Any) -> float:
    """d energy / d angle [N m] of one fold that was at another angle a step ago."""
    potential = Potential(Model(DENSITY, effects), fold(rest))
    step = Step.implicit_euler(1 / 30, folded(before), folded(before))
    ahead, behind = (potential.gradient(folded(angle + d), step)[0] for d in (1e-6, -1e-6))
    return float(ahead - behind) / 2e-6


def test_the_fold_is_what_the_tests_take_it_for() -> None:
    assert float(dihedral(folded(0.7)[..., None])) == pytest.approx(0.7)


def test_bending_damping_resists_the_rate_of_the_angle() -> None:
    moment = moment_at(0.5, 0.4, bending_damping={"viscosity": 2e-6})
    assert moment == pytest.approx(2e-6 * LENGTH**2 / (4 * AREA) * 0.1 * 30, rel=1e-6)


@pytest.mark.parametrize("law", ["bending", "bending_measured"])
def test_a_crease_gives_back_less_than_it_took(law: str) -> None:
    crease = {"share": 0.4, "slip": 1e-3}
    for step in (1e-2, -1e-2):
        elastic = moment_at(0.5, 0.5, **{law: {}})
        friction = moment_at(0.5 + step, 0.5, plastic_crease=crease, **{law: {}})
        without = moment_at(0.5 + step, 0.5, **{law: {}})
        assert friction - without == pytest.approx(np.sign(step) * 0.4 * elastic, rel=1e-4)


def test_a_crease_that_passes_through_itself_turns_by_what_it_turns() -> None:
    """From 3.13 to 3.15 rad, beyond pi, of folds whose template is closed, not by 6.26 rad back."""
    crease: Any = {"plastic_crease": {"share": 0.4, "slip": 1e-3}}
    for law in ("bending", "bending_measured"):
        elastic = moment_at(3.13, 3.13, 2.0, **{law: {}})
        friction = moment_at(3.15, 3.13, 2.0, **{law: {}}, **crease) - moment_at(3.15, 3.13, 2.0, **{law: {}})
        assert friction == pytest.approx(0.4 * elastic, rel=1e-4)
        lagged = moment_at(3.17, 3.15, 2.0, **{law: {}}, **crease) - moment_at(3.17, 3.15, 2.0, **{law: {}})
        assert lagged == pytest.approx(0.4 * moment_at(3.15, 3.15, 2.0, **{law: {}}), rel=1e-4)


def test_curved_cloth_that_passes_through_itself_does_not_jump() -> None:
    effects: Any = {"bending": {}, "natural_curvature": {"weft": 50.0, "warp": 0.0}}
    potential = Potential(Model(DENSITY, effects), fold(2.0))
    before, after = (float(potential.gradient(folded(angle))[0]) for angle in (np.pi - 1e-9, np.pi + 1e-9))
    assert after == pytest.approx(before, rel=1e-6)


def test_extra_and_directional_bending_add_to_the_models() -> None:
    weft, warp = 5e-5, 3e-5
    cloth = flat_cloth()
    x = torch.as_tensor(cloth.vertices) + 0.003 * torch.randn(
        cloth.vertices.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )

    def energy(**effects: Any) -> float:
        return sum(float(value) for value in Potential(Model(DENSITY, effects), cloth).energies(x).values())

    wanted = energy(bending={"stiffness_weft": weft, "stiffness_warp": warp})
    parts = energy(extra_bending={"stiffness": 4e-5}, bending_anisotropy={"difference": 1e-5})
    assert parts == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("law", ["bending", "bending_measured"])
@pytest.mark.parametrize("axis", [0, 1])
def test_curved_cloth_rests_on_a_cylinder_of_its_curvature(law: str, axis: int) -> None:
    cloth, radius = flat_cloth(24, 20), 0.08
    curvature = {"weft": 1 / radius, "warp": 0.0} if axis == 0 else {"weft": 0.0, "warp": 1 / radius}
    potential = Potential(Model(DENSITY, {law: {}, "natural_curvature": curvature}), cloth)

    def energy(bent: float) -> float:
        angle = cloth.vertices[:, axis] * bent
        x = cloth.vertices.copy()
        x[:, axis], x[:, 2] = np.sin(angle) / bent, (np.cos(angle) - 1) / bent
        return float(sum(potential.energies(torch.as_tensor(x)).values()))

    bends = np.linspace(0.7, 1.3, 61) / radius
    energies = [energy(bent) for bent in bends]
    assert bends[int(np.argmin(energies))] * radius == pytest.approx(1, abs=0.011)
    assert min(energies) == pytest.approx(0, abs=1e-3 * energy(1e-3 / radius))


def test_what_stiffens_folds_rests_curved_and_creases_with_them() -> None:
    stiffer: Any = {"extra_bending": {"stiffness": 4e-5}, "bending_anisotropy": {"difference": 1e-5}}
    whole: Any = {"bending": {"stiffness_weft": 9e-5, "stiffness_warp": 7e-5}}
    parts: Any = {"bending": {"stiffness_weft": 4e-5, "stiffness_warp": 4e-5}, **stiffer}
    cloth = irregular_cloth()
    at = moment(cloth)
    for added in ({"natural_curvature": {"weft": 9.0, "warp": -4.0}}, {"plastic_crease": {}}):
        one, other = (Potential(Model(DENSITY, {**effects, **added}), cloth) for effects in (whole, parts))
        torch.testing.assert_close(other.gradient(at.x, at.step), one.gradient(at.x, at.step))


def test_natural_angles_are_those_of_the_surface_on_any_mesh() -> None:
    """On an uneven mesh with threads at 0.6 rad to the axes."""
    vertices, faces = grid(6, 5)
    vertices = vertices + np.random.default_rng(1).uniform(-0.006, 0.006, vertices.shape) * (1, 1, 0)
    c, s = np.cos(0.6), np.sin(0.6)
    threads = vertices[:, :2] @ np.array([[c, -s], [s, c]])
    zeros = np.zeros(len(vertices))
    cloth = Cloth(vertices, faces, threads[faces], DENSITY, zeros, zeros)
    rest = find_effect("natural_curvature").rest(cloth)
    for axis, name in enumerate(("weft_angle", "warp_angle")):
        raised = vertices.copy()
        raised[:, 2] = -0.5 * 1e-6 * threads[:, axis] ** 2
        angles = dihedral(torch.as_tensor(raised)[cloth.hinges].movedim(0, -1)) / 1e-6
        np.testing.assert_allclose(rest[name], angles, atol=1e-9)
