"""What may be changed in a model to meet tensile tests, one number at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caphy.effects.base import Parameter
from caphy.effects.candidates import switched_off
from caphy.effects.model import Model
from caphy.effects.registry import find_effect

Place = tuple[int | None, ...]
"""An entry of a vector or table; None: all along that axis."""

_TABLE = 2  # dimensions of a measured table, whose columns are changed in proportion


@dataclass(frozen=True)
class Number:
    """One number of a model.

    Attributes:
        effect, parameter, place: whose, which, and which entries of a vector or table.
        relative: it is a factor on those entries, not their value.
        used: it holds only from the second loading on.
    """

    effect: str
    parameter: str
    place: Place = ()
    relative: bool = False
    used: bool = False

    @property
    def declared(self) -> Parameter:
        return find_effect(self.effect).parameters[self.parameter]

    @property
    def at(self) -> tuple[int | slice, ...]:
        """The entries, for indexing."""
        return tuple(slice(None) if k is None else k for k in self.place)

    @property
    def name(self) -> str:
        """As "weft_warp_stiffness.weft" or "strain_measured.stretching, column 2, times"."""
        entry = "".join(f", column {at + 1}" for at in self.place if at is not None)
        return f"{self.effect}.{self.parameter}{entry}{', times' if self.relative else ''}"

    @property
    def unit(self) -> str:
        return "1" if self.relative else self.declared.unit

    @property
    def bounds(self) -> tuple[float, float]:
        return (0.0, 1e3) if self.relative else (self.declared.lower, self.declared.upper)

    def start(self, model: Model) -> float:
        """Its value in a model; 1 for a factor and 0 for an effect that is not there."""
        if self.relative:
            return 1.0
        if self.effect not in model.effects:
            return float(np.asarray(switched_off(self.effect)[self.parameter])[self.at])
        return float(np.asarray(model.effects[self.effect][self.parameter])[self.at])


def added(effect: str, used: bool = False) -> tuple[Number, ...]:
    """The coefficients of an effect that is tried as an addition, and the further numbers that it wants fitted; of what
    used cloth adds to it the coefficients alone."""
    declared = find_effect(effect)
    return tuple(
        Number(effect, key, place, used=used)
        for key in (*declared.coefficients, *(() if used else declared.further))
        for place in np.ndindex(np.shape(declared.parameters[key].default))
    )


def own(model: Model, effects: Sequence[str]) -> tuple[Number, ...]:
    """The numbers of effects that a model has: its coefficients, and the columns of its measured tables."""
    numbers: list[Number] = []
    for name in effects:
        effect = find_effect(name)
        numbers += added(name)
        tables = [key for key, p in effect.parameters.items() if np.ndim(p.default) == _TABLE]
        for key in tables:
            columns = np.shape(effect.parameters[key].default)[1]
            numbers += [Number(name, key, (None, column), relative=True) for column in range(columns)]
    return tuple(numbers)


def changed(model: Model, numbers: Sequence[Number], values: np.ndarray, used: bool = True) -> Model:
    """The model with its numbers set to values (K,); those of used cloth only if it is used."""
    effects = {name: dict(parameters) for name, parameters in model.effects.items()}
    for number, value in zip(numbers, values, strict=True):
        if number.used and not used:
            continue
        parameters = effects.setdefault(number.effect, switched_off(number.effect))
        entries = np.array(parameters[number.parameter], dtype=float)
        old = entries[number.at]
        # What an effect of used cloth adds comes on top of what the same effect does in all loadings.
        new = old * value if number.relative else old + value if number.used else value
        entries[number.at] = np.clip(new, number.declared.lower, number.declared.upper)
        parameters[number.parameter] = entries
    return Model(model.density, effects)
