"""The search: screen, refit the finalists on real roll-outs, accept or stop, and take back what is not needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from caphy.diagnose.base import Base
from caphy.diagnose.flexible import Flexible
from caphy.diagnose.groups import Group, columns_of, explanations
from caphy.diagnose.probes import WIDTHS, Probes
from caphy.diagnose.screen import Score, borrowed_gains, bounds, in_few, null_gains, screened
from caphy.effects.model import Model
from caphy.refit.columns import Column, addition, changes, extended, from_the_end, moved
from caphy.refit.descent import ROUNDS, refined, retold
from caphy.refit.evidence import Evidence, Weighing, ridged
from caphy.refit.fit import Fit, judged, share_gone
from caphy.refit.responses import Response, Watched, picked
from caphy.refit.settings import Settings, best_setting, in_setting, settings
from caphy.refit.study import Study
from caphy.refit.tangents import Pushes

LEAST_GAIN = 0.03
"""Share of the misfit an effect must take away in windows that it was not fitted to."""
LEAST_GAIN_OVER_BASE = 0.01
"""The same where base measurements tell what is found when nothing is missing."""
CHANCE = 0.95
"""Of the best gains of the library where nothing is missing, what an effect must be above. Not higher: signs of five or
six windows are drawn alike once in 2^5 or 2^6 times, which gives what was seen itself."""
LEAST_WALD = 20.0
"""Squared estimate over squared error."""
LEAST_WALD_OVER_BASE = 16.0
"""The same with base measurements: four standard errors."""
OVER_BASE = 2.0
"""How many times the best gain on base measurements, where nothing is missing."""
MISTAKEN = 0.5
"""Of the gain that an explanation had on base measurements before they were corrected: what it must reach besides."""
MOST_TERMS = 3
"""Effects that are added at most."""
FINALISTS = 4
"""Explanations that are refitted on real roll-outs in each round, at most."""

SMALL = 0.3
"""Gain below which an effect moves the cloth so little that tangents alone rank it; roll-outs differ by more.
Only where base measurements have told the parameters: a stiffness that is far off does not act linearly."""

OWN = 1.5
"""Times the best gain of the library: what parameters must reach that base measurements have told already."""
HOPE = 2.0
"""Times its promise: what a fit that has not settled may still take away."""

_ITSELF = 0.99  # of a gain by chance: of a window that says next to nothing it does not matter how its sign was drawn
_CLOSE = 0.6  # of the best gain: what is refitted
_EVEN = 0.85  # of the best gain: what tangents do not tell from it
_ROLLED = 0.05  # of the misfit: by how much one roll-out must be better than another to mean anything
_UNDECIDED = 0.01  # of the misfit: what a step must promise for another roll-out while the best is still looked for
_TIE = 0.93  # of the best fall of the misfit: where fewer numbers win
_FURTHER = 0.05  # of the misfit that is left: what a further effect must take away, or else prove on held-out windows
_HEATS = 2  # steps of all explanations
_BEHIND = 0.8  # of the best share by then: what an explanation must still hope for
_DISPENSABLE = 0.03  # share of the misfit whose loss does not keep an effect


@dataclass(frozen=True, eq=False)
class Screen:
    """All windows against one model, in the columns of the whole library.

    ``needed`` is the gain that an effect must reach to be accepted, ``more_needed`` what some need instead, by label;
    ``flexible`` is of the flexible forces, ``elsewhere`` of effects in all settings at which they are looked
    for, by name.
    """

    model: Model
    groups: tuple[Group, ...]
    places: dict[str, list[int]]
    responses: list[Response]
    variance: np.ndarray
    evidence: Evidence
    scores: list[Score]
    needed: float
    more_needed: dict[str, float]
    flexible: Flexible
    elsewhere: dict[str, list[Response]]

    @property
    def weighing(self) -> Weighing:
        """What windows are weighed by; all screens of a search share it."""
        return Weighing(self.variance, self.evidence.weight)

    @property
    def misfit(self) -> float:
        """Weighted chi2 of the model as it is."""
        return float((self.evidence.weight * self.evidence.c).sum())

    def needed_by(self, score: Score) -> float:
        """The gain that an explanation must reach."""
        return max(self.needed, self.more_needed.get(score.group.label, 0.0))

    def enough(self, score: Score) -> bool:
        """Whether an explanation's gain is beyond chance, and beyond what mesh and solver can look like."""
        return score.gain >= self.needed_by(score)


