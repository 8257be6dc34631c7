"""Whether what came near an accepted explanation, fitted in its place, meets measurements better on real roll-outs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.diagnose.ambiguity import alike
from caphy.diagnose.groups import Group
from caphy.diagnose.search import HOPE, Search, Term, refitted
from caphy.refit.descent import retold
from caphy.refit.fit import Fit
from caphy.refit.heldout import Apart
from caphy.refit.intervals import acts
from caphy.refit.learned import Learned
from caphy.refit.study import Study

BEHIND = 0.5
"""Of what an accepted effect takes away: what a rival must at least hope for to be tried to its end."""
TOLD = 0.5
"""Of what a fitted effect does: by how much what tangents promised may differ for them to have ranked it rightly."""


def settle_rivals(study: Study, found: Search, apart: Apart, learned: Learned | None = None) -> None:
    """Put in the place of each accepted effect the one that came nearest to it, where that leaves less of the windows
    it is fitted to and of those that are held out. Where it leaves less of one of them, both are named.

    Explanations are ranked by tangents where they are not there. Of internal friction and viscosity these tell a third
    and less of what a fit comes to, so that the wrong one may stand first; nor do tangents at both fits tell, for
    neither is linear on the way between. Rivals have as many numbers, and what is held out was seen by neither. Effects
    whose fit came to what tangents had told are left as they are, unless they may be nothing: windows do not agree on
    how much there is of a wrong effect. So of two of which one surely acts it is the one, and the other is named
    beside it where it leaves less. ``learned`` from base measurements tells how sure numbers are.
    """
    aside = study.likewise()  # who is not taken leaves what mesh and steps do as it was told
    motions = len(study.scenes)
    for place, term in enumerate(found.terms):
        if found.fit is None or term.group.own:
            continue
        sure = acts(found.fit, term.group.columns, learned, motions)
        rival = None if sure and _told(found, term) else _rival(found, term)
        if rival is None:
            continue
        others, what = [other.group for other in found.terms if other is not term], f"trying {rival.label} instead"
        fitted = refitted(aside, found, (*others, rival), what)
        if sure and _far_behind(fitted, found.fit):
            continue
        fitted = retold(aside, fitted, what)
        better = [fitted.misfit < found.fit.misfit, _median(apart, fitted) < _median(apart, found.fit)]
        surely = acts(fitted, rival.columns, learned, motions)
        known = tuple(group for group in term.even if group.name != rival.name)
        if surely if surely != sure else all(better):
            study.tell(fitted.model, what)
            found.fit = fitted
            even = known if all(better) else (*known, term.group)
            found.terms[place] = replace(term, group=rival, fit=fitted, even=even)
        elif any(better):
            found.terms[place] = replace(term, even=(*known, rival))


def _far_behind(fitted: Fit, best: Fit) -> bool:
    """Whether a fit takes away so little that what a finer mesh does for it will not make it the better one."""
    hope = fitted.share + HOPE * fitted.promise / float((fitted.first.weight * fitted.first.c).sum())
    return hope < BEHIND * best.share


def _median(apart: Apart, fitted: Fit) -> float:
    return apart.errors(fitted).after_mm


def _rival(found: Search, term: Term) -> Group | None:
    """What came nearest to an accepted effect in the search, of as many numbers, or else what moves the cloth alike."""
    taken = {other.group.name for other in found.terms}
    weighed = [group for group in found.screens[0].groups if group.label in term.weighed]
    near = [*sorted(weighed, key=lambda group: -term.weighed[group.label]), *alike(found, term)]
    size = len(term.group.columns)
    fit = (group for group in near if not group.own and group.name not in taken and len(group.columns) == size)
    return next(fit, None)


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
