"""What can be seen of surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.report.sight import directions


def test_directions_look_from_everywhere_but_below():
    looks = directions()
    assert np.linalg.norm(looks, axis=1) == pytest.approx(1)
    assert looks[:, 1].min() > -0.65 and looks[:, 1].max() > 0.95
    assert np.abs(looks[:, [0, 2]].mean(axis=0)).max() < 0.05