@dataclass(frozen=True, eq=False)
class Term:
    """Accepted in a round: the group, the fit with it, what candidates were ``weighed`` by, and those that came so near
    on roll-outs that nothing tells which it is. One of several is ``slight`` where it takes away so little that windows
    that are held out must prove it. Candidates that were fitted ``took`` so much of the misfit."""

    group: Group
    fit: Fit
    weighed: dict[str, float]
    even: tuple[Group, ...] = ()
    slight: bool = False
    took: dict[str, float] = field(default_factory=dict)


@dataclass(eq=False)
class Search:
    """How the search went; ``screens`` has one entry for the start and one for each round."""

    screens: list[Screen] = field(default_factory=list)
    terms: list[Term] = field(default_factory=list)
    fit: Fit | None = None

    def accept(self, term: Term) -> None:
        """Add a term, or put it in the place of the same one, which was fitted on."""
        labels = [other.group.label for other in self.terms]
        if term.group.label in labels:
            self.terms[labels.index(term.group.label)] = term
        else:
            self.terms.append(term)

    @property
    def taken(self) -> float:
        """Share of the misfit that what was accepted takes away."""
        return 0.0 if self.fit is None else self.fit.share

    @property
    def model(self) -> Model:
        """With everything that was accepted."""
        return self.screens[0].model if self.fit is None else self.fit.model


def least_wald(sure_of_parameters: bool) -> float:
    """Squared estimate over squared error that an effect must reach."""
    return LEAST_WALD_OVER_BASE if sure_of_parameters else LEAST_WALD


def search(
    study: Study,
    model: Model,
    original: Model,
    base: Base | None = None,
    held_out: bool = False,
) -> Search:
    """Find what a model lacks in the windows of a study.

    Args:
        original: the user's model; effects that it lacks count as added.
        base: what was learned from base measurements.
        held_out: whether there are held-out windows, by which slight further effects can be proven.
    """
    found = Search()
    found.screens.append(screen(study, model, original, base))
    for _ in range(MOST_TERMS):
        _tune(study, found, original, base)
        term = _next_term(study, found, base is not None, held_out)
        if term is None:
            break
        found.accept(term)
        found.fit = term.fit
        far = term.fit.share > SMALL
        found.screens.append(screen(study, term.fit.model, original, base, found.screens[0], far))
    _eliminate(study, found, held_out)
    return found


def screen(
    study: Study,
    model: Model,
    original: Model,
    base: Base | None = None,
    first: Screen | None = None,
    far: bool = False,
) -> Screen:
    """All windows against a model and the whole library; what ``original`` lacks counts as added.

    A later screen keeps the variance and the weights of the ``first``. Where it is ``far`` from it, what base
    measurements taught to expect is told by the responses here: those of cloth that crumpled, since it was too large,
    were wild, and of a start that could do as much.
    """
    groups = explanations(study, model, original)
    columns, _ = columns_of(groups)
    absent = dict.fromkeys(group.name for group in groups if group.name not in model.effects)
    looked = [Settings(model, name) for name in absent if settings(name)]
    probed = study.respond(model, columns, "screening", _Together((Probes(model), *looked)), anew={"start"})
    if base is not None and (first is None or far):
        probed = study.correct(probed, columns, base.correction_in(probed, columns))
    responses = picked(probed, range(len(columns)))
    if first:
        weighing = first.weighing
    else:
        weighing = Weighing.robust(responses, base.variance if base else study.variance(responses))
    last = len(columns) + sum(WIDTHS.values())
    flexible = Flexible.of(study, picked(probed, range(len(columns), last)), weighing)
    elsewhere = {}
    for each in looked:
        elsewhere[each.name] = picked(probed, range(last, last + each.count))
        last += each.count
    return _weighed(model, groups, responses, weighing, base, flexible, elsewhere)


