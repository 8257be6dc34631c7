"""Making measurements with something hidden in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caphy.challenge.hidden import HIDDEN
from caphy.challenge.recording import record
from caphy.challenge.square import square
from caphy.challenge.world import _films, make
from caphy.commands.unfinished import unfinished
from caphy.errors import CaphyError


def test_motions_simulated_side_by_side_are_the_same_ones() -> None:
    drag = replace(HIDDEN["air_drag_normal"].drawn(np.random.default_rng(3)), same_mesh=True)  # the coarser one
    stage = square(3, 3, drag.same_mesh)
    two = replace(stage, plays=stage.plays[:2])
    alone, together = (list(_films(two, drag, 3, 3, None, count)) for count in (1, 2))
    np.testing.assert_array_equal(alone, together)
    assert not np.array_equal(*alone)


def test_what_has_a_place_in_space_is_not_hidden_from_people_who_walk_away_from_it() -> None:
    with pytest.raises(CaphyError, match="attraction does nothing in the scene skirt; it acts in square"):
        make("skirt", HIDDEN["attraction"], 3, frames=3)


def test_a_film_is_not_taken_from_the_cache_for_another_mesh(tmp_path, monkeypatch) -> None:
    """Remeshing follows a processor's rounding: another machine's garment of the same name has other vertices."""
    stage = square(3, 3, False)
    moved = stage.truth.vertices.copy()
    moved[0, 0] += 1e-9
    other = replace(stage, truth=replace(stage.truth, vertices=moved))
    simulated = []

    def simulate(stage, play, hidden, frames):
        simulated.append(stage)
        return np.zeros((frames, 1, 3))

    monkeypatch.setattr("caphy.challenge.recording._simulated", simulate)
    for each in (stage, stage, other, other):
        record(each, each.plays[0], HIDDEN["nothing"], 3, 3, tmp_path)
    assert simulated == [stage, other]


def test_films_of_a_challenge_that_was_stopped_wait_and_go_when_it_is_made(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("caphy.challenge.recording._simulated", lambda stage, play, hidden, frames: np.zeros((1, 1, 3)))
    stage, folder = square(3, 3, False), tmp_path / "unfinished"

    def filmed(folder: Path) -> None:
        for play in stage.plays:
            record(stage, play, HIDDEN["nothing"], 3, 3, folder)

    with pytest.raises(KeyboardInterrupt), unfinished(folder) as films:
        filmed(films)
        raise KeyboardInterrupt
    assert len(list(folder.iterdir())) == len(stage.plays)
    with unfinished(folder) as films:
        filmed(films)
    assert not folder.exists()
