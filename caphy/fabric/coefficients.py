"""The numbers of a model that make its fabric: the entries of its stiffness tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.refit.columns import Column, forces

ELASTIC = ("strain_measured", "strain_stvk", "bending_measured", "bending")
"""The effects whose parameters are the fabric's."""

LEAST = 0.02
"""Smallest entry of a table, of its largest: what is clamped to zero has no gradient and could never come back."""


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The fabric's numbers in a model, K of them, in groups that each belong to one effect.

    Attributes:
        start: the model one starts from; its density and all other effects are kept.
        columns: the numbers.
        values: theirs at the start (K,), entries that the fabric's law takes as zero raised to nearly zero.
        group: which effect each belongs to (K,).
        first: the model whose own tables stiffness is told over, none raised.
    """

    start: Model
    columns: tuple[Column, ...]
    values: np.ndarray
    group: np.ndarray
    first: Model

    @classmethod
    def of(cls, model: Model, first: Model | None = None) -> Coefficients:
        """The numbers of a model, told over those of ``first``, which has the same effects: the model unless given.

        Raises:
            CaphyError: the model has no elasticity that can be fitted.
        """
        names = [name for name in ELASTIC if name in model.effects]
        if not names:
            raise CaphyError(f"the model must have one of {', '.join(ELASTIC)} to be fitted; it has none of them")
        if not set(names) & set(ELASTIC[:2]):
            raise CaphyError(f"the model must have {' or '.join(ELASTIC[:2])}: cloth without them stretches freely")
        columns = tuple(
            Column(name, key, tuple(map(int, entry)))
            for name in names
            for key in model.effects[name]
            for entry in np.ndindex(np.shape(model.effects[name][key]))
        )
        group = np.array([names.index(column.effect) for column in columns])
        values = np.array([column.value(model) for column in columns])
        largest = np.array([np.abs(values[group == g]).max() for g in group])
        if not (largest > 0).all():
            raise CaphyError(f"{names[group[largest == 0][0]]} must have a stiffness above zero to start from")
        return cls(model, columns, np.maximum(values, LEAST * largest), group, first or model)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the groups: the effects'."""
        return tuple(dict.fromkeys(column.effect for column in self.columns))

    def model(self, values: np.ndarray) -> Model:
        """The model with numbers (K,) in place of the start's."""
        model = self.start
        tables: dict[tuple[str, str], np.ndarray] = {}
        for column, value in zip(self.columns, values, strict=True):
            key = column.effect, column.parameter
            if key not in tables:
                tables[key] = np.array(model.effects[column.effect][column.parameter], dtype=float)
            assert column.entry is not None
            tables[key][column.entry] = value
        for (effect, parameter), table in tables.items():
            model = model.with_effect(effect, **{parameter: table})
        return model

    def forces(self, potential: Potential, x: Tensor, body: BodyState | None) -> Tensor:
        """Derivative of the gradient by each number (K, V, 3) [N per unit] at positions (V, 3) [m] at rest."""
        return forces(potential, self.columns, x, None, body)

    def energies(self, potential: Potential, x: Tensor) -> np.ndarray:
        """Energy per unit of each number (K,) [J] at positions (V, 3) [m]: what the number is asked for there."""
        found = []
        for name in self.names:
            term = potential.terms[name]
            values = {key: value.detach().clone().requires_grad_(True) for key, value in term.values.items()}
            with torch.enable_grad():
                energy = term.effect.energy(potential.elements(term, x, None, None), values).sum()
                slopes = torch.autograd.grad(energy, list(values.values()), materialize_grads=True)
            found += [slope.reshape(-1).numpy() for slope in slopes]
        return np.concatenate(found)

    def stored_first(self, potential: Potential, x: Tensor) -> np.ndarray:
        """Energy of each group's tables in ``first`` (G,) [J] at positions (V, 3) [m]."""
        found = []
        for name in self.names:
            term = potential.terms[name]
            values = {
                key: value.new_tensor(np.asarray(self.first.effects[name][key])) for key, value in term.values.items()
            }
            found.append(float(term.effect.energy(potential.elements(term, x, None, None), values).sum()))
        return np.array(found)
