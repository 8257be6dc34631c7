"""Work on several things at once in one process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Made = TypeVar("Made")


def in_threads(work: Callable[[int], Made], count: int) -> list[Made]:
    """What ``work`` makes of 0 .. count - 1, in as many threads as torch uses; it must let go of the GIL to gain."""
    if torch.get_num_threads() == 1:
        return [work(i) for i in range(count)]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return list(pool.map(work, range(count)))
