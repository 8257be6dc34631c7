"""What is not linear in an effect that was found, told on roll-outs: the law of a wind, the frequency of a gust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import rankdata

from caphy.diagnose.groups import Group
from caphy.diagnose.search import Search, Term
from caphy.refit.columns import addition, further
from caphy.refit.heldout import Apart
from caphy.refit.laws import falls, in_another_law, law_of, told_further
from caphy.refit.study import Fit, Study

SURE = 2.0
"""Standard deviations of the signed ranks' sum within which two laws are alike."""
LEAST = 1.0
"""By how many of them another law must be better to take the place of the one that was found."""


def settle_laws(study: Study, found: Search, apart: Apart | None = None) -> None:
    """Put each accepted effect into the law with which roll-outs meet more windows better; those as good are even. And
    fit parameters of it that are not linear, if that does as much.

    Laws have as many numbers, so that windows held out, if there are any, tell like the others. Windows count by
    rank (Wilcoxon, Biometrics Bulletin 1, 1945): where a fold snaps under one law and not under the other, the misfit
    differs ten times as much as elsewhere and says nothing of the law.
    """
    for place, term in enumerate(found.terms):
        if term.group.own or found.fit is None:
            continue
        name, variance, weight = term.group.name, found.screens[0].variance, found.screens[0].evidence.weight
        if (law := law_of(name)) is not None:
            fitted = in_another_law(study, found.fit, law, variance, weight)
            found.terms[place] = _settled(found, term, Group(law, addition(law)), fitted, apart)
        elif more := further(name):
            fitted = told_further(study, found.fit, name, variance, weight)
            found.terms[place] = _settled(found, term, Group(name, (*term.group.columns, *more)), fitted, apart)


def _settled(found: Search, term: Term, law: Group, after: Fit, apart: Apart | None) -> Term:
    assert found.fit is not None
    first, before = found.screens[0], found.fit
    each = falls(before, after)
    if apart is not None:
        each = np.append(each, apart.misfits(before, first.model) - apart.misfits(after, first.model))
    sure, even = signed_ranks(each), term.even
    if abs(sure) < SURE and law.name != term.group.name:
        even = (*even, term.group if sure > LEAST else law)
    if sure <= LEAST:
        return replace(term, even=even)
    found.fit = after
    return replace(term, group=law, fit=after, even=even)


def signed_ranks(differences: np.ndarray) -> float:
    """The sum of signed ranks of differences (N,), in standard deviations that it has where signs are chance."""
    ranks = rankdata(np.abs(differences))
    return float((np.sign(differences) * ranks).sum() / np.sqrt((ranks**2).sum()))
