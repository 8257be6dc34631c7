"""Fitting a model, with effects added, to tensile tests; an effect stays only if loadings left out agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve
from caphy.kept import Kept
from caphy.tensile.between import between_loadings
from caphy.tensile.candidates import HISTORY, Candidates, candidates
from caphy.tensile.diagnosis import CurveDiagnosis, answer, split, started
from caphy.tensile.search import numbers_of


@dataclass(frozen=True, eq=False)
class CurveRefit:
    """A refitted model.

    Attributes:
        kept: effects that were added.
        refused: effects that were asked for and do not lower the error of loadings left out, with the reason.
        outcome: errors before and after, coefficients and models, as in a diagnosis.
    """

    kept: tuple[str, ...]
    refused: Mapping[str, str]
    outcome: CurveDiagnosis

    @property
    def models(self) -> Mapping[str, tuple[Model, Model]]:
        """By fabric, of the first loading and of used cloth."""
        return self.outcome.models

    @property
    def sentences(self) -> list[str]:
        """What was kept, what was refused, and the errors."""
        changed = "nothing was changed" if self.outcome.verdict == "nothing" else "only parameters were refitted"
        kept = ", ".join(self.kept) or f"no effect; {changed}"
        return [f"Added: {kept}.", *self.refused.values(), *self.outcome.sentences[1:]]


def refit_curves(
    model: Model,
    curves: Sequence[ForceCurve],
    held_out: Sequence[ForceCurve] = (),
    add: Sequence[str] = (),
    kept: Kept | None = None,
) -> CurveRefit:
    """Fit the model's own numbers and those of added effects to tensile tests, for each fabric by itself.

    Raises:
        CaphyError: as :func:`caphy.tensile.diagnose_curves`, and for effects that such tests cannot show.
    """
    add = tuple(dict.fromkeys(add))
    learning, held, cautions = split(curves, held_out)
    seen = candidates(model)
    _check(add, seen, model)
    search = started(model, learning, seen, kept)
    names = [name for name in add if name not in HISTORY]
    history = [name for name in add if name in HISTORY]
    needed = search.without_useless(names, list(learning))
    refused = {
        name: f"{name} is not kept: without it loadings that were left out are met as well."
        for name in names
        if name not in needed
    }
    names = needed
    accepted = {row.effect for row in between_loadings(search.fits(numbers_of(names)), history) if row.accepted}
    for name in history:
        if name not in accepted:
            refused[name] = f"{name} is not kept: the first loading differs from repeats by no more than chance."
    used = [name for name in history if name in accepted]
    outcome = answer(search, seen, names, used, learning, held, cautions, (), names)
    return CurveRefit((*names, *used), refused, outcome)


def _check(add: Sequence[str], seen: Candidates, model: Model) -> None:
    for name in add:
        find_effect(name)
        if name in model.effects:
            raise CaphyError(f"the model already has {name}; its numbers are refitted without --add")
        if name not in seen.added:
            reason = seen.unseen.get(name, "the model lacks what it needs")
            raise CaphyError(f"{name} cannot be fitted to tensile tests: {reason}; they show {', '.join(seen.added)}")
