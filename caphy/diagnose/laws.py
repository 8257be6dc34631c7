"""What is not linear in an effect that was found, told by windows: the law of a wind, the frequency of a gust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.diagnose.groups import Group
from caphy.diagnose.search import Search, Term
from caphy.refit.columns import addition, further
from caphy.refit.fit import Fit
from caphy.refit.heldout import Apart
from caphy.refit.laws import LEAST, in_another_law, laws_of, signed_ranks, told_further, way
from caphy.refit.study import Study

SURE = 2.0
"""Standard deviations of the signed ranks' sum within which two laws are alike."""


def settle_laws(study: Study, found: Search, apart: Apart | None = None) -> None:
    """Put each accepted effect into the law that meets more windows better, of several one after another; those as good
    are even. And fit parameters of it that are not linear, if that does as much.

    Laws have as many numbers, so that windows held out, if there are any, tell like the others. Tangents tell, from
    either end of the way between the fits, and windows count by rank: where a fold snaps under one law and not under
    the other, a window's misfit differs ten times as much as elsewhere and says nothing of the law.
    """
    aside = study.likewise()  # what is not taken leaves what mesh and steps do as it was told
    before = found.fit
    for place, term in enumerate(found.terms):
        if term.group.own or found.fit is None:
            continue
        name = term.group.name
        if laws := laws_of(name):
            linear = found.fit
            for law in laws:
                fitted = in_another_law(aside, linear, law)
                group = Group(law, addition(law))
                found.terms[place] = _settled(aside, found, found.terms[place], group, fitted, apart)
        elif more := further(name):
            fitted = told_further(aside, found.fit, name)
            found.terms[place] = _settled(aside, found, term, Group(name, (*term.group.columns, *more)), fitted, apart)
    if found.fit is not None and found.fit is not before:
        study.tell(found.fit.model, "in another law")


def _settled(study: Study, found: Search, term: Term, law: Group, after: Fit, apart: Apart | None) -> Term:
    assert found.fit is not None
    first, before = found.screens[0], found.fit
    between = way(before, after)
    each = between.falls(study, first.weighing)
    if apart is not None:
        each = np.append(each, apart.falls(between, first.model))
    sure, even = signed_ranks(each), term.even
    if abs(sure) < SURE and law.name != term.group.name:
        even = (*even, term.group if sure > LEAST else law)
    if sure <= LEAST:
        return replace(term, even=even)
    found.fit = after
    return replace(term, group=law, fit=after, even=even)
