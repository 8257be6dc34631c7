"""A physics model: an area density and a list of effects with parameter values."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from caphy.effects.base import needs
from caphy.effects.history import Revision, changes
from caphy.effects.registry import find_effect
from caphy.errors import CaphyError

_KEYS = {"schema", "density_kg_per_m2", "effects", "history"}

DENSEST = 10.0
"""What a file's cloth may weigh at most [kg/m^2]: five times the heaviest leather."""

ParameterValues = Mapping[str, Any]
"""Values by parameter: numbers or nested sequences when given, arrays once in a model."""


def checked_values(effect_name: str, given: Mapping[str, object]) -> dict[str, np.ndarray]:
    """Parameter values of an effect, defaults filled in, shapes and bounds checked."""
    declared = find_effect(effect_name).parameters
    unknown = sorted(set(given) - set(declared))
    if unknown:
        raise CaphyError(f"{effect_name} has no parameter {unknown[0]!r}; it has: {', '.join(declared) or 'none'}")
    values = {}
    for name, parameter in declared.items():
        value = np.asarray(given.get(name, parameter.default))
        if value.dtype.kind not in "iuf":
            raise CaphyError(f"{effect_name}.{name} must be numbers [{parameter.unit}], got {value.tolist()!r}")
        value = value.astype(float)
        shape = np.shape(parameter.default)
        if value.shape != shape:
            raise CaphyError(f"{effect_name}.{name} must have shape {shape}, got {value.shape}")
        if not np.isfinite(value).all() or (value < parameter.lower).any() or (value > parameter.upper).any():
            raise CaphyError(
                f"{effect_name}.{name} must lie in [{parameter.lower:g}, {parameter.upper:g}] {parameter.unit}, "
                f"got {value.tolist()}"
            )
        values[name] = value
    return values


@dataclass(frozen=True)
class Model:
    """An area density [kg/m^2] and the effects that act, name -> parameter values.

    ``history`` tells how it came to be, oldest revision first; it changes nothing and has no part in equality.
    """

    density: float
    effects: Mapping[str, ParameterValues] = field(default_factory=dict)
    history: tuple[Revision, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.density) and self.density > 0):
            raise CaphyError(f"the area density must be positive [kg/m^2], got {self.density}")
        checked = {name: checked_values(name, values) for name, values in self.effects.items()}
        for name in checked:
            effect = find_effect(name)
            if effect.lenders(checked) is None:
                raise CaphyError(f"{name} needs {needs(effect)} in the same model; add it")
        object.__setattr__(self, "effects", checked)

    __hash__ = None  # type: ignore[assignment]  # holds arrays

    def __eq__(self, other: object) -> bool:
        """Whether the physics is the same: effects and values, in whatever order, by whatever history."""
        if not isinstance(other, Model):
            return NotImplemented
        return self.effects.keys() == other.effects.keys() and not changes(self.values(), other.values())

    def with_effect(self, name: str, **values: object) -> Model:
        """This model with an effect added or its parameters replaced."""
        return replace(self, effects={**self.effects, name: {**self.effects.get(name, {}), **values}})

    def without_effect(self, name: str) -> Model:
        """This model without an effect."""
        return replace(self, effects={key: value for key, value in self.effects.items() if key != name})

    def values(self) -> dict[str, object]:
        """All parameter values in one mapping, "density" and "effect.parameter" -> value."""
        named = ((f"{name}.{key}", v) for name, values in self.effects.items() for key, v in values.items())
        return {"density": self.density, **dict(named)}

    def revised(
        self, since: Model, note: str, *, data: Sequence[str] = (), error_before: float | None = None,
        error_after: float | None = None, floor: float | None = None, date: str | None = None,
    ) -> Model:  # fmt: skip
        """This model with the history of ``since``, the model it was made from, and one more revision.

        Effects added and removed and parameters changed are found by comparison. ``data`` names the measurements it
        was made with; errors are medians over held-out vertices [m]; the date is today's unless given.
        """
        revision = Revision(
            datetime.date.today().isoformat() if date is None else date,
            note,
            tuple(name for name in self.effects if name not in since.effects),
            tuple(name for name in since.effects if name not in self.effects),
            changes(since.values(), self.values()),
            tuple(data),
            error_before,
            error_after,
            floor,
        )
        return replace(self, history=(*since.history, revision))

    def to_json(self) -> str:
        """Readable, diffable text form."""
        effects = {
            name: {key: np.asarray(value).tolist() for key, value in values.items()}
            for name, values in self.effects.items()
        }
        document: dict[str, object] = {"schema": 1, "density_kg_per_m2": self.density, "effects": effects}
        if self.history:
            document["history"] = [revision.to_dict() for revision in self.history]
        return json.dumps(document, indent=2)

    @classmethod
    def from_json(cls, text: str, source: str = "model") -> Model:
        """Inverse of :meth:`to_json`; ``source`` names the file in errors."""
        try:
            data = json.loads(text, object_pairs_hook=_each_once)
            if not isinstance(data, dict):
                raise TypeError("it is no object in braces")
            unknown = sorted(set(data) - _KEYS)
            if unknown and "format" not in data:  # with one it is a document that is a model as well
                raise ValueError(f"unknown key {unknown[0]!r}; known: {', '.join(sorted(_KEYS))}")
            if "format" not in data and data.get("schema", 1) != 1:
                raise ValueError(f"schema must be 1, got {data['schema']!r}; this caphy is older than the file")
            density = data["density_kg_per_m2"]
            if isinstance(density, bool) or not isinstance(density, (int, float)):
                raise TypeError(f"density_kg_per_m2 must be a number, got {json.dumps(density)}")
            if density > DENSEST:
                raise ValueError(f"density_kg_per_m2 must not be over {DENSEST:g}, got {density:g}; is it in g/m^2?")
            if not isinstance(data["effects"], dict):
                raise TypeError(f"effects must be an object, got {json.dumps(data['effects'])[:60]}")
            if not isinstance(data.get("history", []), list):
                raise TypeError(f"history must be a list, got {json.dumps(data['history'])[:60]}")
            for name, values in data["effects"].items():
                if not isinstance(values, dict):
                    raise TypeError(f"the parameters of {name} must be an object, got {json.dumps(values)}")
            history = tuple(Revision.from_dict(entry, n) for n, entry in enumerate(data.get("history", ()), 1))
            model = cls(float(density), data["effects"], history)
            extra = float(np.sum(model.effects.get("extra_mass", {}).get("density", 0.0)))
            if density + extra <= 0:
                raise ValueError(f"cloth of {density:g} kg/m^2 and extra_mass of {extra:g} weighs nothing")
            return model
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise CaphyError(
                f"{source}: not a physics model ({type(error).__name__}: {error}); it must be JSON with "
                '"density_kg_per_m2": number and "effects": {name: {parameter: value}}; see caphy effects list'
            ) from error
        except CaphyError as error:
            raise CaphyError(f"{source}: {error}") from error

    @classmethod
    def load(cls, path: Path) -> Model:
        """Read a model's JSON file."""
        try:
            return cls.from_json(path.read_text(encoding="utf-8-sig"), str(path))
        except OSError as error:
            raise CaphyError(f"{path}: cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise CaphyError(f"{path}: a physics model must be JSON in UTF-8, got other bytes") from error


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object whose names differ; of two the last would count, silently."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r} is there twice")
    return found
