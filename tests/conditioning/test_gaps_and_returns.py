"""People who are lost and found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.conditioning import Conditioner, Conditioning, Did, condition, condition_sequence
from caphy.conditioning.quaternions import between, exponential, heading, logarithm
from caphy.conditioning.standing import standing_pose
from caphy.conventions import JOINT_NAMES
from caphy.io.poses import PoseSequence

ELBOW, KNEE = JOINT_NAMES.index("left_elbow"), JOINT_NAMES.index("left_knee")
RATE = 30.0


def watched(seen, count, pose, place, **settings):
    """Frames of ``count`` moments at 30 Hz; ``seen(i)`` tells whether anybody is, ``pose(i)`` and ``place(i)`` how."""
    poses = np.array([pose(i) for i in range(count)])
    transl = np.array([place(i) for i in range(count)], float)
    trust = np.array([float(seen(i)) for i in range(count)])
    conditioner = Conditioner(Conditioning(**settings))
    return condition(conditioner, np.arange(count) / RATE, poses, transl, trust), conditioner


def crouching(turn=0.0):
    pose = np.zeros((55, 3))
    pose[0, 1] = turn
    pose[[1, 2], 0], pose[[4, 5], 0] = -1.0, 1.6
    pose[ELBOW, 1] = -1.2
    return pose


def steps(frames):
    """Largest turn of a joint [degrees] and step of the root [m] between frames."""
    turns = exponential(np.array([f.poses for f in frames]))
    places = np.array([f.transl for f in frames])
    turned = np.linalg.norm(between(turns[:-1], turns[1:]), axis=-1)
    return np.degrees(turned), np.linalg.norm(np.diff(places, axis=0), axis=-1)


def soles(frame, body):
    return (body.soles(exponential(frame.poses)) + body.joints[0] + frame.transl)[:, 1].min()


def test_held_then_standing_then_anew_elsewhere(body):
    """Lost for four seconds while crouching, found 3 m away, facing elsewhere."""
    gone = range(30, 150)
    frames, conditioner = watched(
        lambda i: i not in gone,
        200,
        lambda i: crouching(0.3 if i < 100 else 2.5),
        lambda i: (0, 0.1, 0) if i < 100 else (3, 0.1, 0),
    )
    did = [f.did for f in frames]
    assert len(frames) == 200
    assert all(Did.HELD in d for d in did[30:39])
    assert np.abs(frames[38].poses - frames[29].poses).max() < 0.02
    assert all(Did.RESTING in d for d in did[40:150])
    standing = standing_pose()
    standing[0] = heading(exponential(frames[29].poses[0]))
    assert np.linalg.norm(between(standing, exponential(frames[149].poses)), axis=-1).max() < 1e-6
    assert soles(frames[149], body) == pytest.approx(soles(frames[29], body), abs=0.02)
    assert frames[149].transl[[0, 2]] == pytest.approx([0, 0], abs=1e-6)
    resets = [i for i, d in enumerate(did) if Did.RESET in d]
    assert resets == [0, 150]
    turned, moved = steps(frames)
    assert np.delete(turned, 149, axis=0).max() < 13  # 6 rad/s
    assert np.delete(moved, 149).max() < 0.07
    assert turned[149, 1:].max() < 2  # joints go on from standing, only the root is elsewhere
    assert frames[150].transl[0] == pytest.approx(3)
    assert np.linalg.norm(between(exponential(crouching(2.5)), exponential(frames[-1].poses)), axis=-1).max() < 0.01
    assert conditioner.summary.as_json()["refused"] == {"nobody": 120}
    assert conditioner.summary.as_json()["frames"]["reset"] == 2


def test_a_short_gap_is_no_new_beginning():
    """Lost for half a second while walking on: approached, not jumped to, and the garment goes on."""
    frames, _ = watched(lambda i: not 40 <= i < 55, 110, lambda i: crouching(0.01 * i), lambda i: (0.02 * i, 0, 0))
    assert [i for i, f in enumerate(frames) if Did.RESET in f.did] == [0]
    turned, moved = steps(frames)
    assert moved.max() < 0.09  # 2 m/s, and what it walks
    assert turned.max() < 13
    assert frames[-1].transl[0] == pytest.approx(0.02 * 109, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_dropped_poses_leave_no_trace(walking, seed):
    kept = np.random.default_rng(seed).random(len(walking)) > 0.2
    kept[0] = True
    times = np.arange(len(walking)) / RATE
    sparse = condition(Conditioner(), times[kept], walking.poses[kept], walking.transl[kept])
    dense = condition(Conditioner(), times, walking.poses, walking.transl)
    apart = [
        np.degrees(np.linalg.norm(between(exponential(a.poses), exponential(b.poses)), axis=-1))
        for a, b in zip(sparse, dense, strict=False)
    ]
    assert np.median(apart) < 0.5
    assert np.max(apart) < 25
    assert np.median([np.linalg.norm(a.transl - b.transl) for a, b in zip(sparse, dense, strict=False)]) < 0.01


def test_a_hidden_arm_is_held_and_then_hangs():
    poses = np.repeat(crouching()[None], 90, axis=0)
    trust = np.ones((90, 55))
    trust[30:, ELBOW] = 0.0
    frames = condition(Conditioner(), np.arange(90) / RATE, poses, np.zeros((90, 3)), trust)
    assert all(Did.PART_HELD in f.did for f in frames[30:])
    assert not any(f.did & (Did.HELD | Did.RESTING) for f in frames)
    assert frames[36].poses[ELBOW] == pytest.approx(crouching()[ELBOW], abs=0.02)
    hanging = between(standing_pose()[ELBOW], exponential(frames[-1].poses[ELBOW]))
    assert np.linalg.norm(hanging) < 1e-6
    assert frames[-1].poses[KNEE] == pytest.approx(crouching()[KNEE], abs=1e-6)


def test_hands_and_face_that_nobody_saw_rest():
    rng = np.random.default_rng(0)
    trust = np.ones(55)
    trust[22:] = 0.0
    conditioner = Conditioner()
    frames = [f for i in range(20) for f in conditioner.push(i / RATE, 0.3 * rng.normal(size=(55, 3)), None, trust)]
    assert all(not f.poses[22:].any() for f in frames)


def test_nobody_at_all_makes_no_frames():
    frames, conditioner = watched(lambda i: False, 30, lambda i: crouching(), lambda i: (0, 0, 0))
    assert frames == []
    assert conditioner.summary.as_json()["refused"] == {"nobody": 30}


def test_a_cut_in_the_film_begins_anew():
    """Another place and another pose from one frame to the next: not believed for a moment, then begun anew."""
    frames, _ = watched(
        lambda i: True, 120, lambda i: crouching(0.0 if i < 60 else 3.0), lambda i: (0, 0, 0) if i < 60 else (4, 0, 1)
    )
    resets = [i for i, f in enumerate(frames) if Did.RESET in f.did]
    assert len(resets) == 2
    assert 60 <= resets[1] < 90
    _, moved = steps(frames)
    assert np.delete(moved, resets[1] - 1).max() < 0.07
    assert frames[-1].transl == pytest.approx([4, 0, 1], abs=0.01)


def test_a_leap_of_the_clock_is_left_out():
    conditioner = Conditioner(longest=5.0)
    frames = []
    for i in range(60):
        frames += conditioner.push(i / RATE + (1000.0 if i >= 30 else 0.0), crouching(), np.zeros(3))
    frames += conditioner.flush()
    assert len(frames) < 62
    assert any("time went on by 1000" in note for f in frames for note in f.notes)
    turned, _ = steps(frames)
    assert turned.max() < 1


@pytest.mark.parametrize("latency", [0.0, 0.06, 0.5, 1.0])
def test_what_was_seen_just_before_a_leap_comes_out(latency):
    times = np.r_[np.arange(30), np.arange(30) + 400] / RATE
    frames = condition(
        Conditioner(Conditioning(latency=latency)), times, np.repeat(crouching()[None], 60, 0), np.zeros((60, 3))
    )
    assert [f.time for f in frames] == pytest.approx(times)


@pytest.mark.parametrize("latency", [0.0, 0.06])
def test_somebody_found_far_off_for_a_single_pose_begins_anew(latency):
    """A detector that flickers: one pose, nobody for three pictures, then steadily; between frames."""
    conditioner, frames = Conditioner(Conditioning(latency=latency)), []
    for i in range(180):
        seen, time = i < 30 or i == 81 or i >= 85, i / RATE + 0.013 * (i > 0)
        frames += conditioner.push(time, crouching() if seen else None, np.array([2.0, 0.0, 2.0]) * (i >= 60))
    frames += conditioner.flush()
    leap = int(steps(frames)[1].argmax())
    assert steps(frames)[1][leap] > 2
    assert frames[leap + 1].did & Did.RESET


def test_a_place_that_becomes_known_late_is_gone_to_or_begins_anew():
    for away, anew in ((0.3, False), (5.0, True)):
        conditioner, frames = Conditioner(Conditioning()), []
        for i in range(90):
            frames += conditioner.push(i / RATE, crouching(), None if i < 30 else np.array([away, 0.0, 0.0]))
        frames += conditioner.flush()
        step = steps(frames)[1]
        assert bool(frames[int(step.argmax()) + 1].did & Did.RESET) == anew
        assert (step.max() < 0.5 * away) != anew
        assert abs(frames[-1].transl[0] - frames[0].transl[0] - away) < 0.01


def test_frames_that_a_file_lacks_are_gaps_as_in_a_stream(body):
    """Somebody stands still, is lost for two seconds and found three metres on: nobody is seen to glide there."""
    count, gap = 150, slice(50, 100)
    poses = np.tile(logarithm(standing_pose()), (count, 1, 1))
    transl = np.where(np.arange(count)[:, None] < 100, [0.0, 0.0, 0.0], [3.0, 0.0, 0.0])
    transl[gap] = np.linspace(0, 1, 50)[:, None] * [3.0, 0.0, 0.0]  # as a reader fills them
    unseen = np.zeros(count, bool)
    unseen[gap] = True
    told = PoseSequence(poses, transl, 25.0, pelvis=body.joints[0], unseen=unseen)
    conditioner = Conditioner()
    made = condition_sequence(told, conditioner)
    assert made.unseen is None and len(made) == 179
    at = np.arange(len(made)) / made.fps
    lost = made.transl[(at > 2.2) & (at < 3.8), 0]
    assert np.abs(lost).max() < 0.05
    assert conditioner.summary.frames["held"] > 0 and conditioner.summary.refused["nobody"] == 50
    glides = condition_sequence(replace(told, unseen=None), Conditioner())
    assert np.ptp(glides.transl[(at > 2.2) & (at < 3.8), 0]) > 1
