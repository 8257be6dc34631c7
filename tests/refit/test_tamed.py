"""A window whose tangents explode does not outweigh the others, nor does one that a number alone moves count less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.refit.evidence import Evidence, ridged, tamed

COUNT = 15


def windows(slopes: np.ndarray, estimate: float = 10.0) -> Evidence:
    """Windows (W,) that move by ``slopes`` with a number and ask for ``estimate`` of it."""
    a = slopes**2
    return Evidence(a[:, None, None], (a * estimate)[:, None], 1e3 + 0 * a, np.ones(len(a)), np.full(len(a), 900))


def test_an_exploded_window_does_not_decide():
    first = windows(np.linspace(0.4, 0.6, COUNT))
    here = windows(0.7 * np.linspace(0.4, 0.6, COUNT))
    one = np.arange(COUNT) == 4
    here = replace(here, a=np.where(one[:, None, None], 140.0, here.a), b=np.where(one[:, None], 140.0, here.b))
    assert ridged(*here.normal, 0.0)[0] == pytest.approx(1.15, abs=0.1)  # it decides
    kept = tamed(here, first)
    assert ridged(*kept.normal, 0.0)[0] > 7.0  # most of the 10 that the others ask for
    assert kept.a[4] == pytest.approx(4 * 0.49 * max(first.a[4, 0, 0], first.a.mean()))
    assert kept.b[4] / kept.a[4, 0] == pytest.approx(1.0)  # what it asks for is its own
    np.testing.assert_array_equal(np.delete(kept.a, 4, 0), np.delete(here.a, 4, 0))
    np.testing.assert_array_equal(kept.c, here.c)
    np.testing.assert_array_equal(kept.weight, here.weight)


@pytest.mark.parametrize("growth", [0.1, 1.0, 30.0])
def test_windows_that_all_grow_are_left_alone(growth):
    """A stiffness of a tenth moves the cloth much more, in all windows."""
    slopes = np.linspace(0.2, 1.0, COUNT)
    here = windows(np.sqrt(growth) * slopes)
    np.testing.assert_array_equal(tamed(here, windows(slopes)).a, here.a)


def test_the_few_windows_that_a_number_moves_are_left_alone():
    """Friction is where cloth meets a body, and may come to be where it did not."""
    slopes = np.zeros(COUNT)
    slopes[[2, 9]] = 1.0, 0.8
    later = slopes.copy()
    later[5] = 0.6
    np.testing.assert_array_equal(tamed(windows(later), windows(slopes)).a, windows(later).a)


def test_nothing_known_and_nothing_fitted():
    none = windows(np.zeros(COUNT))
    here = windows(np.ones(COUNT))
    np.testing.assert_array_equal(tamed(here, none).a, here.a)  # a law without strength
    empty = replace(none, a=np.zeros((COUNT, 0, 0)), b=np.zeros((COUNT, 0)))
    assert tamed(empty, empty).a.shape == (COUNT, 0, 0)
