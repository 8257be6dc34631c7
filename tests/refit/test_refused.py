"""A refit is refused that does not lower what nothing was fitted to, or of whose numbers nothing is known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caphy.refit.columns import addition
from caphy.refit.heldout import HeldOut
from caphy.refit.refit import _refused

COLUMNS = addition("air_drag_normal")


def _windows(median_mm: float) -> Any:
    return [SimpleNamespace(error=np.full((8, 3), 1e-3 * median_mm))] * 5


BEFORE = _windows(3.0)
FITTED: Any = SimpleNamespace(share=0.1, columns=COLUMNS, responses=_windows(2.9))
SURE, UNSURE = ({COLUMNS[0].name: told} for told in ((1.0, 0.5, 1.5, "1"), (0.0013, -0.0007, 0.0033, "1")))


def _held(before_mm: float, after_mm: float, share: float) -> HeldOut:
    return HeldOut(before_mm, after_mm, None, np.array([before_mm]), np.array([after_mm]), share, 0.01)


def test_what_lowers_both_is_kept():
    assert _refused(_held(5.0, 4.0, 0.09), BEFORE, FITTED, SURE, ("a",)) == ""
    large = SimpleNamespace(share=0.78, columns=COLUMNS, responses=_windows(2.9))
    assert _refused(_held(9.7, 4.9, 0.184), BEFORE, large, SURE, ("a",)) == ""  # as diagnoses name it
    assert _refused(_held(5.0, 4.0, 0.09), BEFORE, FITTED, UNSURE, ()) == ""  # of its own parameters none need move


@pytest.mark.parametrize(
    ("held", "numbers", "why"),
    [
        (_held(7.56, 7.95, 0.05), SURE, "the median distance must fall, but it goes from 7.56 to 7.95 mm"),
        (_held(5.0, 4.9, 0.015), SURE, "a third of what it falls by"),
        (_held(5.0, 4.0, 0.005), SURE, "the misfit must fall by 1 %, but falls by 0.5 %"),
        (_held(5.0, 5.1, 0.09), UNSURE, "different from zero; on held-out measurements the median distance must fall"),
        (_held(5.0, 4.0, 0.09), UNSURE, "none of its numbers is surely different from zero"),
    ],
)
def test_what_does_not_is_refused(held, numbers, why):
    assert why in _refused(held, BEFORE, FITTED, numbers, ("a",))


@pytest.mark.parametrize(("after_mm", "believed"), [(2.99, True), (3.02, True), (3.07, False)])
def test_what_takes_cloth_away_from_where_it_was_seen_is_refused(after_mm, believed):
    fitted = SimpleNamespace(share=0.1, columns=COLUMNS, responses=_windows(after_mm))
    why = _refused(_held(5.0, 4.0, 0.09), BEFORE, fitted, SURE, ("a",))
    assert why == ("" if believed else "where it was fitted the median distance rises from 3.00 to 3.07 mm")
