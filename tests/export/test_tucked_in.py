"""The body to display lies a little deeper where clothes cover it, and nowhere else."""

from __future__ import annotations

import numpy as np
import trimesh

from export.avatar import tucked_in


def test_only_what_is_covered_moves_inwards():
    body = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    shell = trimesh.creation.icosphere(subdivisions=4, radius=0.22)
    upper = shell.faces[(shell.vertices[shell.faces][:, :, 1] > 0).all(axis=1)]
    used, upper = np.unique(upper, return_inverse=True)
    vertices = np.asarray(body.vertices)
    tucked = tucked_in(vertices, np.asarray(body.faces), [(shell.vertices[used], upper.reshape(-1, 3))], depth=0.008)
    radius = np.linalg.norm(tucked, axis=1)
    height = vertices[:, 1]
    np.testing.assert_allclose(radius[height > 0.08], 0.192, atol=1e-4)
    np.testing.assert_array_equal(tucked[height < -0.01], vertices[height < -0.01])
    assert (radius <= 0.2 + 1e-9).all()
