"""The motion through postures: repeatable, all over the joints' limits and no further, eased."""

import numpy as np
import pytest

from caphy.conventions import JOINT_NAMES
from caphy.io.procedural_limits import LEFT
from caphy.io.procedural_postures import posture_motion
from caphy.rotations import matrix_from_axis_angle

WRAPPED = ("left_elbow", "right_elbow")  # bent by more than 90 degrees, which cannot be read off a matrix so


def test_depends_on_the_seed_alone_and_not_on_the_frame_rate():
    slow, fast = posture_motion(3, 9.0, 30.0), posture_motion(3, 9.0, 120.0)
    np.testing.assert_allclose(fast.poses[::4], slow.poses, atol=1e-9)
    assert (len(slow), slow.fps) == (271, 30.0)
    assert np.abs(slow.poses - posture_motion(4, 9.0, 30.0).poses).max() > 0.1


@pytest.mark.parametrize("name", [name for name in JOINT_NAMES[1:] if name not in WRAPPED])
def test_joints_go_all_over_their_limits_and_no_further(name):
    rotations = matrix_from_axis_angle(posture_motion(3, 60.0).poses[:, JOINT_NAMES.index(name)])
    a = np.arctan2(-rotations[:, 1, 2], rotations[:, 2, 2])
    b = np.arcsin(np.clip(rotations[:, 0, 2], -1, 1))
    c = np.arctan2(-rotations[:, 0, 1], rotations[:, 0, 0])
    mirror = -1 if name.startswith("right_") else 1
    angles = np.degrees([a, mirror * b, mirror * c])
    ranges = LEFT.get(name.replace("right_", "left_"), ((0, 0),) * 3)
    for angle, (low, high) in zip(angles, ranges, strict=True):
        assert low - 1e-6 <= angle.min() <= low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) <= angle.max() <= high + 1e-6


def test_postures_are_eased_into_one_another():
    still, between = np.split(posture_motion(1, 10.0, 60.0).angular_speed()[:600].reshape(20, 30, 55), [1], axis=1)
    assert still.max() < 0.2 * between.max(axis=1).max()
