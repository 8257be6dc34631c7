"""Add effects to a model and fit their numbers to measurements; what does not lower the held-out error is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.body.model import BodyModel
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene
from caphy.measure.track import Progress
from caphy.refit import openings
from caphy.refit.again import as_registered_first, fitted_again
from caphy.refit.clouds import all_registered
from caphy.refit.columns import Column, addition, extended, further, moved, strengths, tunable
from caphy.refit.crew import Crew
from caphy.refit.descent import fit, refined, retold, weighed_anew
from caphy.refit.evidence import Weighing
from caphy.refit.fit import Fit, judged
from caphy.refit.heldout import FALLS, Apart, HeldOut, rises_where_fitted
from caphy.refit.intervals import intervals
from caphy.refit.laws import LEAST as BETTER
from caphy.refit.laws import in_another_law, signed_ranks, told_further, way
from caphy.refit.learned import Learned
from caphy.refit.responses import Response, picked
from caphy.refit.settings import Settings, best_setting, in_setting, settings
from caphy.refit.study import FEWEST, Study

LEAST = 0.01
"""Share of the held-out misfit that must go in any case."""
DISPENSABLE = 0.02
"""Share of the misfit whose loss does not keep an effect."""

_LATER = 4  # without held-out measurements one window in so many is held out


@dataclass(frozen=True, eq=False)
class Refit:
    """A model with effects added and fitted.

    Attributes:
        model: the result; the model as it was where nothing was kept.
        kept, removed: effects that stayed and that were taken back.
        coefficients: fitted numbers, name -> (value, low, high, unit), intervals of 95 %.
        held_out: error before and after.
        reason: why effects were taken back, each of them, in words.
        share: of the misfit of the windows it was fitted to, what the fit takes away.
        refused: whether held-out measurements contradict the fit, so that the model stays as it was.
        notes: what is to be said beside that, each a clause.
    """

    model: Model
    kept: tuple[str, ...]
    removed: tuple[str, ...]
    coefficients: dict[str, tuple[float, float, float, str]]
    held_out: HeldOut
    reason: str
    share: float
    refused: bool = False
    notes: tuple[str, ...] = ()


def refit(
    model: Model,
    measurements: Sequence[Measurement],
    add: Sequence[str] = (),
    held_out: Sequence[Measurement] = (),
    garment: Garment | None = None,
    body: BodyModel | None = None,
    progress: Progress | None = None,
    crew: Crew | None = None,
    learned: Learned | None = None,
) -> Refit:
    """Fit the numbers of added effects, or without any the model's own parameters, jointly on real roll-outs.

    Point clouds are registered with the model's help. Without held-out measurements every fourth window is held out.
    ``crew`` shares the work. What base measurements have ``learned`` is taken from all residuals, and the refit starts
    from the parameters that they asked for.

    Raises:
        CaphyError: an effect is unknown, is there already, or the measurements are too short.
    """
    names = addable(model, add)
    model = model if learned is None else learned.model
    given = [Scene.of(measurement, garment, body) for measurement in (*measurements, *held_out)]
    given = all_registered(given, model, progress, crew)
    scenes, apart = given[: len(measurements)], given[len(measurements) :]
    mesh = None if learned is None else learned.mesh
    study = Study(scenes, progress=progress, crew=crew, mesh=mesh)
    proof = Study(apart, progress=progress, crew=crew, mesh=mesh) if apart else _split(study)
    fitted, first, removed = _fitted(study, model, names, learned)
    variance = first.variance
    judge = Apart(proof, variance, () if learned is None else learned.columns, learned)
    errors = judge.errors(fitted)
    kept = tuple(name for name in names if name not in removed)
    numbers = intervals(fitted, learned, len(study.scenes))
    reason = "" if not removed else f"without {', '.join(removed)} the fit is as good"
    why = _refused(errors, first.responses, fitted, numbers, kept)
    notes: tuple[str, ...] = ()
    if not why:
        again = fitted_again(study, fitted, variance, learned is None)
        if again is not None:
            there = judge.registered_by(again.fit.model)
            fitted, errors = again.fit, there.errors(again.fit)
            numbers = intervals(fitted, learned, len(study.scenes))
            why = _refused(errors, again.before, fitted, numbers, kept)
            notes = as_registered_first("held-out clouds", proof, there.study is not proof)
        else:
            notes = as_registered_first("clouds", study, False)
    if why:
        why = f"{why}: {', '.join(kept) or 'the new parameters'} refused"
        reason = "; ".join(filter(None, (reason, why)))
        return Refit(model, (), names, numbers, errors, reason, fitted.share, True, notes)
    return Refit(fitted.model, kept, removed, numbers, errors, reason, fitted.share, notes=notes)


def _refused(
    errors: HeldOut, before: Sequence[Response], fitted: Fit, numbers: Mapping[str, tuple], added: Sequence[str]
) -> str:
    """Why a fit does not hold on held-out measurements or where it was fitted, where windows were ``before`` it, and
    that nothing is known of what was added; empty where all is well.

    ``numbers`` begin with a value and its interval. Proof is what a diagnosis asks for, and a misfit that falls.
    """
    found, there = [], "on held-out measurements"
    fell = f"falls by {100 * errors.share:z.1f} %"
    medians = f"goes from {errors.before_mm:.2f} to {errors.after_mm:.2f} mm"
    if added and not any(numbers[name][1] > 0 or numbers[name][2] < 0 for name in strengths(fitted.columns)):
        found.append("none of its numbers is surely different from zero")
    if errors.share < LEAST:
        found.append(f"{there} the misfit must fall by {100 * LEAST:.0f} %, but {fell}")
    if errors.after_mm >= errors.before_mm and not errors.outweighs(fitted.share):
        found.append(f"{there} the median distance must fall, but it {medians}")
    elif errors.share >= LEAST and not errors.proves(fitted.share):
        found.append(
            f"{there} the median distance must fall by {100 * (1 - FALLS):.0f} %, or the misfit by a third of what it "
            f"falls by where the model is fitted ({100 * fitted.share:z.1f} %), surely there or from one motion to "
            f"another of those; the median {medians}, the misfit {fell}"
        )
    if rises := rises_where_fitted(before, fitted.responses):
        found.append(rises)
    return "; ".join(found)


@dataclass(frozen=True, eq=False)
class _First:
    misfit: float
    variance: np.ndarray
    responses: list[Response]


def addable(model: Model, add: Sequence[str]) -> tuple[str, ...]:
    """Names of effects to add to a model, each once; raises :class:`CaphyError` where one cannot be."""
    for name in add:
        effect = find_effect(name)
        if name in model.effects:
            raise CaphyError(f"the model has {name} already; leave out --add to refit its parameters")
        if not effect.coefficients:
            raise CaphyError(f"{name} has no coefficient that could be zero, so it cannot be added and fitted")
        if effect.lenders(model.effects) is None:
            raise CaphyError(f"{name} reads the parameters of an effect that the model lacks; see caphy effects show")
        if effect.refines in (*model.effects, *add):
            raise CaphyError(
                f"{name} is another law of {effect.refines}, which is there or to be added; keep one of them"
            )
    names = tuple(dict.fromkeys(add))
    twice = [name for name in names if sum(_found_as(other) == _found_as(name) for other in names) > 1]
    if twice:
        raise CaphyError(f"{' and '.join(twice)} are laws of the same effect; add one of them")
    return names


def _found_as(name: str) -> str:
    """The effect with which the search for another begins."""
    return find_effect(name).refines or name


def _columns(model: Model, names: Sequence[str]) -> tuple[Column, ...]:
    if names:
        return tuple(column for name in names for column in addition(name))
    return tuple(column for name in model.effects for column in tunable(name, model))


def _fitted(
    study: Study, model: Model, names: tuple[str, ...], learned: Learned | None
) -> tuple[Fit, _First, tuple[str, ...]]:
    """The joint fit, then without each effect that is not needed (backward elimination), then in the laws wanted."""
    wanted = {_found_as(name): name for name in names}
    names = tuple(wanted)
    columns = _columns(model, names)
    if learned is None:
        responses = study.respond(model, columns, "before")
        variance = study.variance(responses)
    else:
        every = (*learned.columns, *(column for column in columns if column not in learned.columns))
        responses = study.respond(model, every, "before")
        responses = study.correct(responses, every, learned.correction_in(responses, every))
        responses = picked(responses, [every.index(column) for column in columns])
        variance = learned.variance
    weighing = Weighing.robust(responses, variance)
    known = weighing.of(responses)
    first = _First(float((known.weight * known.c).sum()), variance, responses)
    fitted = openings.told(columns, known, DISPENSABLE * first.misfit)
    columns, responses = tuple(columns[place] for place in fitted), picked(responses, fitted)
    for name in names:
        if settings(name):
            elsewhere = study.respond(model, (), f"looking for {name}", Settings(model, name))
            model = in_setting(model, name, best_setting(weighing.of(elsewhere), model, name)[0])
            responses = study.respond(model, columns, "before")
    best, removed = fit(study, model, columns, responses, weighing), []
    while len(names) - len(removed) > 1:
        left = [name for name in names if name not in removed]
        trials = {name: _without(study, best, [n for n in left if n != name]) for name in left}
        name = min(trials, key=lambda each: trials[each].misfit)
        if trials[name].misfit - best.misfit > DISPENSABLE * first.misfit:
            break
        best = trials[name]
        removed.append(name)
    best = retold(study, best)
    best = _in_laws(study, best, {name: law for name, law in wanted.items() if name not in removed}, weighing)
    if learned is None:
        best = weighed_anew(study, best)
    for name in removed:  # what was put where it was looked for
        best = replace(best, model=best.model.without_effect(name), origin=best.origin.without_effect(name))
    return best, first, tuple(wanted[name] for name in removed)


def _in_laws(study: Study, best: Fit, wanted: Mapping[str, str], weighing: Weighing) -> Fit:
    """A fit in the laws that are wanted of its effects, or with further parameters of these where that does more."""
    aside, found = study.likewise(), best  # what is not kept leaves what mesh and steps do as it was told
    for name, law in wanted.items():
        if law != name:
            found = in_another_law(aside, found, law)
        elif further(name):
            on = told_further(aside, found, name)
            if signed_ranks(way(found, on).falls(aside, weighing)) > BETTER:
                found = on
    if found is not best:
        study.tell(found.model, "in the laws wanted")
    return found


def _without(study: Study, best: Fit, names: Sequence[str]) -> Fit:
    """A fit of some of its effects, from the numbers that they have."""
    columns = tuple(column for column in best.columns if column.effect in names)
    windows = picked(best.windows, [best.columns.index(column) for column in columns])
    start = extended(best.origin, columns)
    start = moved(start, columns, np.array([column.value(best.model) for column in columns]))
    responses, first = study.respond(start, columns, "without one"), best.weighing.of(windows)
    fitted = judged(best.origin, start, columns, responses, best.weighing, None, first, windows)
    return refined(study, fitted, "without one")


def _split(study: Study) -> Study:
    """Move every fourth window of a study into another one."""
    proof = study.afresh()
    place = 0
    for number, starts in enumerate(study.starts):
        later = [(place + i) % _LATER == _LATER - 1 for i in range(len(starts))]
        proof.starts[number] = [start for start, late in zip(starts, later, strict=True) if late]
        study.starts[number] = [start for start, late in zip(starts, later, strict=True) if not late]
        place += len(later)
    if sum(map(len, study.starts)) < FEWEST:
        raise CaphyError(
            f"a refit needs at least {FEWEST} windows besides those held out, got {sum(map(len, study.starts))}; "
            "measure longer motions, or give --held-out"
        )
    return proof
