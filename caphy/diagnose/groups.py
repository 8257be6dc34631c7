"""The explanations that are weighed: effects that could be added, and the model's own parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from caphy.effects.candidates import candidates
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.refit.columns import Column, addition, tunable


@dataclass(frozen=True)
class Group:
    """Columns that come and go together.

    Attributes:
        name: the effect's.
        columns: its numbers.
        own: the model has the effect already; these are its parameters.
    """

    name: str
    columns: tuple[Column, ...]
    own: bool = False

    @property
    def label(self) -> str:
        """For people."""
        return f"parameters of {self.name}" if self.own else self.name

    @property
    def family(self) -> str:
        """Effects of one family explain in similar ways."""
        return find_effect(self.name).group


def own_groups(model: Model, original: Model) -> list[Group]:
    """What could be changed in the effects that a model has: parameters of the original's, coefficients of others."""
    found = [
        Group(name, tunable(name, model), own=True) if name in original.effects else Group(name, addition(name))
        for name in model.effects
    ]
    return [group for group in found if group.columns]


def library(model: Model, on_body: bool) -> list[Group]:
    """The effects that could be added to a model; those that refine another are tried once that one is found."""
    names = [name for name in candidates(model, on_body) if find_effect(name).refines is None]
    return [Group(name, addition(name)) for name in names]


def columns_of(groups: Sequence[Group]) -> tuple[tuple[Column, ...], dict[str, list[int]]]:
    """All columns one after another, and where each group's are, by label."""
    columns: list[Column] = []
    places = {}
    for group in groups:
        places[group.label] = list(range(len(columns), len(columns) + len(group.columns)))
        columns += group.columns
    return tuple(columns), places
