"""The pose sequence: what it accepts, and what its operations keep."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, concatenate
from caphy.rotations import matrix_from_axis_angle


def sequence(frames=7, seed=0, spread=0.5, **fields) -> PoseSequence:
    rng = np.random.default_rng(seed)
    poses, transl = rng.normal(0, spread, (frames, 55, 3)), rng.normal(0, 1, (frames, 3))
    return PoseSequence(**{"poses": poses, "transl": transl, "fps": 30.0, "source": "made.npz", **fields})


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"poses": np.zeros((3, 24, 3)), "transl": np.zeros((3, 3))}, "(frames, 55, 3)"),
        ({"poses": np.zeros((0, 55, 3)), "transl": np.zeros((0, 3))}, "at least one frame"),
        ({"transl": np.zeros((3, 3))}, "(7, 3)"),
        ({"fps": 0.0}, "fps must lie between 0.1 and 10000"),
        ({"fps": float("nan")}, "fps must lie between"),
        ({"fps": 1 / 30}, "is it the time of a frame, of 30 frames per second?"),
        ({"fps": 1e6}, "fps must lie between"),
        ({"fps": None}, "fps must be a number"),
        ({"spread": 30.0}, "are they degrees?"),
        ({"transl": np.full((7, 3), 1500.0)}, "are they millimetres?"),
        ({"up_axis": "x"}, "up_axis"),
        ({"frame": "studio"}, "frame"),
        ({"betas": [float("inf")]}, "betas must be finite"),
        ({"pelvis": (0.0, 0.0)}, "pelvis"),
        ({"poses": "walk"}, "poses must be numbers"),
    ],
)
def test_refuses_and_says_why(fields, words):
    with pytest.raises(CaphyError) as caught:
        sequence(**fields)
    assert "made.npz" in str(caught.value)
    assert words in str(caught.value)


def test_names_frame_and_joint_of_a_nan():
    poses = np.zeros((5, 55, 3))
    poses[3, 18, 1] = np.nan
    with pytest.raises(CaphyError, match=r"made\.npz.*frame 3.*joint 18 \(left_elbow\)"):
        sequence(poses=poses, transl=np.zeros((5, 3)))
    transl = np.zeros((5, 3))
    transl[4, 2] = np.inf
    with pytest.raises(CaphyError, match=r"transl.*frame 4"):
        sequence(poses=np.zeros((5, 55, 3)), transl=transl)


def test_cannot_be_changed_afterwards():
    given_poses = np.zeros((2, 55, 3))
    made = sequence(poses=given_poses, transl=np.zeros((2, 3)))
    given_poses[:] = 1
    assert not made.poses.any()
    with pytest.raises(ValueError, match="read-only"):
        made.poses[0] = 1


def test_resampling_a_constant_turn_keeps_its_speed():
    """Closed form: a turn at constant rate about one axis is a straight line in axis-angle."""
    axis, rate = np.array([1.0, 2.0, -2.0]) / 3, 1.7
    time = np.arange(31) / 30
    poses = np.zeros((31, 55, 3))
    poses[:, 4] = (rate * time)[:, None] * axis
    transl = np.outer(time, [0.3, 0.0, 1.1])
    for fps in (12.0, 25.0, 60.0, 120.0):
        out = PoseSequence(poses, transl, 30.0).resample(fps)
        now = np.arange(len(out)) / fps
        assert len(out) == int(1.0 * fps) + 1
        np.testing.assert_allclose(out.poses[:, 4], (rate * now)[:, None] * axis, atol=1e-12)
        np.testing.assert_allclose(out.transl, np.outer(now, [0.3, 0.0, 1.1]), atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 12), st.integers(0, 10_000), st.sampled_from([7.0, 30.0, 59.94, 120.0]))
def test_resampling_stays_within_the_neighbours(frames, seed, fps):
    """Every resampled rotation lies on the shorter arc between its neighbours, at its share of the time."""
    made = sequence(frames, seed, spread=1.2)
    out = made.resample(fps)
    assert len(out) == math.floor(made.duration * fps + 1e-6) + 1
    assert out.duration <= made.duration + 1e-6
    for i in range(0, len(out), 3):
        at = min(i * 30.0 / fps, frames - 1)
        left = min(int(at), frames - 2)
        share = at - left
        a, b = (matrix_from_axis_angle(made.poses[k]) for k in (left, left + 1))
        c = matrix_from_axis_angle(out.poses[i])
        whole, part = angle(a, b), angle(a, c)
        clear = whole < np.pi - 1e-3  # half a turn has two shorter arcs
        np.testing.assert_allclose(part[clear], share * whole[clear], atol=1e-6)
        np.testing.assert_allclose(angle(c, b)[clear], (1 - share) * whole[clear], atol=1e-6)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8), 0, 1))


def test_resampling_to_the_same_rate_changes_nothing():
    made = sequence()
    np.testing.assert_array_equal(made.resample(30.0).poses, made.poses)
    assert len(sequence(1).resample(60.0)) == 1


@pytest.mark.parametrize("with_betas", [False, True])
def test_turning_the_world_turns_the_vertices(with_betas):
    """Of a whole body: posing and then turning equals turning the parameters and then posing."""
    away = np.array([0.1, -0.4, 0.2])  # the bundled pelvis rests at the origin, SMPL-X's does not
    body = default_body()
    body = replace(body, v_template=body.v_template + away, joints=body.joints + away)
    betas = np.array([1.5, -2.0, 0.5]) if with_betas else None
    pelvis = body.rest(betas)[1][0]
    assert min(np.linalg.norm(pelvis), np.linalg.norm(pelvis - sequence().pelvis)) > 0.1
    made = sequence(4, up_axis="z", betas=betas)
    turned = made.to_y_up(pelvis)
    assert turned.up_axis == "y"
    before = body.pose(made.poses, made.transl, betas)
    after = body.pose(turned.poses, turned.transl, betas)
    np.testing.assert_allclose(after, np.stack([before[..., 0], before[..., 2], -before[..., 1]], -1), atol=1e-6)
    back = turned.to_z_up(pelvis)
    np.testing.assert_allclose(body.pose(back.poses, back.transl, betas), before, atol=1e-6)


def test_slicing_keeps_the_speed():
    made = sequence(9)
    half = made[2:9:2]
    assert (len(half), half.fps) == (4, 15.0)
    np.testing.assert_array_equal(half.poses, made.poses[2:9:2])
    with pytest.raises(CaphyError, match="forward in time"):
        _ = made[::-1]
    with pytest.raises(CaphyError, match="at least one frame"):
        _ = made[20:]


def test_joining_needs_agreement():
    a, b = sequence(3, notes=("one",)), sequence(4, 1, notes=("one", "two"))
    joined = concatenate([a, b])
    assert len(joined) == 7
    assert joined.notes == ("one", "two")
    with pytest.raises(CaphyError, match=r"fps is 30\.0 and 60\.0"):
        concatenate([a, b.resample(60.0)])
    with pytest.raises(CaphyError, match="different bodies"):
        concatenate([a, sequence(3, pelvis=(0.0, 0.0, 0.0))])


def test_jumps_are_found_with_frame_and_joint():
    still = np.zeros((6, 55, 3))
    still[3:, 19, 0] = 3.0  # 90 rad/s at 30 Hz
    moved = np.zeros((6, 3))
    moved[5] = [0.5, 0, 0]  # 15 m/s
    made = PoseSequence(still, moved, 30.0, source="clip")
    found = made.jumps()
    assert [(j.frame, j.joint, j.unit) for j in found] == [(3, "right_elbow", "rad/s"), (5, "root", "m/s")]
    assert found[0].speed == pytest.approx(90.0)
    assert found[1].speed == pytest.approx(15.0)
    with pytest.raises(CaphyError, match=r"clip.*frame 3: right_elbow"):
        made.require_continuous()
    wrapped = np.zeros((2, 55, 3))
    wrapped[:, 0, 1] = [np.pi - 0.01, -np.pi + 0.01]  # the same heading, written on two sides of pi
    assert not PoseSequence(wrapped, np.zeros((2, 3)), 30.0).jumps()


def test_frames_that_nobody_saw_stay_known():
    unseen = np.array([False, False, True, False])
    told = PoseSequence(np.zeros((4, 55, 3)), np.zeros((4, 3)), 10.0, unseen=unseen)
    assert told[1:].unseen.tolist() == [False, True, False]
    assert told[::2].unseen.tolist() == [False, True]
    assert told.resample(20.0).unseen.tolist() == [False, False, False, True, True, False, False]
    whole = replace(told, unseen=None)
    assert concatenate([whole, told]).unseen.tolist() == [False] * 4 + unseen.tolist()
    assert concatenate([whole, whole]).unseen is None
    with pytest.raises(CaphyError, match="unseen must tell of each of 4 frames"):
        replace(told, unseen=unseen[:3])
