"""How a model came to be: its revisions, what each changed, and what that did to the error on held-out data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caphy.errors import CaphyError

Value = Any
"""A parameter's value as JSON has it: a number or nested lists of numbers, None where the parameter was not there."""


@dataclass(frozen=True)
class Revision:
    """One change of a model. It says what happened and has no part in the physics.

    Attributes:
        date: day of the change, ISO 8601.
        note: what was done and why, in words.
        added, removed: names of effects.
        parameters: "effect.parameter" or "density" -> values before and after, None where there was none.
        data: names of the measurements it was made with.
        error_before, error_after: median vertex error on held-out data before and after [m], or none.
        floor: what noise, restarts and time step alone would leave of that error [m], or none.
    """

    date: str
    note: str
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[Value, Value]] = field(default_factory=dict)
    data: tuple[str, ...] = ()
    error_before: float | None = None
    error_after: float | None = None
    floor: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form; errors in millimetres, under names that say so."""
        errors = {"before": self.error_before, "after": self.error_after, "floor": self.floor}
        return {
            "date": self.date,
            "note": self.note,
            "added": list(self.added),
            "removed": list(self.removed),
            "parameters": {name: list(values) for name, values in self.parameters.items()},
            "data": list(self.data),
            "held_out_error_mm": {name: None if e is None else round(1e3 * e, 4) for name, e in errors.items()},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], number: int) -> Revision:
        """Inverse of :meth:`to_dict`; raises CaphyError, naming the revision's ``number``, for what is none."""
        try:
            errors = {name: _metres(data["held_out_error_mm"][name], name) for name in ("before", "after", "floor")}
            parameters = {name: _before_and_after(values, name) for name, values in data["parameters"].items()}
            date, note = (_text(data[key], key) for key in ("date", "note"))
            added, removed, measured = (_texts(data[key], key) for key in ("added", "removed", "data"))
            return cls(
                date, note, added, removed, parameters, measured, errors["before"], errors["after"], errors["floor"]
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CaphyError(
                f"its history's entry {number} is no revision ({error!r}); mend it or delete 'history'"
            ) from error


def changes(before: Mapping[str, Value], after: Mapping[str, Value]) -> dict[str, tuple[Value, Value]]:
    """What differs between two flat sets of values, name -> (before, after), None where there is none."""
    names = dict.fromkeys([*before, *after])
    pairs = {name: (_plain(before.get(name)), _plain(after.get(name))) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def history_rows(history: Iterable[Revision]) -> list[tuple[str, ...]]:
    """A table for people, one row per revision below a row of headings."""
    rows = [("", "date", "what was done", "change", "held-out error [mm]", "floor [mm]", "data")]
    for number, revision in enumerate(history, 1):
        before, after = revision.error_before, revision.error_after
        error = "-" if before is None and after is None else f"{_millimetres(before)} -> {_millimetres(after)}"
        moved = [*(f"+{name}" for name in revision.added), *(f"-{name}" for name in revision.removed)]
        moved += [f"{name} {_short(a)} -> {_short(b)}" for name, (a, b) in revision.parameters.items() if b is not None]
        floor, data = _millimetres(revision.floor), ", ".join(revision.data) or "-"
        first, *rest = moved or ["-"]
        rows.append((str(number), revision.date, revision.note, first, error, floor, data))
        rows += [("", "", "", line, "", "", "") for line in rest]
    return [tuple(map(_in_one_line, row)) for row in rows]


def _in_one_line(text: str) -> str:
    """A text whose line breaks and control characters are written out: terminals obey them."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _text(value: Any, key: str) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{key} must be a text, got {_got(value)}")
    return value


def _texts(value: Any, key: str) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise TypeError(f"{key} must be a list of texts, got {_got(value)}")
    return tuple(_text(entry, key) for entry in value)


def _before_and_after(pair: Any, key: str) -> tuple[Value, Value]:
    if not isinstance(pair, list) or len(pair) != 2 or not all(value is None or _is_numbers(value) for value in pair):
        raise TypeError(f"{key} must be two values, numbers or null each, got {_got(pair)}")
    return pair[0], pair[1]


def _is_numbers(value: Any) -> bool:
    """Whether it is a finite number or nested lists of such, as many in each."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of several lengths
        return False
    return array.dtype.kind in "if" and bool(np.isfinite(array).all())


def _metres(value: Any, key: str) -> float | None:
    if value is None:
        return None
    if not _is_numbers(value) or np.ndim(value) or value < 0:
        raise TypeError(f"the held-out error {key} must be a finite number, not negative, got {_got(value)}")
    return float(value) / 1e3


def _got(value: Any) -> str:
    return json.dumps(value)[:80]


def _plain(value: Value) -> Value:
    return None if value is None else np.asarray(value, dtype=float).tolist()


def _millimetres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def _short(value: Value) -> str:
    """A parameter's value in a few characters; tables by their size."""
    if value is None:
        return "none"
    array = np.asarray(value)
    if array.size > 4:
        return f"{'x'.join(map(str, array.shape))} values"
    return f"{array:g}" if array.ndim == 0 else f"({', '.join(f'{entry:g}' for entry in array.ravel())})"
