"""Distances between clothes and scans: closed forms, trimesh's nearest points, and what nobody can see."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from caphy.errors import CaphyError
from caphy.evaluate.chamfer import Chamfer, ScanCloth, visible_points
from caphy.evaluate.dressed import Dressed
from caphy.scan.scan import BODY, LOWER, UPPER, Scan


def _sphere(radius: float, subdivisions: int = 3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mesh.vertices + np.array([0.0, 1.0, 0.0]), np.array(mesh.faces)


def _nearest(points, vertices, faces):
    """Distances (N,) by trimesh, triangle by triangle."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    chunks = np.array_split(points, max(1, len(points) // 1000))
    return np.concatenate([trimesh.proximity.closest_point_naive(mesh, chunk)[1] for chunk in chunks])


def _scan(vertices, faces, label=UPPER):
    return Scan("one", vertices, faces.astype(np.int32), labels=np.full(len(vertices), label, np.uint8))


def _dressed(body_radius=0.1, **garments):
    return Dressed(*_sphere(body_radius), garments)


def test_concentric_spheres_are_their_radii_apart():
    found = ScanCloth.of(_scan(*_sphere(0.30)), ("upper",)).chamfer(_dressed(upper=_sphere(0.32)), ("upper",))
    # of an icosphere's chords: faces lie up to 0.5 % inside the sphere
    assert found.to_scan == pytest.approx(0.02, rel=0.03) and found.from_scan == pytest.approx(0.02, rel=0.1)
    assert found.mean == pytest.approx(0.5 * (found.to_scan + found.from_scan))
    assert found.root == pytest.approx(0.02, rel=0.1)


def test_pop_adds_mean_squares_of_both_directions():
    found = Chamfer(0.003, 0.004, 0.0001, 0.0003)
    assert found.pop == pytest.approx(4e-4)
    assert found.root == pytest.approx(np.sqrt(2e-4))


def test_distances_are_those_of_trimesh_and_the_root_is_never_less_than_the_mean(monkeypatch):
    monkeypatch.setattr("caphy.evaluate.chamfer.SAMPLES", 1500)
    rng = np.random.default_rng(0)
    vertices, faces = _sphere(0.3, 2)
    bumpy = vertices + 0.02 * rng.standard_normal(vertices.shape)
    worn = (1.05 * (vertices - [0, 1, 0]) + [0.01, 1, 0], faces)
    dressed = _dressed(upper=worn)
    found = ScanCloth.of(_scan(bumpy, faces), ("upper",)).chamfer(dressed, ("upper",))
    seen = visible_points(dressed, *worn)
    there, back = _nearest(seen, bumpy, faces), _nearest(bumpy, *worn)
    assert found.to_scan == pytest.approx(there.mean(), rel=1e-6)
    assert found.from_scan_square == pytest.approx((back**2).mean(), rel=1e-6)
    assert found.root >= found.mean


def test_only_what_is_labelled_as_cloth_counts():
    vertices, faces = _sphere(0.3)
    labels = np.where(vertices[:, 1] > 1.0, UPPER, BODY).astype(np.uint8)
    cloth = ScanCloth.of(Scan("half", vertices, faces.astype(np.int32), labels=labels), ("upper", "lower"))
    assert cloth.points[:, 1].min() > 1.0 and len(cloth.points) > 250
    with pytest.raises(CaphyError, match="half: shows no lower garment"):
        ScanCloth.of(Scan("half", vertices, faces.astype(np.int32), labels=labels), ("lower",))


def test_what_lies_under_something_else_is_not_seen():
    vertices, faces = _sphere(0.3)
    above = faces[(vertices[faces][:, :, 1] > 1.0).all(axis=1)]
    dressed = _dressed(upper=(1.02 * (vertices - [0, 1, 0]) + [0, 1, 0], above), lower=(vertices, faces))
    seen = visible_points(dressed, vertices, faces)
    assert seen[:, 1].max() < 1.10  # looks under the hem reach three centimetres far
    assert len(seen) > 4000
    with pytest.raises(CaphyError, match="nothing of the predicted garments can be seen"):
        visible_points(_dressed(body_radius=0.5, upper=_sphere(0.3)), *_sphere(0.3))


def test_a_wrong_side_that_scans_cannot_show_does_not_count():
    """A scan without what is hidden, and a prediction with it, differ by nothing."""
    vertices, faces = _sphere(0.3)
    above = faces[(vertices[faces][:, :, 1] > 1.0).all(axis=1)]
    coat = (1.02 * (vertices - [0, 1, 0]) + [0, 1, 0], above)
    dressed = _dressed(upper=coat, lower=(vertices, faces))
    below = (vertices[:, 1] <= 1.12).astype(np.uint8) * LOWER
    scan = Scan("worn", vertices, faces.astype(np.int32), labels=np.where(below, LOWER, UPPER).astype(np.uint8))
    found = ScanCloth.of(scan, ("lower",)).chamfer(dressed, ("lower",))
    assert found.from_scan < 1e-6 and found.to_scan < 1e-6