def _weighed(
    model: Model,
    groups: tuple[Group, ...],
    responses: list[Response],
    weighing: Weighing,
    base: Base | None,
    flexible: Flexible,
    elsewhere: dict[str, list[Response]],
) -> Screen:
    """What windows say of all groups, and what each must gain."""
    columns, places = columns_of(groups)
    known = weighing.of(responses)
    scores = screened(known, groups, places, model)
    few, limits = in_few(known, places), bounds(columns, model)
    chance = null_gains(known, [index for label, index in places.items() if label not in few], limits)
    needed = LEAST_GAIN if base is None else max(LEAST_GAIN_OVER_BASE, OVER_BASE * base.gain)
    needed = max(needed, _ITSELF * float(np.quantile(chance, CHANCE)))
    more = {group.label: 0.0 if base is None else _more_needed(group, base) for group in groups}
    lent = borrowed_gains(known, responses, weighing.variance, [places[label] for label in few], limits)
    more |= {label: max(more[label], float(np.quantile(lent, CHANCE))) for label in few}
    return Screen(model, groups, places, responses, weighing.variance, known, scores, needed, more, flexible, elsewhere)


@dataclass(frozen=True, eq=False)
class _Together:
    """Forces one after another; other processes can be told."""

    parts: tuple[Probes | Settings, ...]

    def __call__(self, watched: Watched) -> Pushes:
        pushes = [part(watched) for part in self.parts]
        return lambda x, step, body: torch.cat([push(x, step, body) for push in pushes])


def _tune(study: Study, found: Search, original: Model, base: Base | None) -> None:
    """Look for effects in other settings than by default: one that explains more there than anything else is switched
    off in that setting from now on."""
    for name in list(found.screens[-1].elsewhere):
        first, last = found.screens[0], found.screens[-1]
        known = last.weighing.of(last.elsewhere[name])
        place, share = best_setting(known, last.model, name)
        if share < max(last.needed, last.scores[0].gain):
            continue
        other = _in_setting(study, last, name, place, original, base)
        if other.scores[0].group.name == name and other.scores[0].gain > last.scores[0].gain:
            if last is not first:
                found.screens[0] = screen(study, in_setting(first.model, name, place), original, base, first)
            found.screens[-1] = other


def _in_setting(study: Study, last: Screen, name: str, place: int, original: Model, base: Base | None) -> Screen:
    """A screen with an effect in another setting; without strength it changes nothing else."""
    model, there = in_setting(last.model, name, place), addition(name)
    groups = explanations(study, model, original)
    every, _ = columns_of(last.groups)
    columns, _ = columns_of(groups)
    known = [column for column in columns if column not in there]
    kept = picked(last.responses, [every.index(column) for column in known])
    moved_to = picked(last.elsewhere[name], range(place * len(there), (place + 1) * len(there)))
    both = [replace(r, columns=np.concatenate([r.columns, s.columns], -1)) for r, s in zip(kept, moved_to, strict=True)]
    responses = picked(both, [(*known, *there).index(column) for column in columns])
    rest = {other: found for other, found in last.elsewhere.items() if other != name}
    return _weighed(model, groups, responses, last.weighing, base, last.flexible, rest)


def _more_needed(group: Group, base: Base) -> float:
    """What mesh and solver look like differs between motions; and parameters were fitted to the base."""
    return max(LEAST_GAIN if group.own else 0.0, MISTAKEN * base.mistaken.get(group.label, 0.0))


def finalists(last: Screen, sure_of_parameters: bool = False, first: bool = True) -> list[Score]:
    """The explanations worth a refit: those near the best of what is beyond chance.

    Parameters that base measurements told are no explanation of what an effect leaves over (``first`` is false then).
    """
    beyond = [score for score in last.scores if last.enough(score)]
    if sure_of_parameters:
        library = max((score.gain for score in beyond if not score.group.own), default=0.0)
        own = OWN * library if first else np.inf
        beyond = [score for score in beyond if not score.group.own or score.gain >= own]
    wald = least_wald(sure_of_parameters)
    sure = [score for score in beyond if score.wald >= wald]
    return [score for score in sure if score.gain >= _CLOSE * sure[0].gain][:FINALISTS]


def ranked(scores: Sequence[Score], sure_of_parameters: bool) -> list[Score]:
    """The explanations in the order in which they would be chosen, each after those before it: by gain, but of those
    that gain as much the simplest first, and parameters that base measurements told by what they gain beyond the
    library."""
    gain = {score.group.label: score.gain / (OWN if score.group.own and sure_of_parameters else 1) for score in scores}
    left, found = list(scores), []
    while left:
        found.append(_simplest(left, gain, sure_of_parameters))
        left.remove(found[-1])
    return found


