"""What was found must hold on measurements that nothing was fitted to, and each of several effects by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from caphy.diagnose.search import Search, take_back
from caphy.refit.heldout import HeldOut
from caphy.refit.study import Fit, Study


def each_proven(study: Study, found: Search, held_out: Callable[[Fit], HeldOut]) -> Search:
    """A search without the further effects whose loss raises no median on held-out measurements.

    What mesh and solver get wrong is not the same in every motion, and where a strong effect acts it is not what base
    measurements taught: a second effect that explains it in the windows that it was fitted to need not be there.
    ``held_out`` judges a fit.
    """
    while len(found.terms) > 1 and found.fit is not None:
        median = held_out(found.fit).after_mm
        for term in reversed(found.terms[1:]):
            trial = replace(found, terms=list(found.terms), removed=list(found.removed))
            take_back(study, trial, term)
            assert trial.fit is not None
            if held_out(trial.fit).after_mm <= median:
                found = trial
                break
        else:
            break
    return found
