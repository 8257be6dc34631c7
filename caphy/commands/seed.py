"""Seeds that commands are given."""

from __future__ import annotations

from caphy.errors import CaphyError


def require_seed(seed: int) -> None:
    """Raise CaphyError unless a seed is one that every generator takes."""
    if not 0 <= seed < 1 << 63:
        raise CaphyError(f"--seed must be from 0 to 2^63 - 1, got {seed}")
