"""Which law a wind follows, told on cloth that an independent explicit integrator moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from explicit_cloth import measured, simulate, square
from scipy.stats import wilcoxon

from caphy.diagnose import laws as settling
from caphy.diagnose.diagnosis import diagnose
from caphy.diagnose.groups import Group
from caphy.diagnose.search import Term
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.refit import laws
from caphy.refit.columns import Column, addition
from caphy.refit.evidence import Evidence, Weighing
from caphy.refit.fit import Fit
from caphy.refit.laws import signed_ranks
from caphy.refit.refit import refit

DENSITY = 0.2
MODEL = Model(DENSITY, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
WIND, COEFFICIENT = np.array([1.2, 0.0, -0.8]), 0.5


def blown(power: int) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """The acceleration (V, 3) [m/s^2] by drag against a wind across the cloth, with a power of the speed."""
    rest, faces, _ = square()
    a, b, c = rest[faces].transpose(1, 0, 2)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    mass = np.bincount(faces.ravel(), np.repeat(area * DENSITY / 3, 3), len(rest))

    def push(x: np.ndarray, v: np.ndarray, now: float) -> np.ndarray:
        a, b, c = x[faces].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        speed = ((v[faces].mean(axis=1) - WIND) * normal).sum(axis=1, keepdims=True)
        force = np.zeros_like(x)
        for corner in faces.T:
            np.add.at(force, corner, -COEFFICIENT * area[:, None] / 3 * np.abs(speed) ** (power - 1) * speed * normal)
        return force / mass[:, None]

    return push


@pytest.fixture(scope="module")
def films() -> list[Measurement]:
    return [measured(*simulate(1.6, tempo=tempo, settle=2.0, push=blown(2)), seed=2) for tempo in (1.15, 1.3)]


def test_a_wind_is_named_by_its_law(films):
    """The quadratic one; a linear one is, below, beside a gust. The integrator's dashpots of 0.03 N s/m, two along each
    edge, may be seen as well: they are a viscosity of 0.06 along threads and, by the diagonals, 0.03 more."""
    found = diagnose(MODEL, films)
    assert found.found[0] == "wind_normal_quadratic" and set(found.found[1:]) <= {"viscous_damping"}
    coefficient = found.coefficients["wind_normal_quadratic.coefficient"]
    assert abs(coefficient.value / COEFFICIENT - 1) < 0.15
    assert coefficient.low < COEFFICIENT < coefficient.high
    if "viscous_damping" in found.found:
        viscosity = found.coefficients["viscous_damping.viscosity"]
        assert viscosity.low < 0.09 < viscosity.high


def test_a_law_that_is_not_linear_is_fitted_from_the_linear_one(films):
    found = refit(MODEL, films, ("wind_normal_quadratic",))
    assert found.kept == ("wind_normal_quadratic",)
    assert "wind_normal" not in found.model.effects
    values = found.model.effects["wind_normal_quadratic"]
    np.testing.assert_allclose(np.asarray(values["velocity"])[[0, 2]], WIND[[0, 2]], atol=0.15)
    names = ["coefficient", *(f"velocity[{i}]" for i in range(3))]
    told = np.array([found.coefficients[f"wind_normal_quadratic.{name}"][1:3] for name in names])
    assert (told[:, 0] < [COEFFICIENT, *WIND]).all() and (told[:, 1] > [COEFFICIENT, *WIND]).all()


def gusty(swings: float, x: np.ndarray, v: np.ndarray, now: float) -> np.ndarray:
    """The acceleration (V, 3) [m/s^2] by a pressure across the cloth that swings so many times a second."""
    _, faces, _ = square()
    a, b, c = x[faces].transpose(1, 0, 2)
    area = 0.5 * np.cross(b - a, c - a)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    force = (area * [0.5, 0.0, 0.3]).sum(axis=1, keepdims=True) * np.sin(2 * np.pi * swings * now) * area / size
    mass, total = np.zeros(len(x)), np.zeros_like(x)
    for corner in faces.T:
        np.add.at(mass, corner, DENSITY * size[:, 0] / 3)
        np.add.at(total, corner, force / 3)
    return total / mass[:, None]


def test_a_gust_far_from_one_swing_a_second_is_found_beside_a_wind():
    wind = blown(1)
    both = lambda x, v, now: wind(x, v, now) + gusty(2.7, x, v, now)  # noqa: E731
    films = [measured(*simulate(1.7, tempo=1.15, settle=2.0, push=both), seed=3)]
    found = diagnose(MODEL, films)
    assert found.found == ("wind_normal", "gust")
    truth = {"wind_normal.coefficient": COEFFICIENT, "gust.frequency": 2.7, "gust.sine[0]": 0.5, "gust.sine[2]": 0.3}
    for name, value in truth.items():
        told = found.coefficients[name]
        assert told.low < value < told.high, name
    assert found.coefficients["gust.frequency"].value == pytest.approx(2.7, rel=0.025)


def test_a_gust_that_is_added_gets_its_frequency():
    """By the refit of an effect that is asked for by name, without a wind beside it."""
    films = [measured(*simulate(1.7, tempo=1.15, settle=2.0, push=partial(gusty, 2.8)), seed=3)]
    added = refit(MODEL, films, ("gust",))
    assert float(added.model.effects["gust"]["frequency"]) == pytest.approx(2.8, rel=0.025)
    assert added.coefficients["gust.sine[0]"][0] == pytest.approx(0.5, rel=0.15)


def test_two_laws_of_one_effect_are_refused(films):
    with pytest.raises(CaphyError, match="another law of wind_normal"):
        refit(MODEL, films[:1], ("wind_normal", "wind_normal_quadratic"))
    with pytest.raises(CaphyError, match="another law of wind_normal"):
        refit(MODEL.with_effect("wind_normal"), films[:1], ("wind_normal_quadratic",))


def test_every_law_of_an_effect_is_tried_from_the_linear_fit(monkeypatch):
    """A law of one's own beside one that comes along: neither hides the other."""
    effects = {name: SimpleNamespace(refines="wind_normal") for name in ("wind_normal_quadratic", "zephyr")}
    monkeypatch.setattr(laws, "registered_effects", lambda: {"pressure": SimpleNamespace(refines=None), **effects})
    assert laws.laws_of("wind_normal") == ["wind_normal_quadratic", "zephyr"] and laws.laws_of("pressure") == []
    term = Term(Group("wind_normal", addition("wind_normal")), None, {})
    linear = SimpleNamespace(name="linear")
    screens = [SimpleNamespace(variance=None, evidence=SimpleNamespace(weight=None))]
    found, tried = SimpleNamespace(terms=[term], fit=linear, screens=screens), []

    def settled(study, found, term, group, after, apart):
        found.fit = after  # as where it is better
        return replace(term, group=group)

    def in_another_law(study, best, law):
        assert study == "aside"
        tried.append((best, law))
        return SimpleNamespace(model=law)

    monkeypatch.setattr(settling, "in_another_law", in_another_law)
    monkeypatch.setattr(settling, "addition", lambda law: ())
    monkeypatch.setattr(settling, "_settled", settled)
    said = []
    settling.settle_laws(SimpleNamespace(likewise=lambda: "aside", tell=lambda model, _: said.append(model)), found)
    assert said == ["zephyr"]  # what mesh and steps do is told of what stays
    assert tried == [(linear, "wind_normal_quadratic"), (linear, "zephyr")]
    assert found.terms[0].group.name == "zephyr"


