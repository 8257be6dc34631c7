"""Rotations against scipy's."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from caphy import rotations as r

ANGLES = [0.0, 1e-12, 1e-9, 1e-5, 1e-4, 2e-4, 0.3, 1.7, np.pi - 1e-7, np.pi]


def axis_angles() -> np.ndarray:
    random = np.random.default_rng(0)
    axes = random.normal(size=(40, 3))
    axes = np.concatenate([axes / np.linalg.norm(axes, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    return (np.array(ANGLES)[:, None, None] * axes).reshape(-1, 3)


def same_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between quaternions, w first, up to sign."""
    return np.minimum(np.abs(a - b).max(axis=-1), np.abs(a + b).max(axis=-1))


def scipy_quaternion(axis_angle: np.ndarray) -> np.ndarray:
    return np.roll(Rotation.from_rotvec(axis_angle).as_quat(), 1, axis=-1)


def test_matrix_from_axis_angle():
    given = axis_angles()
    np.testing.assert_allclose(r.matrix_from_axis_angle(given), Rotation.from_rotvec(given).as_matrix(), atol=1e-15)


def test_quaternion_from_axis_angle():
    given = axis_angles()
    assert same_rotation(r.quaternion_from_axis_angle(given), scipy_quaternion(given)).max() < 1e-15


def test_axis_angle_from_quaternion_takes_the_short_way():
    given = axis_angles()
    quaternion = scipy_quaternion(given)
    for sign in (1, -1):
        back = r.axis_angle_from_quaternion(sign * quaternion)
        assert np.linalg.norm(back, axis=-1).max() <= np.pi + 1e-12
        assert same_rotation(scipy_quaternion(back), quaternion).max() < 1e-15


def test_quaternion_from_matrix_everywhere():
    given = axis_angles()
    matrix = Rotation.from_rotvec(given).as_matrix()
    assert same_rotation(r.quaternion_from_matrix(matrix), scipy_quaternion(given)).max() < 1e-14
    restored = r.matrix_from_axis_angle(r.axis_angle_from_matrix(matrix))
    np.testing.assert_allclose(restored, matrix, atol=1e-14)


def test_slerp():
    random = np.random.default_rng(1)
    start, end = random.normal(size=(2, 50, 3))
    fraction = random.uniform(size=50)
    a, b = scipy_quaternion(start), scipy_quaternion(end)
    expected = [
        np.roll(Slerp([0, 1], Rotation.from_rotvec([s, e]))(f).as_quat(), 1)
        for s, e, f in zip(start, end, fraction, strict=True)
    ]
    assert same_rotation(r.slerp(a, b, fraction), np.array(expected)).max() < 1e-14
    assert same_rotation(r.slerp(a, -b, fraction), np.array(expected)).max() < 1e-14  # q and -q are one rotation
    assert same_rotation(r.slerp(a, a, fraction), a).max() < 1e-15


def test_sixd_is_the_first_two_columns():
    matrix = Rotation.from_rotvec(axis_angles()).as_matrix()
    sixd = r.sixd_from_matrix(matrix)
    third = np.cross(sixd[:, :3], sixd[:, 3:])
    np.testing.assert_allclose(np.stack([sixd[:, :3], sixd[:, 3:], third], axis=-1), matrix, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_equals_numpy_and_keeps_its_dtype(dtype):
    given = axis_angles()
    answer = r.matrix_from_axis_angle(torch.as_tensor(given, dtype=dtype))
    assert answer.dtype == dtype
    np.testing.assert_allclose(answer, r.matrix_from_axis_angle(given), atol=4 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradient_is_exact_also_at_zero(angle):
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    point = (angle * axis).requires_grad_()
    assert torch.autograd.gradcheck(r.matrix_from_axis_angle, (point,), eps=1e-6, atol=1e-7)
