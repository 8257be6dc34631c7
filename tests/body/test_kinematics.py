"""Forward kinematics and skinning against plain loops, and torch against numpy."""

import numpy as np
import pytest
import torch

from caphy.body.kinematics import joint_positions, joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import JOINT_PARENTS
from caphy.rotations import matrix_from_axis_angle


def random_case(batch, seed=0):
    random = np.random.default_rng(seed)
    return matrix_from_axis_angle(random.normal(size=(*batch, 55, 3))), random.normal(size=(55, 3))


def by_loops(rotations, joints, parents):
    world = []
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    rest = np.tile(np.eye(4), (len(joints), 1, 1))
    rest[:, :3, 3] = -joints
    return (np.array(world) @ rest)[:, :3]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_transforms_are_those_of_the_chain(batch):
    rotations, joints = random_case(batch)
    answer = joint_transforms(rotations, joints, JOINT_PARENTS)
    flat = answer.reshape(-1, 55, 3, 4)
    for transforms, given in zip(flat, rotations.reshape(-1, 55, 3, 3), strict=True):
        np.testing.assert_allclose(transforms, by_loops(given, joints, JOINT_PARENTS), atol=1e-13)


def test_any_tree_and_joints_that_vary_over_frames():
    parents = (-1, 0, 0, 2, 1, 4, 3)
    random = np.random.default_rng(5)
    rotations = matrix_from_axis_angle(random.normal(size=(4, 7, 3)))
    joints = random.normal(size=(4, 7, 3))
    answer = joint_transforms(rotations, joints, parents)
    for t in range(4):
        np.testing.assert_allclose(answer[t], by_loops(rotations[t], joints[t], parents), atol=1e-13)


def test_joint_positions_are_where_the_transforms_put_the_joints():
    rotations, joints = random_case((2,))
    transforms = joint_transforms(rotations, joints, JOINT_PARENTS)
    expected = np.einsum("tjab,jb->tja", transforms[..., :3], joints) + transforms[..., 3]
    np.testing.assert_allclose(joint_positions(transforms, joints), expected, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_blending_and_skinning_are_the_weighted_sums(batch):
    random = np.random.default_rng(1)
    transforms = random.normal(size=(*batch, 55, 3, 4))
    weights, points = random.uniform(size=(20, 55)), random.normal(size=(20, 3))
    blended = blend_transforms(weights, transforms)
    np.testing.assert_allclose(blended, np.einsum("vj,...jab->...vab", weights, transforms), atol=1e-12)
    expected = np.einsum("...vab,vb->...va", blended[..., :3], points) + blended[..., 3]
    np.testing.assert_allclose(skin(blended, points), expected, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_equals_numpy(dtype):
    rotations, joints = random_case((3,))
    random = np.random.default_rng(2)
    weights, points = random.dirichlet(np.ones(55), size=20), random.normal(size=(3, 20, 3))

    def path(*arrays):
        rotations, joints, weights, points = arrays
        return skin(blend_transforms(weights, joint_transforms(rotations, joints, JOINT_PARENTS)), points)

    given = (rotations, joints, weights, points)
    answer = path(*(torch.as_tensor(a, dtype=dtype) for a in given))
    assert answer.dtype == dtype
    np.testing.assert_allclose(answer, path(*given), atol=100 * torch.finfo(dtype).eps)


def test_the_path_is_differentiable():
    random = np.random.default_rng(3)
    joints, weights = torch.as_tensor(random.normal(size=(55, 3))), torch.as_tensor(random.dirichlet(np.ones(55), 2))
    points = torch.as_tensor(random.normal(size=(2, 3)))
    poses = torch.as_tensor(random.normal(size=(1, 55, 3)) * 0.5).requires_grad_()

    def vertices(poses):
        return skin(
            blend_transforms(weights, joint_transforms(matrix_from_axis_angle(poses), joints, JOINT_PARENTS)), points
        )

    assert torch.autograd.gradcheck(vertices, (poses,), fast_mode=True)
