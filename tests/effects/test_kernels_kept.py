"""Kernels give the same bits in the process that compiles them and in those that find them in numba's cache."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
from hashlib import sha1
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import irregular_cloth, moment

cloth = irregular_cloth()
at = moment(cloth)
_, gradient = Potential(Model(cloth.density, {"strain_measured": {}}), cloth).gradient(at.x, at.step, at.body)
print(sha1(gradient.numpy().tobytes()).hexdigest())
"""


def test_a_process_that_compiles_says_what_a_later_one_does(tmp_path: Path) -> None:
    """Else what is resumed, or run a second time, ends elsewhere: a fit to fabrics did, by 0.03 mm and a scan."""
    command, there = [sys.executable, "-c", SCRIPT], {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    cold, warm = (subprocess.run(command, env=there, capture_output=True, text=True, check=True) for _ in range(2))
    assert any(tmp_path.rglob("*.nbc"))
    assert len(cold.stdout) == 41 and cold.stdout == warm.stdout
