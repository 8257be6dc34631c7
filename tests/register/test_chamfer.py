"""Where scans show cloth, against cloth whose rim is known."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.scan.scan import UPPER

RADIUS, RIM = 0.16, 0.25
"""Of a tube of cloth that stands upright: radius and height of its ends above and below the middle [m]."""


def tube(edge: float, noise: float) -> Target:
    """The tube, scanned with a mesh of edges ``edge`` and isotropic noise [m]."""
    rng = np.random.default_rng(0)
    row, count = np.arange(-RIM, RIM + 1e-9, edge * np.sqrt(3) / 2), int(2 * np.pi * RADIUS / edge)
    angle = ((np.arange(count) + 0.5 * (np.arange(len(row))[:, None] % 2)) * 2 * np.pi / count).ravel()
    normals = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    points = RADIUS * normals + np.repeat(row, count)[:, None] * [0, 1, 0]
    points = points + noise * rng.standard_normal(points.shape)
    cloud = Cloud("tube", points, normals, np.full(len(points), UPPER))
    return Target(cloud, points, normals, "upper", None)  # pyright: ignore[reportArgumentType]  # no body is asked for


def sheet(off: float, low: float, high: float) -> np.ndarray:
    """Points (3000, 3) ``off`` [m] the tube, between two heights."""
    rng = np.random.default_rng(1)
    angle, y = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(low, high, 3000)
    return np.stack([(RADIUS + off) * np.cos(angle), y, (RADIUS + off) * np.sin(angle)], axis=1)


@pytest.mark.parametrize("edge", [0.004, 0.006])
@pytest.mark.parametrize("off", [-0.02, 0.0, 0.01, 0.02, 0.03])
def test_cloth_off_which_a_style_stands_is_not_missing(off, edge):
    """The nearest of noisy points lies aside by as much as the style stands off."""
    known, cloth = tube(edge, 0.001).seen(sheet(off, -0.9 * RIM, 0.9 * RIM))
    assert known.all()
    assert (~cloth).mean() < 0.03


@pytest.mark.parametrize("off", [-0.02, 0.0, 0.02, 0.03])
def test_cloth_ends_at_its_rim(off):
    target = tube(0.006, 0.001)
    shares = [target.seen(sheet(off, RIM + d - 1e-4, RIM + d + 1e-4))[1].mean() for d in (-0.005, 0.005, 0.01)]
    assert shares[0] > 0.97 and shares[1] < 0.05 and shares[2] == 0
