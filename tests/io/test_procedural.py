"""The procedural motion: repeatable, within joint limits, smooth, on the ground."""

import numpy as np
import pytest

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.procedural import procedural_motion
from caphy.io.procedural_limits import LEFT
from caphy.rotations import matrix_from_axis_angle

SEEDS = range(4)


def test_depends_on_the_seed_alone():
    a, b = procedural_motion(3, 9.0, 30.0), procedural_motion(3, 9.0, 30.0)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.transl, b.transl)
    assert np.abs(a.poses - procedural_motion(4, 9.0, 30.0).poses).max() > 0.1
    assert (len(a), a.fps) == (271, 30.0)


def test_a_longer_motion_begins_as_a_shorter_one():
    short, long = procedural_motion(1, 5.0, 30.0), procedural_motion(1, 15.0, 30.0)
    np.testing.assert_allclose(long.poses[: len(short)], short.poses, atol=1e-12)


def test_the_frame_rate_does_not_change_the_motion():
    slow, fast = procedural_motion(2, 12.0, 30.0), procedural_motion(2, 12.0, 120.0)
    np.testing.assert_allclose(fast.poses[::4][:, 1:], slow.poses[:, 1:], atol=1e-9)
    assert np.abs(fast.transl[::4] - slow.transl).max() < 0.06


@pytest.mark.parametrize("seed", SEEDS)
def test_joints_stay_within_their_limits(seed):
    rotations = matrix_from_axis_angle(procedural_motion(seed, 30.0, 30.0).poses)
    # angles of R = Rx(a) Ry(b) Rz(c), read off the matrix
    a = np.arctan2(-rotations[..., 1, 2], rotations[..., 2, 2])
    b = np.arcsin(np.clip(rotations[..., 0, 2], -1, 1))
    c = np.arctan2(-rotations[..., 0, 1], rotations[..., 0, 0])
    angles = np.degrees(np.stack([a, b, c], axis=-1))
    for joint, name in enumerate(JOINT_NAMES[1:], start=1):
        mirror = np.array([1, -1, -1]) if name.startswith("right_") else 1
        ranges = LEFT.get(name.replace("right_", "left_"), ((0, 0),) * 3)
        for axis, (low, high) in enumerate(ranges):
            seen = (angles[:, joint] * mirror)[:, axis]
            assert low - 1e-6 <= seen.min() <= seen.max() <= high + 1e-6, (name, axis)
    for side, sign in (("left", -1), ("right", 1)):  # both sides move: limits are mirrored, not shared
        assert (sign * angles[:, JOINT_NAMES.index(f"{side}_elbow"), 1]).max() > 30


@pytest.mark.parametrize("seed", SEEDS)
def test_moves_like_a_body(seed):
    motion = procedural_motion(seed, 30.0, 60.0)
    assert motion.angular_speed().max() < 20  # rad/s; running reaches 30
    acceleration = np.linalg.norm(np.diff(motion.transl, n=2, axis=0), axis=-1) * motion.fps**2
    assert acceleration.max() < 30  # m/s^2; the jumps of the CMU clips reach 25
    assert not motion.jumps()


@pytest.mark.parametrize("seed", SEEDS)
def test_feet_stand_on_the_ground_and_leave_it_to_jump(seed):
    motion = procedural_motion(seed, 20.0, 30.0)
    lowest = default_body().pose(motion.poses, motion.transl)[..., 1].min(axis=1)
    assert lowest.min() > -0.03
    assert np.quantile(np.abs(lowest), 0.8) < 0.015
    assert 0.1 < lowest.max() < 0.35


def test_holds_every_action():
    """Within one round: hips travel (walk), heading turns, hips sink (squat), hands rise above the shoulders."""
    motion = procedural_motion(0, 18.0, 30.0)
    joints = default_body().posed_joints(motion.poses, motion.transl)
    at = JOINT_NAMES.index
    across = joints[:, at("left_hip")] - joints[:, at("right_hip")]
    heading = np.unwrap(np.arctan2(-across[:, 2], across[:, 0]))
    assert np.ptp(heading) > np.radians(60)
    travelled = np.linalg.norm(np.diff(motion.transl[:, [0, 2]], axis=0), axis=-1).sum()
    assert travelled > 2.0
    height = joints[:, 0, 1]
    assert np.median(height) - height.min() > 0.2
    hands = joints[:, [at("left_wrist"), at("right_wrist")], 1] - joints[:, [at("left_shoulder")], 1]
    assert hands.max() > 0.0


def test_walkers_go_where_they_face():
    motion = procedural_motion(1, 60.0, 30.0)
    joints = default_body().posed_joints(motion.poses, motion.transl)
    across = joints[:, 1] - joints[:, 2]
    ahead = np.cross(across, [0, 1, 0])[:-1, [0, 2]]
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    velocity = np.diff(motion.transl[:, [0, 2]], axis=0) * motion.fps
    walking = np.linalg.norm(velocity, axis=-1) > 0.6
    assert walking.mean() > 0.05
    assert np.median(np.sum(ahead * velocity, axis=-1)[walking]) > 0.6


@pytest.mark.parametrize(("seconds", "fps"), [(0.0, 30.0), (-1.0, 30.0), (float("nan"), 30.0), (5.0, 0.0), (5.0, 1e9)])
def test_refuses_impossible_lengths(seconds, fps):
    with pytest.raises(CaphyError, match="a motion needs"):
        procedural_motion(0, seconds, fps)


@pytest.mark.parametrize("seconds", [0.01, 0.3, 2.05])
def test_may_be_short(seconds):
    assert np.isfinite(procedural_motion(0, seconds, 30.0).poses).all()
