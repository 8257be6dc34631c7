"""What holds from one motion to another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.effects.model import Model
from caphy.refit.across import Across, across
from caphy.refit.borrowed import Few
from caphy.refit.columns import addition, extended, moved
from caphy.refit.evidence import Weighing
from caphy.refit.fit import judged
from caphy.refit.heldout import HeldOut
from caphy.refit.responses import Response

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
COLUMNS = (*addition("mass_damping"), *addition("air_drag_normal"))
SHAPE, SIGMA = (4, 6, 3), 1e-3
VARIANCE = np.full(SHAPE[:2], SIGMA**2)
SEEN = np.ones(SHAPE[0], bool)


def windows(values: np.ndarray, wanted: np.ndarray, noise: float) -> list[Response]:
    """Of cloth that moves by its responses alone, five windows of each motion, which wants its own numbers (M, 2)."""
    random, made = np.random.default_rng(3), []
    for motion, truth in enumerate(wanted):
        for start in range(5):
            s = random.normal(0, SIGMA, (*SHAPE, 2))
            e = s @ (truth - values) + random.normal(0, noise, SHAPE)
            made.append(Response(motion, start, e, SEEN, s, np.full((*SHAPE, 1), 1e-12), np.ones((SHAPE[0], 1)), SEEN))
    return made


def fitted(wanted: np.ndarray, noise: float = SIGMA):
    """A fit to all motions, by plain least squares, and the windows before it."""
    first = windows(np.zeros(2), wanted, noise)
    s, e = (np.concatenate([getattr(r, name).reshape(72, -1) for r in first]) for name in ("columns", "residual"))
    values = np.linalg.lstsq(s, e[:, 0], rcond=None)[0]
    model, weighing = moved(extended(MODEL, COLUMNS), COLUMNS, values), Weighing(VARIANCE, np.ones(len(first)))
    told = weighing.of(first)
    return judged(MODEL, model, COLUMNS, windows(values, wanted, noise), weighing, None, told), first


@pytest.mark.parametrize("size", [0.3, 1.5])  # takes away little, and so much that roll-outs tell it
def test_leaving_a_motion_out_is_fitting_to_the_others(size):
    """Against least squares on the others' residuals, motion by motion."""
    wanted = size * np.array([[1.0, 0.3], [0.6, -0.1], [1.2, 0.1]])
    fit, first = fitted(wanted)
    found = across(fit)
    s, e = (np.stack([getattr(r, name).reshape(72, -1) for r in first]) for name in ("columns", "residual"))
    motion, falls = np.repeat(range(3), 5), np.zeros(15)
    for one in range(3):
        here = motion == one
        others = np.linalg.lstsq(s[~here].reshape(-1, 2), e[~here].reshape(-1), rcond=None)[0]
        falls[here] = (e[here, :, 0] ** 2).sum(1) - ((e[here, :, 0] - s[here] @ others) ** 2).sum(1)
    falls /= (e**2).sum()
    assert found is not None
    np.testing.assert_allclose(found.share, falls.sum(), rtol=1e-4)
    np.testing.assert_allclose(found.least, min(falls[motion == one].sum() for one in range(3)), rtol=1e-4)
    np.testing.assert_allclose(found.error, np.sqrt(15) * falls.std(ddof=1), rtol=0.05)


def test_what_each_motion_wants_otherwise_does_not_hold_across():
    """One motion asks for the opposite of the others: what it was given takes something away of it, the others' not."""
    fit, _ = fitted(np.array([[0.6, 0.0], [0.6, 0.0], [-0.5, 0.0]]))
    found = across(fit)
    assert found is not None
    assert found.least < 0 < fit.share


def test_one_motion_has_no_other():
    assert across(fitted(np.array([[1.0, 0.0]]))[0]) is None


@pytest.mark.parametrize(
    ("there", "share", "believed"),
    [
        (Across(0.10, 0.03, 0.02), 0.05, True),
        (Across(0.10, 0.03, 0.02), 0.03, False),  # a quarter of what is promised, where a third is asked for
        (Across(0.10, 0.06, 0.02), 0.05, False),  # not surely
        (Across(0.10, 0.03, -0.01), 0.05, False),  # not in each motion
        (None, 0.05, False),
    ],
)
def test_what_holds_across_motions_need_not_surely_hold_in_a_few_windows(there, share, believed):
    held = HeldOut(3.0, 2.95, 1.5, np.full(5, 3.0), np.array([2.9, 2.9, 2.9, 3.1, 3.1]), share, 0.08, None, there)
    assert held.proves(0.12) == believed
    assert not replace(held, after_mm=3.01).proves(0.12)


@pytest.mark.parametrize(
    ("after_mm", "fell", "there", "share", "believed"),
    [
        (5.04, 3, Across(0.12, 0.02, 0.02), 0.099, True),
        (5.04, 3, Across(0.12, 0.02, 0.02), 0.08, False),  # by 2.7 standard errors
        (5.04, 3, Across(0.12, 0.05, 0.02), 0.099, False),  # across motions by 2.4
        (5.04, 3, Across(0.12, 0.02, -0.01), 0.099, False),  # not in each motion
        (5.04, 3, None, 0.099, False),
        (5.04, 0, Across(0.12, 0.02, 0.02), 0.099, False),  # the median rises in each window
        (5.20, 3, Across(0.12, 0.02, 0.02), 0.099, False),  # by 4 %
    ],
)
def test_a_median_that_does_not_fall_is_outweighed_by_what_surely_falls_everywhere(
    after_mm, fell, there, share, believed
):
    before = np.array([6.16, 4.14, 3.92, 5.91, 5.65])
    after = np.where(np.arange(5) < fell, before - 0.1, before + 0.1)
    held = HeldOut(4.98, after_mm, 1.54, before, after, share, 0.03, None, there)
    assert held.proves(0.13) == believed
    few = Few(0.01, 0.1)
    assert not replace(held, few=few).proves(0.13)
