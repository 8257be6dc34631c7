"""A small capture session, made once per run of the tests: six coarse scans of clothes that follow the skeleton."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from caphy.capture.optics import Optics
from caphy.capture.session import Plan, capture

PLAN = Plan(
    seed=5,
    count=6,
    upper="tshirt",
    lower="shorts",
    body="medium",
    edge_length=0.04,
    simulate=False,
    optics=Optics(voxel=0.012, pixels=(160, 200), dropouts=3),
)


@cache
def small_session() -> Path:
    """Folder of the session, removed when the tests end; copy what you change."""
    folder = Path(tempfile.mkdtemp(prefix="caphy-session-"))
    atexit.register(shutil.rmtree, folder, True)
    capture(PLAN, folder)
    return folder
