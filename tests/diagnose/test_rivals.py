"""Which of two dampings acts, where the search took the wrong one, on cloth that an independent integrator moved."""

from __future__ import annotations

from dataclasses import replace

import pytest
from explicit_cloth import measured, simulate

from caphy.diagnose.diagnosis import Diagnosis, diagnose
from caphy.diagnose.groups import Group
from caphy.diagnose.rivals import settle_rivals
from caphy.diagnose.search import Search, refitted
from caphy.effects.model import Model
from caphy.refit.columns import addition

DENSITY, DRAG = 0.2, 0.4
MODEL = Model(DENSITY, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
HIDDEN, WRONG = "mass_damping", "air_drag_normal"


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    films = [measured(*simulate(tempo=tempo, settle=2.0, drag=DRAG), seed=7) for tempo in (1.15, 1.3)]
    return diagnose(MODEL, films)


def searched(diagnosis: Diagnosis, told: bool) -> Search:
    """The same search; unless ``told`` as if tangents had said nothing of its numbers."""
    screens = [screen if told else replace(screen, scores=[]) for screen in diagnosis.search.screens]
    return replace(diagnosis.search, terms=list(diagnosis.search.terms), screens=screens)


def mistaken(diagnosis: Diagnosis, told: bool) -> Search:
    """The same search, had it taken the wrong one."""
    found = searched(diagnosis, told)
    group, term = Group(WRONG, addition(WRONG)), found.terms[0]
    found.fit = refitted(diagnosis.study, found, [group], "the wrong one")
    found.terms = [replace(term, group=group, fit=found.fit, tried={WRONG: 0.5, HIDDEN: 0.45}, even=())]
    return found


def test_what_the_search_took_by_mistake_is_put_right(diagnosis):
    assert diagnosis.found == (HIDDEN,)
    found = mistaken(diagnosis, told=False)
    settle_rivals(diagnosis.study, found)
    (term,) = found.terms
    assert term.group.name == HIDDEN
    assert WRONG not in [group.name for group in term.even]
    assert found.fit is term.fit and found.fit is not None
    rate = float(found.model.effects[HIDDEN]["rate"])
    assert rate == pytest.approx(diagnosis.coefficients[f"{HIDDEN}.rate"].value, rel=0.03)
    assert rate == pytest.approx(DRAG / DENSITY, rel=0.06)  # the integrator damps edges a little, too


def test_what_is_right_stays(diagnosis):
    found = searched(diagnosis, told=False)
    before = found.fit
    found.terms[0] = replace(found.terms[0], tried={WRONG: 0.45, HIDDEN: 0.5})
    settle_rivals(diagnosis.study, found)
    assert found.fit is before and found.terms[0].group.name == HIDDEN


def test_what_tangents_told_is_tried_no_more(diagnosis):
    found = mistaken(diagnosis, told=True)
    before = found.fit
    settle_rivals(diagnosis.study, found)
    assert found.fit is before and found.terms[0].group.name == WRONG
