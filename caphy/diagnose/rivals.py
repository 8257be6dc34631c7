"""Which of the explanations that come near an accepted one meets more windows better, those held out among them."""

from __future__ import annotations

import numpy as np

from caphy.diagnose.ambiguity import alike
from caphy.diagnose.groups import Group
from caphy.diagnose.laws import settled
from caphy.diagnose.search import Search, Term, refitted
from caphy.refit.heldout import Apart
from caphy.refit.study import Study, retold

TOLD = 0.5
"""Of what a fitted effect does: by how much what tangents promised may differ for them to have ranked it rightly."""


def settle_rivals(study: Study, found: Search, apart: Apart | None = None) -> None:
    """Put in the place of each accepted effect one that came near it, if that meets more windows better; those as good
    are even.

    Explanations are ranked by tangents where they are not there. Of internal friction and viscosity these tell a third
    and less of what a fit comes to, so that the wrong one may stand first. Rivals have as many numbers, so that windows
    held out tell like the others. Effects whose fit came to what tangents had told are left as they are.
    """
    for place in range(len(found.terms)):
        for rival in _rivals(found, found.terms[place]):
            term = found.terms[place]
            others = [other.group for other in found.terms if other is not term]
            first, what = found.screens[0], f"trying {rival.label} instead"
            fitted = refitted(study, found, (*others, rival), what)
            fitted = retold(study, fitted, first.variance, first.evidence.weight, what)
            found.terms[place] = settled(study, found, term, rival, fitted, apart)


def _rivals(found: Search, term: Term) -> list[Group]:
    """What else could be in the place of an accepted effect, with as many numbers: what came near it in the search, and
    what moves the cloth alike."""
    if term.group.own or _told(found, term):
        return []
    taken = {other.group.name for other in found.terms}
    tried = [group for group in found.screens[0].groups if group.label in term.tried]
    every = {group.name: group for group in (*tried, *alike(found, term)) if not group.own}
    size = len(term.group.columns)
    return [group for name, group in every.items() if name not in taken and len(group.columns) == size]


def _told(found: Search, term: Term) -> bool:
    """Whether tangents of some screen had told the numbers that were fitted."""
    assert found.fit is not None
    change = found.fit.change[[found.fit.columns.index(column) for column in term.group.columns]]
    for screen in found.screens:
        for score in screen.scores:
            if score.group.columns == term.group.columns:
                place, (normal, _) = screen.places[score.group.label], screen.evidence.normal
                metric, away = normal[np.ix_(place, place)], score.change - change
                if away @ metric @ away <= TOLD**2 * (change @ metric @ change):
                    return True
    return False
