"""The battery over every registered effect."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from caphy.effects.battery import CHECKS
from caphy.effects.registry import registered_effects


def cases() -> list:
    """What an effect says it lacks it must lack; if it has it after all, the test fails."""
    return [
        pytest.param(
            name,
            check,
            id=f"{name}-{check.__name__}",
            marks=[pytest.mark.xfail(reason=effect.lacks[check.__name__], raises=AssertionError, strict=True)]
            if check.__name__ in effect.lacks
            else [],
        )
        for name, effect in registered_effects().items()
        for check in CHECKS
    ]


@pytest.mark.parametrize(("name", "check"), cases())
def test_effect(name: str, check: Callable[[str], None]) -> None:
    check(name)
