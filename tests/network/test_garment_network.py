"""The network's streaming form, its invariances and its start."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.network.features import as_first_frames, pose_features, rest_state
from caphy.network.garment_network import GarmentNetwork
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle


@pytest.fixture
def network() -> GarmentNetwork:
    torch.manual_seed(0)
    random = np.random.default_rng(0)
    weights = np.zeros((40, JOINT_COUNT))
    weights[:, [3, 6, 9, 16]] = random.dirichlet(np.ones(4), 40)
    joints = random.normal(size=(JOINT_COUNT, 3))
    network = GarmentNetwork(random.normal(size=(40, 3)), weights, joints, layers=2, width=16)
    torch.nn.init.normal_(network.head.weight, std=0.1)
    torch.nn.init.normal_(network.head.bias, std=0.1)
    network.double().weights.copy_(torch.tensor(weights))  # float32 rows sum to one only to 1e-7
    return network


def motion(frames: int, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(seed)
    poses = np.cumsum(random.normal(scale=0.05, size=(frames, JOINT_COUNT, 3)), axis=0)
    return torch.tensor(poses), torch.tensor(np.cumsum(random.normal(scale=0.02, size=(frames, 3)), axis=0))


@pytest.mark.parametrize("cuts", [[1] * 12, [12], [5, 7], [1, 1, 10], [2, 3, 7]])
def test_chunks_equal_one_stream(network, cuts):
    poses, transl = motion(12)
    whole, final = network(poses, transl, network.initial_state())
    state, parts = network.initial_state(), []
    for part in torch.arange(12).split(cuts):
        vertices, state = network(poses[part], transl[part], state)
        parts.append(vertices)
    torch.testing.assert_close(torch.cat(parts), whole, rtol=0, atol=1e-12)
    torch.testing.assert_close(state, final, rtol=0, atol=1e-12)


def test_state_matters(network):
    poses, transl = motion(12)
    whole, _ = network(poses, transl, network.initial_state())
    alone, _ = network(poses[6:], transl[6:], network.initial_state())
    assert (whole[6:] - alone).abs().max() > 1e-4


def test_turning_the_motion_turns_the_garment(network):
    """A turn about y and a shift of the world are a turn and a shift of every vertex, at every frame."""
    poses, transl = motion(10)
    angle = torch.tensor([0.0, 2.1, 0.0], dtype=torch.float64)
    turn, shift = matrix_from_axis_angle(angle), torch.tensor([3.0, 0.5, -2.0], dtype=torch.float64)
    root = matrix_from_axis_angle(poses[:, 0])
    turned = poses.clone()
    turned[:, 0] = axis_angle_from_matrix(turn @ root)
    pelvis = network.joints[0]
    moved = (transl + pelvis) @ turn.mT - pelvis + shift
    expected = network(poses, transl, network.initial_state())[0] @ turn.mT + shift
    actual = network(turned, moved, network.initial_state())[0]
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-9)


def test_tilting_the_motion_is_seen(network):
    poses, transl = motion(10)
    tilt = matrix_from_axis_angle(torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64))
    rotations = matrix_from_axis_angle(poses)
    tilted = rotations.clone()
    tilted[:, 0] = tilt @ rotations[:, 0]
    before, _ = pose_features(rotations, transl, rest_state(transl), network.driving, 30.0)
    after, _ = pose_features(tilted, transl @ tilt.mT, rest_state(transl), network.driving, 30.0)
    changed = (before - after).abs().amax(0) > 1e-9
    assert changed[-12:-9].any() and not changed[:-12].any() and not changed[-9:].any()


def test_features_against_plain_loops(network):
    poses, transl = motion(8)
    rotations = matrix_from_axis_angle(poses)
    actual, _ = pose_features(rotations, transl, rest_state(transl), network.driving, 30.0)
    root, place = rotations[:, 0].numpy(), transl.numpy()
    for t in range(8):
        velocity = (place[t] - place[t - 1]) * 30 if t > 0 else np.zeros(3)
        earlier = (place[t - 1] - place[t - 2]) * 30 if t > 1 else velocity
        increment = root[t - 1].T @ root[t] if t > 0 else np.eye(3)
        skew = (increment - increment.T) / 2
        row = [root[t].T @ [0, -1, 0], root[t].T @ velocity, np.clip(root[t].T @ (velocity - earlier) * 3, -5, 5)]
        row.append(np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) * 30 / 3)
        shape = [rotations[t, j].numpy()[:, :2].T.ravel() for j in network.driving]
        np.testing.assert_allclose(actual[t].numpy(), np.concatenate(shape + row), atol=1e-12)


def test_a_stream_may_start_anywhere(network):
    poses, transl = motion(9)
    rotations = matrix_from_axis_angle(poses)
    whole, _ = pose_features(rotations, transl, rest_state(transl), network.driving, 30.0)
    fresh, _ = pose_features(rotations[4:], transl[4:], rest_state(transl), network.driving, 30.0)
    torch.testing.assert_close(as_first_frames(whole[4:]), fresh, rtol=0, atol=1e-12)


def test_a_jump_of_the_tracker_stays_bounded(network):
    poses, transl = motion(6)
    transl[3:] += 50.0
    features, _ = pose_features(matrix_from_axis_angle(poses), transl, rest_state(transl), network.driving, 30.0)
    assert features.abs().max() <= 5.0


def test_starts_as_the_skinned_template(network):
    fresh = GarmentNetwork(network.template.numpy(), network.weights.numpy(), network.joints.numpy())
    poses, transl = (a.float() for a in motion(3))
    vertices, _ = fresh(poses, transl, fresh.initial_state())
    rotations = matrix_from_axis_angle(poses)
    torch.testing.assert_close(vertices, fresh.skinned(rotations, transl, fresh.template))
    rest, _ = fresh(torch.zeros(1, JOINT_COUNT, 3), torch.zeros(1, 3), fresh.initial_state())
    torch.testing.assert_close(rest[0], fresh.template, rtol=0, atol=1e-6)


def test_driving_joints_hold_every_carrier(network):
    assert network.driving == [3, 6, 9, 13, 16]  # 16 hangs on 13, and that on 9; the root is not among them
    for joint in network.driving:
        assert JOINT_PARENTS[joint] in (0, *network.driving)


def test_stream_of_arrays(network):
    poses, transl = motion(7)
    whole, _ = network(poses, transl, network.initial_state())
    np.testing.assert_allclose(network.stream(poses.numpy(), transl.numpy(), chunk=3), whole.detach(), atol=1e-12)
