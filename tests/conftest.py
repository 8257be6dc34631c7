"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real mocap, fabrics and garments; it lies beside the checkout or where CAPHY_DATA points."""
    folder = Path(os.environ.get("CAPHY_DATA", Path(__file__).parents[1].parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found in {folder}; set CAPHY_DATA to its folder")
    return folder
