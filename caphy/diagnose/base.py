"""What base measurements give: parameters, what mesh and solver get wrong, and what is left where nothing is missing.

A mesh is coarser than the cloth: it locks, it is shorter along its folds, it damps. In the columns of the library such
errors look like effects (a shrinkage of 0.2 %, some viscosity), the same in every motion, and they are larger than
many an effect worth finding. Base measurements, in which nothing is missing, tell how much of each column they look
like; that much is taken from the residuals of all later measurements. It is the discrepancy of Kennedy and O'Hagan (J.
R. Stat. Soc. B 63, 2001) in a basis of physical effects, told from data of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from caphy.body.model import BodyModel
from caphy.diagnose.checks import check_cloth
from caphy.diagnose.earlier import Earlier, earlier
from caphy.diagnose.flexible import Flexible
from caphy.diagnose.groups import Group, columns_of, explanations
from caphy.diagnose.probes import Probes
from caphy.diagnose.screen import screened
from caphy.effects.model import Model
from caphy.garment.template import Garment
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene
from caphy.measure.track import Progress
from caphy.refit.clouds import all_registered
from caphy.refit.columns import Column
from caphy.refit.crew import Crew
from caphy.refit.descent import fit
from caphy.refit.evidence import Evidence, Weighing, ridged
from caphy.refit.fit import Fit
from caphy.refit.learned import Learned
from caphy.refit.responses import Response, median_mm, picked
from caphy.refit.study import Study

RIDGES = (1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""How much corrections may be shrunk, in units of what the data say of each alone; windows left out choose."""

ALL_OF_IT = 4 / 3
"""Of what a mesh with edges half as long does otherwise: the whole error, where it falls with their square."""

SEEN_OF_IT = 1.0
"""As much as that mesh itself shows, which is all that is taken away before parameters are fitted.

A stiffness that is too high looks like more of a mesh that locks. With 30 % too much of Lame's mu two motions ask for
1.36 of the finer mesh, with the right one for 1.13 and 1.17: beyond what that mesh shows either may be meant."""

_OFF = 0.05  # of the misfit: what parameters must explain by themselves, in windows left out, to be moved for good
_FOLD = 0.2  # of the misfit: what they must explain for each factor of e by which one of them moves
_FITS = 3  # times that they are fitted, at most
_SURE = 20.0  # squared estimate over squared error of these


@dataclass(frozen=True, eq=False)
class Base(Learned):
    """Learned from base measurements.

    Attributes:
        changed: by how much parameters were moved in all, relatively, by "effect.parameter".
        mistaken: gain of each explanation, by label, before any correction: how much mesh and solver look like it.
        gain: best gain of the library in windows corrected by all the others.
        probes: best gain of flexible forces there.
        median_mm: median distance there.
        why_not: why its clouds could not be registered again by parameters that were moved, where that failed.
        before: what the model was when they were measured, where effects were added to it since.
    """

    changed: dict[str, float]
    mistaken: Mapping[str, float]
    gain: float
    probes: float
    median_mm: float
    why_not: str = ""
    before: Earlier | None = None


@dataclass(frozen=True, eq=False)
class _Look:
    """All windows against one model, and the corrections (K,) that they ask for."""

    groups: tuple[Group, ...]
    columns: tuple[Column, ...]
    places: dict[str, list[int]]
    probed: list[Response]
    variance: np.ndarray
    known: Evidence
    ridge: float

    @property
    def weighing(self) -> Weighing:
        return Weighing(self.variance, self.known.weight)

    @property
    def change(self) -> np.ndarray:
        return ridged(*self.known.normal, self.ridge)


def checked_scenes(
    measurements: Sequence[Measurement],
    model: Model,
    garment: Garment | None = None,
    body: BodyModel | None = None,
    progress: Progress | None = None,
    crew: Crew | None = None,
) -> list[Scene]:
    """The scenes of measurements, their cloth checked; point clouds are registered with the model's help.

    Raises :class:`CaphyError` where a measurement does not fit the cloth.
    """
    scenes = [Scene.of(measurement, garment, body) for measurement in measurements]
    for scene in scenes:
        check_cloth(scene)
    return all_registered(scenes, model, progress, crew)


def base_of(
    model: Model,
    measurements: Sequence[Measurement],
    garment: Garment | None = None,
    body: BodyModel | None = None,
    progress: Progress | None = None,
    crew: Crew | None = None,
) -> Base | None:
    """Learned from base measurements; nothing without any. What was added to the model after them stays as it is."""
    if not measurements:
        return None
    scenes = checked_scenes(measurements, model, garment, body, progress, crew)
    study = Study(scenes, progress=progress, crew=crew)
    before = earlier(study, model)
    if before is None:
        return from_base(study, model)
    learned = from_base(study.registered_by(before.model), before.model)
    return replace(learned, model=before.with_later(learned.model, model), before=before)


