"""The explanations that are weighed: effects that could be added, and the model's own parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from caphy.effects.candidates import candidates
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.refit.columns import Column, addition, tunable
from caphy.refit.study import Study


@dataclass(frozen=True)
class Group:
    """Columns that come and go together.

    Attributes:
        name: the effect's.
        columns: its numbers.
        own: the model has the effect already; these are its parameters.
        part: it is one of several numbers of its effect, each of which explains by itself.
    """

    name: str
    columns: tuple[Column, ...]
    own: bool = False
    part: bool = False

    @property
    def label(self) -> str:
        """For people."""
        if self.part:
            return self.columns[0].name
        return f"parameters of {self.name}" if self.own else self.name

    @property
    def family(self) -> str:
        """Effects of one family explain in similar ways."""
        return find_effect(self.name).group


def explanations(study: Study, model: Model, original: Model) -> tuple[Group, ...]:
    """What could be changed in a model of the cloth of a study, and what could be added to it.

    Of effects that the ``original`` has these are parameters, of others coefficients. Effects that refine another are
    tried once that one is found.
    """
    found: list[Group] = []
    for name in model.effects:
        found += [Group(name, tunable(name, model), own=True)] if name in original.effects else _added(study, name)
    for name in candidates(model, study.on_body):
        found += [] if find_effect(name).refines else _added(study, name)
    return tuple(group for group in found if group.columns)


def _added(study: Study, name: str) -> Iterator[Group]:
    """An effect that was or could be added: in one, or opening by opening.

    What one opening cannot tell, as a skirt's waist that hardly moves, would else go its own way in every fit of what
    the other does.
    """
    columns = addition(name)
    yield Group(name, tuple(column for column in columns if not column.separate))
    for column in columns:
        if column.separate and column.entry and column.entry[0] < study.openings:
            yield Group(name, (column,), part=True)


def columns_of(groups: Sequence[Group]) -> tuple[tuple[Column, ...], dict[str, list[int]]]:
    """All columns one after another, and where each group's are, by label."""
    columns: list[Column] = []
    places = {}
    for group in groups:
        places[group.label] = list(range(len(columns), len(columns) + len(group.columns)))
        columns += group.columns
    return tuple(columns), places
