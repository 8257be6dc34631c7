"""The free body: closed, of human size, in SMPL-X's T-pose and axes, and the way back to anny's A-pose."""

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.body.surface import nearest_on_surface
from caphy.body.tpose import COLLAR_LIFT, tpose
from caphy.conventions import JOINT_NAMES

RESOLUTIONS = ["medium", "fine"]


def joint(name):
    return default_body().joints[JOINT_NAMES.index(name)]


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_closed_and_of_human_size(resolution):
    body = default_body(resolution)
    mesh = trimesh.Trimesh(body.v_template, body.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert 0.055 < mesh.volume < 0.075  # 55 to 75 kg at the density of water
    height = np.ptp(body.v_template[:, 1])
    assert 1.65 < height < 1.75


def test_the_medium_body_has_triangles_fit_for_contact():
    body = default_body("medium")
    mesh = trimesh.Trimesh(body.v_template, body.faces, process=False)
    assert 1000 <= len(body.v_template) <= 3200
    assert np.degrees(mesh.face_angles.min()) > 20
    assert mesh.edges_unique_length.max() < 0.05


def test_axes_and_tpose():
    np.testing.assert_array_equal(joint("pelvis"), 0)
    assert joint("head")[1] > 0.5 and joint("left_foot")[2] > joint("left_ankle")[2] + 0.1
    for side, sign in (("left", 1), ("right", -1)):
        arm = np.array([joint(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist", "middle1")])
        assert (sign * np.diff(arm[:, 0]) > 0.05).all()
        np.testing.assert_allclose(arm[1:3, 1:], np.tile(arm[0, 1:], (2, 1)), atol=1e-6)
        assert joint(f"{side}_index1")[2] > joint(f"{side}_pinky1")[2]  # palms down


def test_weights_are_few_and_sum_to_one():
    for resolution in RESOLUTIONS:
        weights = default_body(resolution).weights
        assert weights.min() >= 0 and (weights > 0).sum(axis=1).max() <= 4
        np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
        moved = {JOINT_NAMES[j] for j in np.flatnonzero(weights.sum(axis=0))}
        assert set(JOINT_NAMES) - moved <= {"jaw", "left_eye", "right_eye"}


def test_both_sides_are_alike():
    vertices = default_body("fine").v_template
    mirrored = nearest_on_surface(vertices * (-1, 1, 1), vertices, default_body("fine").faces)
    assert np.abs(mirrored.distance).max() < 1e-4


def test_joints_lie_inside_the_body():
    body = default_body("fine")
    inner = [j for j, name in enumerate(JOINT_NAMES) if "eye" not in name]
    distance = nearest_on_surface(body.joints[inner], body.v_template, body.faces).distance
    assert distance.max() < 0


@pytest.mark.parametrize("shape", [np.zeros(10), np.array([1.5, -1, 1, 0, 0, 0, 0, 0, 0, 0])])
def test_medium_and_fine_are_the_same_body(shape):
    poses = np.random.default_rng(0).normal(size=(1, 55, 3)) * 0.3
    poses[:, 22:] = 0  # finger gaps are finer than the medium mesh
    medium, fine = (default_body(resolution) for resolution in RESOLUTIONS)
    surface = fine.pose(poses, betas=shape)[0]
    distance = np.abs(nearest_on_surface(medium.pose(poses, betas=shape)[0], surface, fine.faces).distance)
    assert np.percentile(distance, 99) < 0.003


def test_the_first_shape_coefficient_makes_it_taller():
    body = default_body()
    heights = [np.ptp(body.rest([b])[0][:, 1]) for b in (-2, 0, 2)]
    assert heights[0] + 0.1 < heights[1] < heights[2] - 0.1


def test_shaped_joints_keep_to_the_shaped_skeleton():
    """Arms and legs of any shape stay straight, and joints inside: what a linear regressor of the surface fails."""
    body = default_body("fine")
    for seed in range(5):
        vertices, joints = body.rest(np.random.default_rng(seed).normal(size=10))
        np.testing.assert_allclose(joints[[18, 20], 1], joints[16, 1], atol=2e-3)
        assert nearest_on_surface(joints[:22], vertices, body.faces).distance.max() < 0


def test_tpose_undoes_an_a_pose():
    body = default_body()
    pose = np.zeros((1, 55, 3))
    for side, sign in (("left", 1), ("right", -1)):
        index = {name: JOINT_NAMES.index(f"{side}_{name}") for name in ("collar", "shoulder", "elbow")}
        pose[0, index["collar"], 2] = -sign * COLLAR_LIFT
        pose[0, index["shoulder"], 2] = -sign * 0.6
        pose[0, index["elbow"], 1] = -sign * 0.7
    vertices, joints = tpose(body.pose(pose)[0], body.posed_joints(pose)[0], body.weights)
    np.testing.assert_allclose(joints, body.joints, atol=1e-5)
    np.testing.assert_allclose(vertices, body.v_template, atol=1e-5)
