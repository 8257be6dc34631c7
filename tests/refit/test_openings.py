"""Openings that windows do not tell are not fitted."""

from __future__ import annotations

import numpy as np

from caphy.refit.columns import addition
from caphy.refit.evidence import Evidence
from caphy.refit.openings import told

COLUMNS = (*addition("mass_damping"), *addition("heavy_hem"))
"""A rate, then four openings."""


def windows(truth: np.ndarray, size: np.ndarray, noise: float = 1.0) -> Evidence:
    """Of numbers (5,) whose responses are of a ``size`` (5,), in units of the noise of each of 200 entries."""
    random, forms = np.random.default_rng(1), []
    for _ in range(8):
        s = random.normal(0, 1, (200, 5)) * size
        e = s @ truth + random.normal(0, noise, 200)
        forms.append((s.T @ s, s.T @ e, e @ e))
    a, b, c = (np.stack(each) for each in zip(*forms, strict=True))
    return Evidence(a, b, c, np.ones(8), np.full(8, 200))


def test_what_hardly_moves_or_is_not_there_is_left_out():
    size = np.array([1.0, 1.0, 0.01, 0.0, 0.0])  # a hem that swings, a waist that hardly does, and no more openings
    known = windows(np.array([0.5, 0.5, 0.0, 0.0, 0.0]), size)
    assert told(COLUMNS, known, 0.02 * known.c.sum()) == [0, 1]


def test_two_openings_that_are_told_stay():
    known = windows(np.array([0.5, 0.5, 0.0, 0.5, 0.0]), np.array([1.0, 1.0, 1.0, 1.0, 0.0]))
    assert told(COLUMNS, known, 0.02 * known.c.sum()) == [0, 1, 3]


def test_one_opening_and_all_other_numbers_stay():
    """Whether they are needed is told by real roll-outs."""
    known = windows(np.zeros(5), np.ones(5))
    left = told(COLUMNS, known, 0.02 * known.c.sum())
    assert left[0] == 0 and len(left) == 2
