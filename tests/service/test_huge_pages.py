"""Memory gathered in huge pages keeps its content, and what cannot be gathered is left alone."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from service import huge_pages


def test_memory_keeps_its_content():
    random = np.random.default_rng(0)
    many = [random.integers(0, 255, 9 << 20, dtype=np.uint8) for _ in range(3)]
    sums = [int(values.sum()) for values in many]
    huge_pages.onto_huge_pages()
    assert [int(values.sum()) for values in many] == sums


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="regions of memory are listed on Linux only")
def test_regions_are_whole_huge_pages_of_this_process():
    held = np.ones(16 << 20, dtype=np.uint8)
    regions = list(huge_pages._own_regions())
    address = held.ctypes.data
    assert all(start % huge_pages.HUGE == 0 and size % huge_pages.HUGE == 0 for start, size in regions)
    assert any(start < address + held.nbytes and address < start + size for start, size in regions)


def test_other_systems_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert huge_pages.onto_huge_pages() == 0
