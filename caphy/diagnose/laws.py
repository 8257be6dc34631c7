"""Which law of air a wind follows: the linear one is found, and the quadratic one tried in its place on roll-outs."""

from __future__ import annotations

from dataclasses import replace

from caphy.diagnose.groups import Group
from caphy.diagnose.search import Search, Term
from caphy.refit.columns import addition
from caphy.refit.laws import gained, in_another_law, law_of
from caphy.refit.study import Study

SURE = 2.0
"""Standard errors over windows within which two laws are alike."""
LEAST = 1.0
"""By how many of them another law must be better to be named first."""


def settle_laws(study: Study, found: Search) -> None:
    """Put each accepted effect into the law with which roll-outs meet the windows best; those as good are even."""
    for place, term in enumerate(found.terms):
        law = None if term.group.own else law_of(term.group.name)
        if law is not None:
            found.terms[place] = _settled(study, found, term, Group(law, addition(law)))


def _settled(study: Study, found: Search, term: Term, law: Group) -> Term:
    assert found.fit is not None
    first, before = found.screens[0], found.fit
    after = in_another_law(study, before, law.name, first.variance, first.evidence.weight)
    fall, error = gained(before, after)
    better = fall > LEAST * error
    even = (*term.even, term.group if better else law) if abs(fall) < SURE * error else term.even
    if not better:
        return replace(term, even=even)
    found.fit = after
    return replace(term, group=law, fit=after, even=even)
