"""What can be changed in a model: the coefficients of effects to be added, and the parameters it already has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Parameter, Step
from caphy.effects.candidates import switched_off
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect

Entry = tuple[int, ...]


@dataclass(frozen=True)
class Column:
    """One number that can be changed.

    Attributes:
        effect, parameter: whose and which.
        entry: which entry of a vector or table; None changes all entries in proportion, and the number is the relative
            change.
    """

    effect: str
    parameter: str
    entry: Entry | None = ()

    @property
    def name(self) -> str:
        """As "wind_normal.push[0]"."""
        place = "" if not self.entry else f"[{','.join(map(str, self.entry))}]"
        return f"{self.effect}.{self.parameter}{place}"

    @property
    def declared(self) -> Parameter:
        return find_effect(self.effect).parameters[self.parameter]

    @property
    def separate(self) -> bool:
        """Whether it is the number of one opening, and explains by itself."""
        return bool(self.entry) and self.parameter in find_effect(self.effect).separate

    @property
    def unit(self) -> str:
        """Of the number: the parameter's, or "relative" of a change in proportion."""
        return "relative" if self.entry is None else self.declared.unit

    def value(self, model: Model) -> float:
        """The number in a model; 0 for a relative change and for an effect that is not there."""
        if self.entry is None or self.effect not in model.effects:
            return 0.0
        return float(np.asarray(model.effects[self.effect][self.parameter])[self.entry])

    def bounds(self, model: Model) -> tuple[float, float]:
        """How far the number may be changed from its value in a model, downwards and upwards."""
        if self.entry is None:
            return -0.9, 9.0
        value = self.value(model)
        return self.declared.lower - value, self.declared.upper - value


def addition(name: str) -> tuple[Column, ...]:
    """The coefficients of an effect that can be added; everything that must be told of one that refines another."""
    effect = find_effect(name)
    told = effect.parameters if effect.refines else effect.coefficients
    return tuple(Column(name, key, entry) for key in told for entry in _entries(effect.parameters[key]))


def further(name: str) -> tuple[Column, ...]:
    """The parameters in which an effect is not linear and that are fitted once it is found."""
    effect = find_effect(name)
    return tuple(Column(name, key, entry) for key in effect.further for entry in _entries(effect.parameters[key]))


def tunable(name: str, model: Model) -> tuple[Column, ...]:
    """The numbers of an effect that a model has: coefficients themselves, other parameters in proportion.

    Laws of nature and of the clock (gravity, frequencies, widths of smoothing) stay what they are.
    """
    effect = find_effect(name)
    if name in ("gravity", "inertia"):
        return ()
    columns: list[Column] = []
    for key, parameter in effect.parameters.items():
        if key in effect.coefficients and np.size(parameter.default) > 1 and np.size(parameter.default) <= 9:
            columns += [Column(name, key, entry) for entry in _entries(parameter)]
        elif parameter.linear and np.any(np.asarray(model.effects[name][key])):
            columns.append(Column(name, key, None))
    return tuple(columns)


def _entries(parameter: Parameter) -> list[Entry]:
    return [tuple(map(int, entry)) for entry in np.ndindex(np.shape(parameter.default))]


def strengths(columns: Sequence[Column]) -> set[str]:
    """Names of the numbers that are zero where nothing acts: not frequencies, which never are."""
    return {c.name for c in columns if c.entry is None or c.parameter in find_effect(c.effect).coefficients}


def extended(model: Model, columns: Sequence[Column]) -> Model:
    """The model with the effects of all columns present, those that were not switched off."""
    for column in columns:
        if column.effect not in model.effects:
            model = model.with_effect(column.effect, **switched_off(column.effect))
    return model


def moved(model: Model, columns: Sequence[Column], change: np.ndarray) -> Model:
    """The model with each number changed by ``change`` (K,), kept within its bounds; effects are added as needed."""
    model = extended(model, columns)
    for column, by in zip(columns, change, strict=True):
        values = {key: np.array(value, dtype=float) for key, value in model.effects[column.effect].items()}
        value, declared = values[column.parameter], column.declared
        if column.entry is None:
            value *= 1 + by
        else:
            value[column.entry] += by
        values[column.parameter] = np.clip(value, declared.lower, declared.upper)
        model = model.with_effect(column.effect, **values)
    return model


def changes(before: Model, after: Model, columns: Sequence[Column]) -> np.ndarray:
    """The changes (K,) that lead from one model to another."""
    found = []
    for column in columns:
        if column.entry is None:
            old, new = (np.asarray(m.effects[column.effect][column.parameter], float) for m in (before, after))
            found.append(float((old * new).sum() / (old * old).sum()) - 1)
        else:
            found.append(column.value(after) - column.value(before))
    return np.array(found)


def at_the_end(columns: Sequence[Column], change: np.ndarray) -> np.ndarray:
    """Units (K,) in which the model at the end of a change counts: relative ones are of what the numbers are there."""
    return np.where([column.entry is None for column in columns], 1 + change, 1.0)


def from_the_end(columns: Sequence[Column], change: np.ndarray) -> np.ndarray:
    """Changes (K,) as the model at their end counts them."""
    return change / at_the_end(columns, change)


def forces(
    potential: Potential, columns: Sequence[Column], x: Tensor, step: Step | None, body: BodyState | None
) -> Tensor:
    """Derivative of the gradient by each column's number (..., K, V, 3) [N per unit] at positions (..., V, 3).

    ``potential`` has all effects of the columns (:func:`extended`). Zero where an effect does not act.
    """
    wanted = {f"{column.effect}.{column.parameter}" for column in columns}
    found = potential.parameter_gradients(x, step, body, wanted)
    rows = []
    for column in columns:
        key = f"{column.effect}.{column.parameter}"
        if key not in found:
            rows.append(torch.zeros_like(x))
        elif column.entry is None:
            values = torch.from_numpy(np.asarray(potential.model.effects[column.effect][column.parameter], float))
            rows.append(torch.tensordot(values, found[key], dims=values.dim()) if values.dim() else values * found[key])
        else:
            rows.append(found[key][column.entry])
    return torch.stack(rows, dim=-3)
