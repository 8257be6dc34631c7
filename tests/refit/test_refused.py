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
FITTED: Any = SimpleNamespace(share=0.1, columns=COLUMNS)
SURE, UNSURE = ({COLUMNS[0].name: told} for told in ((1.0, 0.5, 1.5, "1"), (0.0013, -0.0007, 0.0033, "1")))


def _held(before_mm: float, after_mm: float, share: float) -> HeldOut:
    return HeldOut(before_mm, after_mm, None, np.array([before_mm]), np.array([after_mm]), share, 0.01)


def test_what_lowers_both_is_kept():
    assert _refused(_held(5.0, 4.0, 0.09), FITTED, SURE, ("a",)) == ""
    assert (
        _refused(_held(9.7, 4.9, 0.184), SimpleNamespace(share=0.78, columns=COLUMNS), SURE, ("a",)) == ""
    )  # as diagnoses name it
    assert _refused(_held(5.0, 4.0, 0.09), FITTED, UNSURE, ()) == ""  # of its own parameters none need move


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
    assert why in _refused(held, FITTED, numbers, ("a",))