def _next_term(study: Study, found: Search, sure_of_parameters: bool, held_out: bool) -> Term | None:
    last = found.screens[-1]
    near = finalists(last, sure_of_parameters, not found.terms)
    if not near:
        return None
    if sure_of_parameters and near[0].gain < SMALL:
        shares = {score.group.label: score.gain for score in near}
        chosen, fits = _told_by_tangents(study, found, near, shares)
    else:
        rounds = 1 if sure_of_parameters else ROUNDS
        fits = _raced(study, found, near, rounds)
        shares = {label: each.share for label, each in fits.items()}
        chosen = _simplest(near, shares, sure_of_parameters)
    label = chosen.group.label
    best = fits[label]
    least = last.needed
    if found.terms:  # beside a strong effect base measurements do not tell what is found where nothing is missing
        least = max(least, LEAST_GAIN if held_out else _FURTHER)
    if _more(last, best) + HOPE * best.promise / last.misfit < least:
        return None
    if not best.converged:
        best = refined(study, best, f"fitting {label}")
    more = _more(last, best)
    slight = bool(found.terms) and more < _FURTHER
    if more < least or (slight and _own_gain(last) >= _EVEN * chosen.gain):
        return None
    if found.fit is not None:
        best = replace(best, by_retelling=found.fit.by_retelling)
    best = retold(study, best)
    far = fits[label].misfit + _ROLLED * last.misfit
    groups = {score.group.label: score.group for score in near}
    even = tuple(groups[other] for other, each in fits.items() if other != label and each.misfit <= far)
    took = {**{each: fitted.share for each, fitted in fits.items()}, label: best.share}
    return Term(chosen.group, best, shares, even, slight, took)


def _own_gain(last: Screen) -> float:
    """Best gain of the model's own parameters.

    Where they explain as much of what an effect leaves over as a slight further effect does, it is they that are off: a
    stiffness that base measurements put right but for 14 % looked like a shrinkage that was not there, on held-out
    windows too.
    """
    return max((score.gain for score in last.scores if score.group.own), default=0.0)


def _more(last: Screen, best: Fit) -> float:
    """Share of the misfit that a fit takes away since the last screen."""
    since = changes(extended(last.model, best.columns), best.model, best.columns)
    return share_gone(_told(last, best.columns), best.evidence, since, from_the_end(best.columns, since))[0]


def _raced(study: Study, found: Search, near: Sequence[Score], rounds: int) -> dict[str, Fit]:
    """Explanations fitted in so many steps at most. After two of them one goes on only if it may still come near the
    best: by more than it promises, since what is far off does not act linearly."""
    last = found.screens[-1]
    fits = {score.group.label: _fitted(study, found, score, min(rounds, _HEATS)) for score in near}
    best = max(each.share for each in fits.values())
    for label, each in fits.items():
        hope = each.share + HOPE * each.promise / last.misfit
        if rounds > _HEATS and not each.converged and hope >= _BEHIND * best:
            what, left = f"trying {label}", rounds - _HEATS
            fits[label] = refined(study, each, what, left)
    return fits


def _told_by_tangents(
    study: Study, found: Search, near: Sequence[Score], shares: dict[str, float]
) -> tuple[Score, dict[str, Fit]]:
    """The best by tangents; where one with as few numbers is as good, roll-outs decide if they differ by enough."""
    chosen = _simplest(near, shares, True)
    even = [s for s in near if s.size <= chosen.size and s.gain >= _EVEN * chosen.gain]
    fits = {score.group.label: _fitted(study, found, score, ROUNDS, _UNDECIDED) for score in even}
    misfits = {label: each.misfit for label, each in fits.items()}
    least = min(even, key=lambda score: misfits[score.group.label])
    if misfits[least.group.label] < misfits[chosen.group.label] - _ROLLED * found.screens[-1].misfit:
        chosen = least
    return chosen, fits


