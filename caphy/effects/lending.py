"""The elasticity of whatever membrane and bending a model has, for effects that change its rest shape."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Values, lent
from caphy.effects.bending import Bending, bending_stiffness
from caphy.effects.bending_measured import BendingMeasured, measured_moments
from caphy.effects.cloth import Cloth
from caphy.effects.membrane import Symmetric
from caphy.effects.strain_measured import energy_density
from caphy.effects.strain_stvk import stvk_density

MEMBRANES = ("strain_stvk", "strain_measured")
BENDINGS = ("bending", "bending_measured")


def membrane_density(strain: Symmetric, p: Values) -> Tensor:
    """Energy per rest area (..., n) [N/m] of the membranes that lend their parameters."""
    density = torch.zeros_like(strain[0])
    if stvk := lent(p, "strain_stvk"):
        density = density + stvk_density(strain, stvk)
    if measured := lent(p, "strain_measured"):
        density = density + energy_density(strain, measured["stretching"])
    return density


def bending_rest(cloth: Cloth) -> dict[str, np.ndarray]:
    """Rest constants of hinges that :func:`bending_energy` and :func:`bending_moment` read."""
    return Bending().rest(cloth) | BendingMeasured().rest(cloth)


def bending_energy(turn: Tensor, rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Energy (..., n) [J] of hinges turned from their rest angles by (..., n) [rad], of those that lend."""
    energy = torch.zeros_like(turn)
    if plain := lent(p, "bending"):
        energy = energy + bending_stiffness(rest, plain) * turn * turn
    if measured := lent(p, "bending_measured"):
        energy = energy + measured_moments(turn, rest, measured)[0]
    return energy


def bending_moment(turn: Tensor, rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Derivative (..., n) [N m] of :func:`bending_energy` by the turn."""
    moment = torch.zeros_like(turn)
    if plain := lent(p, "bending"):
        moment = moment + 2 * bending_stiffness(rest, plain) * turn
    if measured := lent(p, "bending_measured"):
        moment = moment + measured_moments(turn, rest, measured)[1]
    return moment
