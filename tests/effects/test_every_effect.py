"""The battery over every registered effect."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from caphy.effects.battery import CHECKS
from caphy.effects.registry import registered_effects

EXCEPTIONS = {
    ("gravity", "same_in_every_frame"): "the world has an up",
    ("bending_measured", "units_fit"): "its table is measured at fixed curvatures in 1/m",
}
"""Properties that an effect lacks for a reason; if it has one after all, the test fails."""


def cases() -> list:
    return [
        pytest.param(
            name,
            check,
            id=f"{name}-{check.__name__}",
            marks=[pytest.mark.xfail(reason=EXCEPTIONS[name, check.__name__], raises=AssertionError, strict=True)]
            if (name, check.__name__) in EXCEPTIONS
            else [],
        )
        for name in registered_effects()
        for check in CHECKS
    ]


@pytest.mark.parametrize(("name", "check"), cases())
def test_effect(name: str, check: Callable[[str], None]) -> None:
    check(name)
