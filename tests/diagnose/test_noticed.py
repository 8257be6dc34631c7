"""How much of an effect would have been noticed, where what it does does not grow evenly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from caphy.diagnose.groups import Group
from caphy.diagnose.noticed import by_roll_outs, by_tangents
from caphy.diagnose.screen import Score, covariance
from caphy.effects.model import Model
from caphy.errors import Diverged
from caphy.refit.columns import addition
from caphy.refit.evidence import evidence
from caphy.refit.responses import Response

LAGS, MODES, WINDOWS = 6, 4, 7
VARIANCE = np.full((LAGS, MODES), 1e-6)
COLUMNS = addition("mass_damping")
SCORE = Score(Group("mass_damping", COLUMNS), 0.0, 0.0, np.zeros(1))
MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


def responses() -> list[Response]:
    random = np.random.default_rng(3)
    shape = (LAGS, MODES, 3)
    return [
        Response(
            0,
            number,
            random.normal(0, 2e-3, shape),
            np.ones(LAGS, bool),
            random.normal(0, 1e-3 * (1 + number), (*shape, 2)),
            random.normal(0, 1e-3, (*shape, 3)),
            np.zeros(LAGS),
            np.ones(LAGS, bool),
        )
        for number in range(WINDOWS)
    ]


class Windows:
    """Windows in which an effect of size s does what tangents say of a size ``does(s)``; their mesh's error was last
    told of a model that has a size ``tried`` of it."""

    def __init__(self, does: Callable[[float], float], tried: float = 0.0) -> None:
        self.does, self.all, self.rolled, self.mesh = does, responses(), [], tried

    def some(self, windows) -> Windows:
        self.windows = sorted(windows)
        return self

    def respond(self, model: Model, columns, what: str, anew=()) -> list[Response]:
        size, few = COLUMNS[0].value(model), [self.all[number] for number in self.windows]
        if "solver" in anew:
            self.mesh = size
        if not columns:
            self.rolled.append(size)
        by = self.does(size) + 0.5 * self.mesh
        place = [1] * len(columns)
        return [replace(r, residual=r.residual - by * r.columns[..., 1], columns=r.columns[..., place]) for r in few]


def screen(needed: float = 0.1):
    known = evidence(responses(), VARIANCE)
    return SimpleNamespace(
        model=MODEL,
        responses=responses(),
        variance=VARIANCE,
        evidence=known,
        misfit=float(known.c.sum()),
        places={"mass_damping": [1]},
        needed_by=lambda score: needed,
    )


NAME = COLUMNS[0].name
WALD = 16.0
LEAST = by_tangents(screen(), SCORE, WALD)[NAME]


def test_what_tangents_tell_is_noticed_wherever_noise_shifts_it():
    """It gains what is needed and is sure enough even where noise takes 1.645 errors from it."""
    known, found = screen().evidence, screen(0.01)
    size = by_tangents(found, SCORE, WALD)[NAME]
    normal, right = known.picked([1]).normal
    error = float(np.sqrt(covariance(known.picked([1]), right / normal[0, 0])[0, 0]))
    assert size == pytest.approx(max(np.sqrt(0.01 * known.c.sum() / normal[0, 0]), 4 * error) + 1.645 * error)
    assert by_tangents(screen(4.0), SCORE, WALD)[NAME] > 1.5 * LEAST > 1.5 * size


def test_what_grows_evenly_is_noticed_as_tangents_say():
    windows = Windows(lambda size: size)
    assert by_roll_outs(windows, screen(), SCORE, WALD) == {NAME: pytest.approx(LEAST)}
    assert len(windows.rolled) == 1
    assert windows.windows == [2, 3, 4, 5, 6]  # those in which it does most


def test_what_the_mesh_did_to_another_model_does_not_count():
    assert by_roll_outs(Windows(lambda size: size, tried=-LEAST), screen(), SCORE, WALD) == {NAME: pytest.approx(LEAST)}


def test_what_grows_less_and_less_needs_more():
    windows = Windows(lambda size: size / (1 + size / (3 * LEAST)))
    found = by_roll_outs(windows, screen(), SCORE, WALD)[NAME]
    assert found is not None
    assert 0.9 * LEAST <= windows.does(found) < 1.2 * LEAST


def test_what_grows_slowly_is_looked_for_up_to_the_largest_size():
    windows = Windows(lambda size: 0.5 * LEAST * (size / LEAST) ** 0.4)
    assert by_roll_outs(windows, screen(), SCORE, WALD) == {NAME: pytest.approx((0.9 / 0.5) ** 2.5 * LEAST, rel=1e-3)}
    assert len(windows.rolled) <= 4


def test_what_stops_growing_is_noticed_at_no_size():
    windows = Windows(lambda size: LEAST * np.tanh(size / LEAST) / 1.5)
    assert by_roll_outs(windows, screen(), SCORE, WALD) == {NAME: None}
    assert max(windows.rolled) <= 10 * LEAST


def test_nor_is_what_it_may_not_have_or_what_tears_the_cloth():
    def torn(size: float) -> float:
        if size > 0:
            raise Diverged("cloth flies apart")
        return 0.0

    assert by_roll_outs(Windows(torn), screen(), SCORE, WALD) == {NAME: None}
    most = COLUMNS[0].declared.upper
    needed = 0.1 * (2 * most / LEAST) ** 2  # so much that twice the most would be needed
    windows = Windows(lambda size: size)
    assert by_roll_outs(windows, screen(needed), SCORE, WALD) == {NAME: None}
    assert not windows.rolled