def test_signed_ranks_are_those_of_another_package():
    random = np.random.default_rng(0)
    for shift in (-0.5, 0.0, 1.0):
        differences = random.normal(shift, 1.0, 25)
        other = wilcoxon(differences, method="approx", alternative="greater")
        assert signed_ranks(differences) == pytest.approx(other.zstatistic)


def test_what_the_base_doubts_of_one_law_is_not_forgotten_with_the_next(monkeypatch):
    """A quadratic wind is told, then the frequency of a gust beside it."""
    push = Column("wind_normal_quadratic", "coefficient")
    told = {push: {Column("wind_normal", "coefficient"): 0.3}}
    columns = (*addition("wind_normal_quadratic"), *addition("gust"))
    best = SimpleNamespace(columns=columns, model=MODEL, origin=MODEL, most=None, by_retelling={}, follow=told)
    best.weighing = weighing = Weighing(np.ones((1, 1)), np.ones(1))
    study = SimpleNamespace(respond=lambda *_, **__: [])
    known = Evidence(np.ones((1, 1, 1)), np.ones((1, 1)), np.ones(1), np.ones(1), np.ones(1))
    fitted = Fit(MODEL, MODEL, columns, known, [], known, 1.0, np.ones(1), weighing)
    monkeypatch.setattr(laws, "judged", lambda *_, **__: fitted)
    monkeypatch.setattr(laws, "refined", lambda *_, **__: fitted)
    monkeypatch.setattr(Weighing, "of", lambda *_: known)
    assert laws.told_further(study, best, "gust").follow == told
