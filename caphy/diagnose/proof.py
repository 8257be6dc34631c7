"""What was found must hold on measurements that nothing was fitted to, and each of several effects by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from caphy.diagnose.search import Search, Term, take_back
from caphy.refit.fit import Fit
from caphy.refit.heldout import HeldOut
from caphy.refit.study import Study


def each_proven(study: Study, found: Search, held_out: Callable[[Fit], HeldOut]) -> Search:
    """A search without the further effects whose loss raises no median on held-out measurements, and without any of
    several that is slight and not surely felt there.

    What mesh and solver get wrong is not the same in every motion, and where a strong effect acts it is not what base
    measurements taught: a second effect that explains it in the windows that it was fitted to need not be there.
    ``held_out`` judges a fit.
    """
    aside = study.likewise()  # what is not taken back leaves what mesh and steps do as it was told
    while len(found.terms) > 1 and found.fit is not None:
        there = held_out(found.fit)
        for term in reversed([term for term in found.terms if term.slight or term is not found.terms[0]]):
            trial = replace(found, terms=list(found.terms))
            take_back(aside, trial, term)
            assert trial.fit is not None
            if not _felt(term, there, held_out(trial.fit)):
                found = trial
                study.tell(trial.fit.model, f"without {term.group.label}")
                break
        else:
            break
    return found


def _felt(term: Term, there: HeldOut, without: HeldOut) -> bool:
    """Whether held-out errors are larger without an effect: without a slight one, by 3 % or in nearly all windows."""
    if not term.slight:
        return there.after_mm < without.after_mm
    lost = replace(there, before_mm=without.after_mm, before=without.after)
    return lost.falls_surely
