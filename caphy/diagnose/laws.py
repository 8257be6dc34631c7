"""Which law of air a wind follows: the linear one is found, and the quadratic one tried in its place on roll-outs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import rankdata

from caphy.diagnose.groups import Group
from caphy.diagnose.search import Search, Term
from caphy.refit.columns import addition
from caphy.refit.heldout import Apart
from caphy.refit.laws import falls, in_another_law, law_of
from caphy.refit.study import Study

SURE = 2.0
"""Standard deviations of the signed ranks' sum within which two laws are alike."""
LEAST = 1.0
"""By how many of them another law must be better to take the place of the one that was found."""


def settle_laws(study: Study, found: Search, apart: Apart | None = None) -> None:
    """Put each accepted effect into the law with which roll-outs meet more windows better; those as good are even.

    Laws have as many numbers, so that windows held out, if there are any, tell like the others. Windows count by
    rank (Wilcoxon, Biometrics Bulletin 1, 1945): where a fold snaps under one law and not under the other, the misfit
    differs ten times as much as elsewhere and says nothing of the law.
    """
    for place, term in enumerate(found.terms):
        law = None if term.group.own else law_of(term.group.name)
        if law is not None:
            found.terms[place] = _settled(study, found, term, Group(law, addition(law)), apart)


def _settled(study: Study, found: Search, term: Term, law: Group, apart: Apart | None) -> Term:
    assert found.fit is not None
    first, before = found.screens[0], found.fit
    after = in_another_law(study, before, law.name, first.variance, first.evidence.weight)
    each = falls(before, after)
    if apart is not None:
        each = np.append(each, apart.misfits(before, first.model) - apart.misfits(after, first.model))
    sure = signed_ranks(each)
    even = (*term.even, term.group if sure > LEAST else law) if abs(sure) < SURE else term.even
    if sure <= LEAST:
        return replace(term, even=even)
    found.fit = after
    return replace(term, group=law, fit=after, even=even)


def signed_ranks(differences: np.ndarray) -> float:
    """The sum of signed ranks of differences (N,), in standard deviations that it has where signs are chance."""
    ranks = rankdata(np.abs(differences))
    return float((np.sign(differences) * ranks).sum() / np.sqrt((ranks**2).sum()))
