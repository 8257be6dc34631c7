"""StVK against the closed form of uniaxial stretch and a plain loop from the published formula."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import flat_cloth, irregular_cloth, moment

LAMBDA, MU = 20.9, 11.1


def test_uniaxial_stretch_has_its_closed_form() -> None:
    cloth = flat_cloth()
    x = torch.as_tensor(cloth.vertices * (1.1, 1, 1))
    strain = (1.1**2 - 1) / 2
    energy = Potential(Model(0.2, {"strain_stvk": {}}), cloth).energies(x)["strain_stvk"]
    assert float(energy) == pytest.approx(0.12 * 0.1 * (LAMBDA / 2 + MU) * strain**2, rel=1e-12)


def test_uniaxial_force_per_width_is_the_tension() -> None:
    cloth = flat_cloth()
    stretch = 1.07
    x = torch.as_tensor(cloth.vertices * (stretch, 1, 1))
    _, gradient = Potential(Model(0.2, {"strain_stvk": {}}), cloth).gradient(x)
    right = cloth.vertices[:, 0] > 0.12 - 1e-9
    tension = stretch * (LAMBDA + 2 * MU) * (stretch**2 - 1) / 2  # first Piola stress P_uu = stretch * S_uu
    assert float(gradient[right, 0].sum()) == pytest.approx(0.1 * tension, rel=1e-12)


def test_energy_is_the_published_formula() -> None:
    cloth = irregular_cloth()
    x = moment(cloth, noise=0.004).x.numpy()
    total = 0.0
    for corners, flat in zip(cloth.faces, cloth.material, strict=True):
        rest = np.column_stack([flat[1] - flat[0], flat[2] - flat[0]])
        world = np.column_stack([x[corners[1]] - x[corners[0]], x[corners[2]] - x[corners[0]]])
        deformation = world @ np.linalg.inv(rest)
        strain = 0.5 * (deformation.T @ deformation - np.eye(2))
        density = LAMBDA / 2 * np.trace(strain) ** 2 + MU * np.trace(strain @ strain)
        total += 0.5 * abs(np.linalg.det(rest)) * density
    energy = Potential(Model(0.2, {"strain_stvk": {}}), cloth).energies(torch.as_tensor(x))["strain_stvk"]
    assert float(energy) == pytest.approx(total, rel=1e-12)
