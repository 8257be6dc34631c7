"""Weights on huge pages: a frame alone reads 10 MB of them, more than a core's table of small pages covers."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator

HUGE = 2 << 20
"""Size of a huge page [bytes]."""
_COLLAPSE = 25  # MADV_COLLAPSE, Linux 6.1 and later; works whatever the system's setting for its own accord is


def onto_huge_pages() -> int:
    """Gather this process's own memory in huge pages, where whole ones fit; how many bytes lie in regions that took it.

    Nothing moves to another address, and nothing happens where the system cannot do it (0 then).
    """
    if not sys.platform.startswith("linux"):
        return 0
    try:
        regions = list(_own_regions())
        advise = ctypes.CDLL(None).madvise
    except (OSError, AttributeError):
        return 0
    advise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    return sum(size for start, size in regions if advise(start, size, _COLLAPSE) == 0)


def return_freed() -> None:
    """Give memory that was freed back to the system, which the allocator of glibc keeps; others keep less or none."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):
        return


def _own_regions() -> Iterator[tuple[int, int]]:
    """Address and size of the whole huge pages in writable memory that no file stands behind."""
    with open("/proc/self/maps", encoding="ascii", errors="replace") as maps:
        for line in maps:
            span, rights, _, _, inode, *name = line.split()
            if inode != "0" or not rights.startswith("rw") or (name and name[0] != "[heap]"):
                continue
            first, last = (int(address, 16) for address in span.split("-"))
            start, end = -(-first // HUGE) * HUGE, last // HUGE * HUGE
            if end > start:
                yield start, end - start