def from_base(study: Study, model: Model) -> Base:
    """Learn what a model gets wrong where nothing is missing."""
    study, model, changed, free = _put_right(study, model)
    look = _looked(study, model, free, ALL_OF_IT)
    gain, probes = _gains_left(study, look, model)
    correction = {column.name: float(value) for column, value in zip(look.columns, look.change, strict=True)}
    mistaken = {s.group.label: s.gain for s in screened(look.known, look.groups, look.places, model)}
    motions = np.array([response.scene for response in look.probed])
    learned = model, look.columns, correction, look.variance, look.known, motions, look.ridge, study.mesh or 0.0
    return Base(*learned, changed, mistaken, gain, probes, median_mm(look.probed), study.why_not)


def _put_right(study: Study, model: Model) -> tuple[Study, Model, dict[str, float], list[Response]]:
    """A model whose parameters are not far off, by how much they were moved, relatively, and all windows against it.

    While a stiffness is wrong the mesh's error is told wrongly, and takes a part of it, and clouds are drawn towards
    cloth that has it: they are registered again, and fits go on until none is asked for.
    """
    changed: dict[str, float] = {}
    for _ in range(_FITS):
        free = _rolled_out(study, model)
        fitted = _fitted(study, _looked(study, model, free, SEEN_OF_IT), model)
        if fitted is None:
            return study, model, changed, free
        for column, by in zip(fitted.columns, fitted.change, strict=True):
            changed[column.name] = float((1 + changed.get(column.name, 0.0)) * (1 + by) - 1)
        model = fitted.model
        study = study.registered_by(model)
    return study, model, changed, _rolled_out(study, model)


def _rolled_out(study: Study, model: Model) -> list[Response]:
    """All windows against a model and the whole library; how much of the mesh's error is there is free in each."""
    columns, _ = columns_of(explanations(study, model, model))
    return study.respond(model, columns, "base measurements", Probes(model), {"start", "solver"}, free=True)


def _amount_of_mesh(free: Sequence[Response], variance: np.ndarray, most: float) -> float:
    """How much of what a finer mesh does otherwise is in all windows alike.

    Windows ask for more or less of it, as cloth of another mesh does. Left free, it may take a part of a stiffness that
    is missing with it.
    """
    weighing = Weighing.robust(free, variance)
    alone = [replace(response.with_mesh(0.0), columns=response.of_mesh[..., None]) for response in free]
    normal, right = weighing.of(alone).normal
    return float(np.clip(ridged(normal, right, 0.0)[0], 0.0, most))


def _looked(study: Study, model: Model, free: Sequence[Response], most_of_mesh: float) -> _Look:
    """A look at all windows, which tells the study how much of the mesh's error is in them."""
    groups = explanations(study, model, model)
    columns, places = columns_of(groups)
    own = picked(free, ())
    study.mesh = _amount_of_mesh(own, study.variance(own), most_of_mesh)
    probed = [response.with_mesh(study.mesh) for response in free]
    responses = picked(probed, range(len(columns)))
    variance = study.variance(responses)
    known = Weighing.robust(responses, variance).of(responses)
    ridge = min(RIDGES, key=lambda each: float(known.misfit(known.left_out(partial(ridged, ridge=each))).sum()))
    return _Look(groups, columns, places, probed, variance, known, ridge)


def _gains_left(study: Study, look: _Look, model: Model) -> tuple[float, float]:
    """The best gains of the library and of flexible forces in windows corrected by all the others."""
    count = len(look.columns)
    told = look.known.left_out(partial(ridged, ridge=look.ridge))
    apart = [_corrected(response, change) for response, change in zip(look.probed, told, strict=True)]
    held = look.weighing.of(picked(apart, range(count)))
    rest = range(count, look.probed[0].columns.shape[-1])
    flexible = Flexible.of(study, picked(apart, rest), look.weighing).gains
    scores = screened(held, look.groups, look.places, model)
    best = max([0.0, *(score.gain for score in scores if not score.group.own)])
    return best, max([0.0, *flexible.values()])


def _far_off(look: _Look, model: Model) -> list[Column]:
    """The model's own parameters that by themselves explain so much of the base that they must be moved for good.

    Stiffness does not act linearly, so that roll-outs must tell by how much; and nothing else may enter the model, or
    it could not be found to be missing any more.
    """
    scores = screened(look.known, look.groups, look.places, model)
    off = [s for s in scores if s.group.own and s.gain >= _OFF and s.wald >= _SURE]
    return [column for score in off for column in score.group.columns if column.entry is None]


def _fitted(study: Study, look: _Look, model: Model) -> Fit | None:
    """Parameters that are far off, put right by roll-outs.

    What goes farthest, for little of the misfit, is not told by the data. Lame's lambda at seven times its value beside
    a softer mu makes cloth as stiff along a thread and softer in shear, as a mesh that locks would ask for where
    nothing is wrong. It is left where it was; the others must do without it.
    """
    off = _far_off(look, model)
    while off:
        responses = picked(look.probed, [look.columns.index(column) for column in off])
        fitted = fit(study, model, off, responses, look.weighing, "parameters of the base")
        if not fitted.change.any():  # roll-outs did not agree
            return None
        far = np.abs(np.log1p(fitted.change))
        if fitted.share >= _FOLD * far.max():
            return fitted if fitted.share >= _OFF else None
        off = [column for column, by in zip(off, far, strict=True) if by < far.max()]
    return None


def _corrected(response: Response, change: np.ndarray) -> Response:
    return replace(response, residual=response.residual - response.columns[..., : len(change)] @ change)