def _simplest(near: Sequence[Score], shares: dict[str, float], sure_of_parameters: bool) -> Score:
    """The one that takes most of the misfit away, or of those as good the one with the fewest numbers.

    Parameters that nobody has fitted come first: they are off more often than effects are missing.
    """
    best = max(shares[score.group.label] for score in near)
    equal = [score for score in near if shares[score.group.label] >= min(_TIE * best, best)]
    first = [score for score in equal if score.group.own and not sure_of_parameters] or equal
    return min(first, key=lambda score: (score.size, -shares[score.group.label]))


def _fitted(study: Study, found: Search, score: Score, rounds: int, enough: float = 0.0) -> Fit:
    """An explanation fitted beside those accepted before, by a few steps."""
    first, last = found.screens[0], found.screens[-1]
    every, _ = columns_of(last.groups)
    before = () if found.fit is None else found.fit.columns
    columns = (*before, *(column for column in score.group.columns if column not in before))
    responses = picked(last.responses, [every.index(column) for column in columns])
    what = f"trying {score.group.label}"
    windows = _windows(first, columns)
    told = first.weighing.of(windows)  # where the search began
    start = judged(first.model, last.model, columns, responses, last.weighing, None, told, windows)
    return refined(study, start, what, rounds, enough)


def _windows(screen: Screen, columns: Sequence[Column]) -> list[Response]:
    """What windows of a screen say of some columns."""
    every, _ = columns_of(screen.groups)
    return picked(screen.responses, [every.index(column) for column in columns])


def _told(screen: Screen, columns: Sequence[Column]) -> Evidence:
    """What a screen says of some columns."""
    every, _ = columns_of(screen.groups)
    return screen.evidence.picked([every.index(column) for column in columns])


def _eliminate(study: Study, found: Search, held_out: bool) -> None:
    """Take back accepted effects whose loss costs next to nothing once the others are refitted.

    Where held-out windows can prove it, one is left whose loss costs what an effect must gain: on a body the first of
    two may have been let in by less than what is next to nothing on a square.
    """
    if len(found.terms) < 2 or found.fit is None:
        return
    little = min(_DISPENSABLE, found.screens[0].needed) if held_out else _DISPENSABLE
    for term in list(found.terms[:-1]):
        lost = _lost(found.fit, term)
        if lost <= little:
            take_back(study, found, term)
        elif lost <= _DISPENSABLE:
            found.accept(replace(term, slight=True))


def take_back(study: Study, found: Search, term: Term) -> None:
    """Remove one of several accepted effects, and fit the others without it."""
    others = [other for other in found.terms if other is not term]
    found.fit = refitted(study, found, [other.group for other in others], f"without {term.group.label}")
    found.terms = others


def looked_again(study: Study, found: Search, original: Model, base: Base | None) -> None:
    """Screen what is left once more where effects of the last screen's model were taken back."""
    if len(found.model.effects) < len(found.screens[-1].model.effects):
        far = found.taken > SMALL
        found.screens.append(screen(study, found.model, original, base, found.screens[0], far))


def refitted(study: Study, found: Search, groups: Sequence[Group], what: str) -> Fit:
    """Groups fitted from the numbers that they have by now, without those of others."""
    assert found.fit is not None
    first = found.screens[0]
    columns = tuple(column for group in groups for column in group.columns)
    start, known = extended(first.model, columns), extended(found.fit.model, columns)
    start = moved(start, columns, changes(start, known, columns))
    responses = study.respond(start, columns, what, anew={"solver"})
    told, windows = _told(first, columns), _windows(first, columns)
    fitted = judged(first.model, start, columns, responses, first.weighing, None, told, windows)
    fitted = refined(study, fitted, what)
    return replace(fitted, by_retelling=found.fit.by_retelling)


def _lost(fitted: Fit, term: Term) -> float:
    """Share of the misfit that comes back without a term, by tangents, the other numbers free."""
    gone = np.array([column in term.group.columns for column in fitted.columns])
    known = fitted.asked
    change = np.where(gone, -from_the_end(fitted.columns, fitted.change), 0.0)
    normal, right = known.normal
    change[~gone] = ridged(normal[np.ix_(~gone, ~gone)], (right - normal @ change)[~gone], 1e-9)
    here, there = float((known.weight * known.c).sum()), float(known.misfit(change).sum())
    return (there - here) / there
