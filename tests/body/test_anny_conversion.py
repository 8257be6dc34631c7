"""The parts of the conversion that do not need the anny package, and what is said without it."""

import sys

import numpy as np
import pytest
import trimesh

from caphy.body import anny_conversion
from caphy.body.bundled import default_body
from caphy.body.coarsening import coarse_mesh
from caphy.cli import main
from caphy.conventions import JOINT_NAMES


def test_every_joint_has_bones_and_every_bone_one_joint():
    bones = anny_conversion._bones()
    assert set(bones) == set(JOINT_NAMES)
    flat = [bone for names in bones.values() for bone in names]
    assert len(flat) == len(set(flat)) == 104  # as many as anny's rig has


def test_merging_sums_the_weights_of_the_bones_of_a_joint():
    labels = ["lowerarm01.L", "lowerarm02.L", "head"]
    merged = anny_conversion._merged_weights(labels, np.array([[0, 1, 2]]), np.array([[0.25, 0.5, 0.25]]))
    assert merged[0, JOINT_NAMES.index("left_elbow")] == 0.75 and merged[0, JOINT_NAMES.index("head")] == 0.25


def test_y_up_facing_z_keeps_left_and_right():
    up, back, left = np.array([0, 0, 1.0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0])
    turned = anny_conversion._to_y_up(np.stack([up, -back, left]))
    np.testing.assert_array_equal(turned, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])


def test_strongest_keeps_the_largest_four():
    weights = np.random.default_rng(0).dirichlet(np.ones(55), size=30)
    kept = anny_conversion.strongest(weights)
    for row, answer in zip(weights, kept, strict=True):
        largest = sorted(range(55), key=lambda j: -row[j])[:4]
        assert sorted(np.flatnonzero(answer)) == sorted(largest)
        np.testing.assert_allclose(answer[largest], row[largest] / row[largest].sum())


def test_one_smoothing_pass_is_half_the_neighbours_mean():
    mesh = trimesh.creation.icosphere(1)
    weights = np.random.default_rng(1).dirichlet(np.ones(55), size=len(mesh.vertices))
    expected = [(weights[i] + weights[near].mean(axis=0)) / 2 for i, near in enumerate(mesh.vertex_neighbors)]
    np.testing.assert_allclose(anny_conversion.smoothed(weights, mesh.faces, 1), expected)


def test_shape_space_finds_planted_components():
    random = np.random.default_rng(2)
    directions = np.linalg.qr(random.normal(size=(90, 12)))[0].T[:, :90].reshape(12, 30, 3)
    sizes = np.linspace(3, 0.1, 12)
    coefficients = random.normal(size=(4000, 12))
    bodies = np.einsum("bk,k,kvc->bvc", coefficients, sizes, directions)
    joints = np.einsum("bk,kjc->bjc", coefficients, random.normal(size=(12, 55, 3)))
    found, joint_found = anny_conversion._shape_space(bodies, joints)
    assert found.shape == (30, 3, 10) and joint_found.shape == (55, 3, 10)
    np.testing.assert_allclose(np.linalg.norm(found, axis=(0, 1)), sizes[:10], rtol=0.05)
    betas = np.linalg.lstsq(found.reshape(-1, 10), (bodies - bodies.mean(axis=0)).reshape(4000, -1).T, rcond=None)[0].T
    np.testing.assert_allclose(betas.std(axis=0), 1, rtol=1e-3)
    best = betas @ np.linalg.lstsq(betas, (joints - joints.mean(axis=0)).reshape(4000, -1), rcond=None)[0]
    np.testing.assert_allclose(betas @ joint_found.reshape(-1, 10).T, best, atol=1e-8)


def test_coarse_mesh_is_closed_and_lies_on_the_fine_one():
    pytest.importorskip("gpytoolbox", reason="only 'caphy body build' needs gpytoolbox (caphy[body])")
    fine = default_body("fine")
    centres = dict(zip(JOINT_NAMES, fine.joints, strict=True))
    faces, face, weights = coarse_mesh(fine.v_template, fine.faces, centres)
    mesh = trimesh.Trimesh(np.einsum("uk,ukc->uc", weights, fine.v_template[fine.faces[face]]), faces, process=False)
    assert mesh.is_watertight and mesh.body_count == 1 and len(mesh.vertices) < 3200
    fine_volume = trimesh.Trimesh(fine.v_template, fine.faces, process=False).volume
    assert 0.97 < mesh.volume / fine_volume < 1
    hands = np.abs(mesh.vertices[:, 0]) > np.abs(centres["left_wrist"][0]) + 0.06
    edges = mesh.edges_unique
    lengths = mesh.edges_unique_length
    assert np.median(lengths[hands[edges].all(axis=1)]) < 0.6 * np.median(lengths)


def test_build_without_anny_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "anny", None)
    assert main(["body", "build", "--out", str(tmp_path)]) == 2
    assert "pip install 'caphy[body]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
