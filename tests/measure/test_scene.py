"""What a measurement becomes before it is rolled out: garment, pins, body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene


@pytest.fixture(scope="module")
def film() -> Measurement:
    return measured(*simulate(settle=0.2, tempo=1.2))


def test_a_stated_pelvis_is_that_of_the_shape():
    """A shape space whose pelvis moves with betas, as SMPL-X's does and the bundled body's does not."""
    bundled = default_body()
    moves = bundled.joint_shapedirs.copy()
    moves[0, :, 0] = 0, 0.01, 0.005
    body, betas, count = replace(bundled, joint_shapedirs=moves), np.array([2.0]), 5
    pelvis = body.rest(betas)[1][0]
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 4), [0.0], np.linspace(-0.1, 0.1, 4)), -1).reshape(-1, 3)
    corners = np.array([4 * i + j for i in range(3) for j in range(3)])
    faces = np.concatenate([corners[:, None] + half for half in ([0, 4, 1], [1, 4, 5])])
    weights = np.zeros((16, 55))
    weights[:, 0] = 1
    transl = np.tile([0.1, 0.2, 0.3], (count, 1))
    measurement = Measurement(
        "film", 30.0, vertices=np.tile(grid + pelvis, (count, 1, 1)), faces=faces, rest_vertices=grid, weights=weights,
        poses=np.zeros((count, 55, 3)), transl=transl, betas=betas, pelvis=np.zeros(3),
    )  # fmt: skip
    motion = Scene.of(measurement, None, body).motion
    stands = motion.vertices(np.zeros(1))[0]
    np.testing.assert_allclose(stands, body.rest(betas)[0] - pelvis + transl[0], atol=1e-7)


def test_pins_of_another_mesh_are_told(film):
    """A cloud has no vertices of its own that they could be checked against."""
    seen = film.vertices.reshape(-1, 3)
    offsets = len(film.rest_vertices) * np.arange(len(film) + 1)
    cloud = Measurement(
        "cloud", film.fps, points=seen, offsets=offsets, pinned=film.pinned + len(film.rest_vertices),
        pinned_positions=film.pinned_positions,
    )  # fmt: skip
    with pytest.raises(CaphyError, match=r"cloud: pinned must index the garment's \d+ vertices"):
        Scene.of(cloud, Scene.of(film).garment)
