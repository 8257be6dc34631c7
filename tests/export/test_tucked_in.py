"""The body to display lies a little deeper where clothes cover it, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from caphy.garment.topology import boundary_edges, boundary_loops
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


def test_a_garment_pinched_at_a_vertex_has_edges_too():
    """Two pieces that share one corner: both fade out towards their own edges."""
    body = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    shell = trimesh.creation.icosphere(subdivisions=4, radius=0.22)
    high = (shell.vertices[shell.faces][:, :, 1] > 0.12).all(axis=1)
    low = (shell.vertices[shell.faces][:, :, 1] < -0.12).all(axis=1)
    faces = shell.faces[high | low].copy()
    faces[faces == boundary_edges(shell.faces[low])[0, 0]] = boundary_edges(shell.faces[high])[0, 0]
    with pytest.raises(ValueError, match="boundary vertices"):
        boundary_loops(faces)
    used, faces = np.unique(faces, return_inverse=True)
    worn = [(shell.vertices[used], faces.reshape(-1, 3))]
    tucked = tucked_in(np.asarray(body.vertices), np.asarray(body.faces), worn, depth=0.008)
    radius = np.linalg.norm(tucked, axis=1)
    assert radius.min() < 0.193
    np.testing.assert_allclose(radius[np.abs(body.vertices[:, 1]) < 0.1], 0.2, atol=1e-9)
