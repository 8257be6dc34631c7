"""Units of parameters, against the powers of kg, m and s that textbooks give."""

from __future__ import annotations

import pytest

from caphy.effects.units import dimensions
from caphy.errors import CaphyError


@pytest.mark.parametrize(
    ("unit", "powers"),
    [
        ("1", (0, 0, 0)),
        ("rad", (0, 0, 0)),
        ("N s/m^3", (1, -2, -1)),
        ("1/(m s)", (0, -1, -1)),
        ("N m/rad^2", (1, 2, -2)),
        ("kg/m^2", (1, -2, 0)),
        ("Pa", (1, -1, -2)),
    ],
)
def test_what_units_are_made_of(unit: str, powers: tuple[int, int, int]) -> None:
    assert dimensions(unit) == powers


@pytest.mark.parametrize("unit", ["m/s/s", "N*s", "", "m^-1", "relative, %"])
def test_units_written_otherwise_are_told_how(unit: str) -> None:
    with pytest.raises(CaphyError, match=r"a unit must be written like 'N s/m\^3'"):
        dimensions(unit)


@pytest.mark.parametrize("unit", ["K/m", "N/mm"])
def test_unknown_symbols_are_told(unit: str) -> None:
    with pytest.raises(CaphyError, match="a unit must be made of kg, m, s, N, J, Pa, rad, got"):
        dimensions(unit)
