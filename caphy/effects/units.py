"""The units of parameters: what they are made of, and which are understood."""

from __future__ import annotations

import re

from caphy.errors import CaphyError

UNITS = {
    "kg": (1, 0, 0), "m": (0, 1, 0), "s": (0, 0, 1), "N": (1, 1, -2), "J": (1, 2, -2), "Pa": (1, -1, -2),
    "rad": (0, 0, 0),
}  # fmt: skip
"""Powers of (kg, m, s) by symbol."""

_PRODUCT = re.compile(r"1|[A-Za-z]+(?:\^\d+)?(?: [A-Za-z]+(?:\^\d+)?)*")


def dimensions(unit: str) -> tuple[int, int, int]:
    """Powers of (kg, m, s) of a unit such as ``N s/m^3``; ``1`` and ``rad`` have none.

    Raises:
        CaphyError: it is written otherwise, or holds a symbol that is not in :data:`UNITS`.
    """
    above, _, below = unit.partition("/")
    if below.startswith("(") and below.endswith(")"):
        below = below[1:-1]
    parts = (above, below) if "/" in unit else (above,)
    if not all(_PRODUCT.fullmatch(part) for part in parts):
        raise CaphyError(f"a unit must be written like 'N s/m^3', '1/(m s)' or '1', got {unit!r}")
    total = [0, 0, 0]
    for sign, part in zip((1, -1), parts, strict=False):
        for symbol, power in re.findall(r"([A-Za-z]+)(?:\^(\d+))?", part):
            if symbol not in UNITS:
                raise CaphyError(f"a unit must be made of {', '.join(UNITS)}, got {symbol!r} in {unit!r}")
            total = [sum_ + sign * int(power or 1) * one for sum_, one in zip(total, UNITS[symbol], strict=True)]
    kilogram, metre, second = total
    return kilogram, metre, second
