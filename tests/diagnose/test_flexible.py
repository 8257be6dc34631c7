"""Forces that swing at a place of the cloth, told however late in a film a window lies."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from caphy.challenge.sheets import users_square
from caphy.diagnose.flexible import Flexible
from caphy.diagnose.probes import ORDER, STEADY, TO_AND_FRO, WIDTHS, probe_places, probe_pushes, vertex_normals
from caphy.effects.base import Step
from caphy.effects.cloth import Cloth
from caphy.refit.evidence import Weighing
from caphy.refit.modes import laplacian_modes
from caphy.refit.responses import Response
from caphy.refit.study import Study

FPS, LENGTH, MODES, BEAT = 30.0, 8, 40, 2.4
STUDY = cast(
    Study, SimpleNamespace(watched=[SimpleNamespace(scene=SimpleNamespace(measurement=SimpleNamespace(fps=FPS)))])
)


def window(start: int) -> tuple[Response, np.ndarray]:
    """Modes that each field moves by what it is at the time, and that something swinging has moved; and their noise."""
    random = np.random.default_rng(start)
    places, time = probe_places(), (start + np.arange(1, LENGTH + 1)) / FPS
    columns = np.zeros((LENGTH, MODES, 3, sum(WIDTHS.values())))
    way = np.random.default_rng(0).normal(size=(MODES, 3, WIDTHS[STEADY]))
    for power in range(ORDER + 1):
        index = places[STEADY] if power == 0 else places[TO_AND_FRO][(power - 1) * WIDTHS[STEADY] :][: WIDTHS[STEADY]]
        columns[..., index] = time[:, None, None, None] ** power * way
    swing = np.sin(2 * np.pi * BEAT * time)[:, None, None] * way[..., 4]
    noise = 0.5 * random.normal(size=swing.shape)
    nothing = np.zeros((LENGTH, MODES, 3, 0))
    yes = np.ones(LENGTH, bool)
    response = Response(0, start, swing + noise, yes, columns, nothing, np.zeros((LENGTH, 1)), yes)
    return response, noise


@pytest.mark.parametrize("first", [0, 3600, 36000])
def test_a_swing_is_told_as_well_minutes_later(first):
    windows, noises = zip(*(window(first + LENGTH * k + (k > 5)) for k in range(12)), strict=True)
    found = Flexible.of(STUDY, windows, Weighing(np.full((LENGTH, MODES), 0.25), np.ones(12)))
    assert found.told[TO_AND_FRO].beat == pytest.approx(BEAT)
    share = 1 - np.square(noises).sum() / sum(np.square(each.residual).sum() for each in windows)
    assert found.gains[TO_AND_FRO] == pytest.approx(share, abs=0.02)
    assert found.gains[STEADY] < 0.5 * share


def test_cloth_of_few_vertices_has_all_fields():
    """Of nine there are seven modes; what later fields are is told by their places."""
    cloth = Cloth.of(users_square(3), 0.2)
    modes = laplacian_modes(cloth)
    assert modes.shape[1] < 9
    x = torch.from_numpy(np.asarray(cloth.vertices))
    step = Step.implicit_euler(1 / FPS, x, x, 0.5)
    pushes, places = probe_pushes(cloth, modes, x, step, None), probe_places()
    assert len(pushes) == sum(WIDTHS.values())
    area = torch.from_numpy(cloth.vertex_area)[:, None]
    normals = -area * torch.from_numpy(modes[:, :1]) * vertex_normals(cloth, step.lagged)
    torch.testing.assert_close(pushes[places["direction of the cloth's normal"][0]], normals)
