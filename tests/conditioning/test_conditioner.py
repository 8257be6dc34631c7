"""What a conditioner makes of noise, clocks, jumps and limits, against the true motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caphy.conditioning import Conditioner, Conditioning, Did, condition, condition_sequence
from caphy.conditioning.quaternions import between, exponential, logarithm, product
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import read_poses
from caphy.io.poses.ground import world_joints

KNEE, ELBOW = JOINT_NAMES.index("left_knee"), JOINT_NAMES.index("left_elbow")

OTHER = {"left": "right", "right": "left"}
OTHER_SIDE = [
    JOINT_NAMES.index("_".join([OTHER.get(n.split("_")[0], n.split("_")[0]), *n.split("_")[1:]])) for n in JOINT_NAMES
]


def stacked(frames):
    return np.array([f.time for f in frames]), np.array([f.poses for f in frames]), np.array([f.transl for f in frames])


def apart(a, b):
    """Angles [degrees] between rotation vectors."""
    return np.degrees(np.linalg.norm(between(exponential(a), exponential(b)), axis=-1))


def positions(poses, transl, walking, body):
    return world_joints(replace(walking, poses=poses, transl=transl), body.joints)[1][:, :22]


def test_noise_of_six_degrees_shakes_five_times_less(walking, shaken, body):
    times = np.arange(len(walking)) / 30
    found, poses, transl = stacked(condition(Conditioner(), times, shaken, walking.transl))
    assert found == pytest.approx(times)
    truth, raw, made = (
        positions(p, t, walking, body)
        for p, t in ((walking.poses, walking.transl), (shaken, walking.transl), (poses, transl))
    )
    roughness = [np.sqrt((np.diff(x - truth, 2, axis=0)[5:] ** 2).sum(-1).mean()) for x in (raw, made)]
    assert roughness[0] > 5 * roughness[1]
    errors = [np.linalg.norm(x - truth, axis=-1).mean() for x in (raw, made)]
    assert errors[1] < 0.7 * errors[0]


def test_frame_by_frame_is_the_whole_file(walking, shaken):
    conditioner = Conditioner(Conditioning(frame="world"))
    frames = []
    for i in range(len(walking)):
        frames += conditioner.push(i / walking.fps, shaken[i], walking.transl[i])
    frames += conditioner.flush()
    pelvis = conditioner.body.joints[0]
    whole = condition_sequence(replace(walking, poses=shaken, pelvis=pelvis), Conditioner())
    _, poses, transl = stacked(frames)
    assert np.array_equal(whole.poses, poses)
    assert np.allclose(whole.transl, transl, atol=1e-12)


@pytest.mark.parametrize("latency", [0.0, 0.06, 0.2])
def test_a_frame_comes_when_stated_and_knows_no_more(walking, shaken, latency):
    """Frames come as soon as time has gone on by the latency, and do not change with what is seen afterwards."""
    one, other = (Conditioner(Conditioning(latency=latency)) for _ in range(2))
    for i in range(60):
        for frame in one.push(i / 30, shaken[i], walking.transl[i]):
            assert i / 30 - 1 / 30 < frame.time + latency <= i / 30 + 1e-6
    first = condition(other, np.arange(40) / 30, shaken[:40], walking.transl[:40])
    again = Conditioner(Conditioning(latency=latency))
    second = condition(again, np.arange(80) / 30, shaken[:80], walking.transl[:80])
    count = int((39 / 30 - latency) * 30 + 1e-6) + 1
    assert all(np.array_equal(a.poses, b.poses) for a, b in zip(first[:count], second[:count], strict=True))


def test_time_stamps_count_and_not_the_number_of_poses(walking):
    """A joint that turns steadily is seen at uneven times, some of them missed: it still turns steadily."""
    rng = np.random.default_rng(1)
    times = np.cumsum(np.where(rng.random(90) < 0.25, 2, 1) / 30 + rng.uniform(-0.01, 0.01, 90))
    poses = np.zeros((90, 55, 3))
    poses[:, ELBOW, 1] = -0.2 - 0.3 * (times - times[0])
    frames = condition(Conditioner(), times, poses, np.outer(times, [1.0, 0, 0]))
    found, poses, transl = stacked(frames)
    assert np.diff(found) == pytest.approx(1 / 30)
    assert len(found) == int((times[-1] - times[0]) * 30 + 1e-6) + 1
    later = slice(16, None)  # at first it is taken to have stood
    assert poses[later, ELBOW, 1] == pytest.approx(-0.2 - 0.3 * (found[later] - times[0]), abs=1e-3)
    assert transl[later, 0] == pytest.approx(found[later], abs=1e-3)


@pytest.mark.parametrize("rate", [10.0, 25.0, 60.0, 119.88])
def test_other_rates_become_the_models(walking, rate):
    seen = walking.resample(rate)
    frames = condition(Conditioner(), np.arange(len(seen)) / rate, seen.poses, seen.transl)
    found, poses, _ = stacked(frames)
    truth = walking.resample(30.0).poses[: len(found)]
    assert len(found) == int(seen.duration * 30 + 1e-6) + 1
    assert np.median(apart(poses, truth)[:, 1:22]) < 2.0


def flip(kind, pose):
    pose = pose.copy()
    if kind == "turned round":
        pose[0] = logarithm(product(np.array([0.0, 0.0, 1.0, 0.0]), exponential(pose[0])))
    elif kind == "legs bent forward":
        pose[[1, 2], 0] -= 1.6
    else:
        pose = pose[OTHER_SIDE] * [1, -1, -1]
        pose[0] = logarithm(product(np.array([0.0, 0.0, 1.0, 0.0]), exponential(pose[0])))
    return pose


@pytest.mark.parametrize("kind", ["turned round", "legs bent forward", "left and right exchanged"])
def test_a_flip_is_not_believed(walking, kind):
    poses = walking.poses.copy()
    wrong = [40, 41, 90]
    for i in wrong:
        poses[i] = flip(kind, poses[i])
    conditioner = Conditioner()
    times = np.arange(len(walking)) / 30
    frames = condition(conditioner, times, poses, walking.transl)
    clean = condition(Conditioner(), times, walking.poses, walking.transl)
    worst = max(apart(a.poses, b.poses)[:22].max() for a, b in zip(frames, clean, strict=True))
    assert worst < 12
    assert sum(bool(f.did & Did.REJECTED) for f in frames) >= 2
    assert sum(conditioner.summary.refused.values()) == len(wrong)
    assert any("jump" in note for f in frames for note in f.notes)
    assert not any(f.did & Did.REJECTED for f in clean)


def test_what_lasts_is_believed_in_the_end(walking):
    """A body that is suddenly found turned by a third of a turn is approached, quickly but not at once."""
    poses = np.repeat(walking.poses[:1], 90, axis=0)
    poses[30:, 0] = [0.0, 2.0, 0.0]
    frames = condition(Conditioner(), np.arange(90) / 30, poses, np.zeros((90, 3)))
    _, made, _ = stacked(frames)
    assert apart(made[-1], poses[-1]).max() < 0.5
    assert apart(made[33], poses[0])[0] < 1.0
    assert apart(made[50], poses[-1])[0] < 1.0


def test_a_knee_does_not_bend_forward():
    poses = np.zeros((30, 55, 3))
    poses[:, KNEE, 0] = np.linspace(0, -1.5, 30)
    frames = condition(Conditioner(), np.arange(30) / 30, poses, np.zeros((30, 3)))
    bend = np.array([f.poses[KNEE, 0] for f in frames])
    assert bend.min() > -0.75
    assert np.abs(np.diff(bend, 2)).max() < 0.1  # brought back gently
    assert not frames[2].did & Did.LIMITED
    assert frames[-3].did & Did.LIMITED
    assert any("left_knee" in note for note in frames[-3].notes)


def test_true_motions_are_within_limits_and_continuous(walking):
    frames = condition(Conditioner(), np.arange(len(walking)) / 30, walking.poses, walking.transl)
    assert not any(f.did & ~Did.RESET for f in frames)
    assert [bool(f.did & Did.RESET) for f in frames] == [True] + [False] * (len(frames) - 1)


def test_captured_motions_are_believed(shared_data):
    """Of a real walk and a real climb nothing is taken for a flip, and hardly anything for impossible."""
    for name in ("02_01", "01_01"):
        clip = read_poses(shared_data / "cmu_mocap" / "bvh" / f"{name}.bvh").resample(30.0)[:200]
        conditioner = Conditioner()
        frames = condition(conditioner, np.arange(len(clip)) / 30, clip.poses, clip.transl)
        assert not conditioner.summary.refused
        assert sum(bool(f.did & Did.LIMITED) for f in frames) < 0.05 * len(frames)
        _, poses, _ = stacked(frames)
        assert np.median(apart(poses, clip.poses[: len(frames)])[:, :22]) < 2.0


def test_what_is_no_number_is_refused_and_said(walking):
    conditioner = Conditioner()
    frames = conditioner.push(0.0, walking.poses[0], walking.transl[0])
    bad = walking.poses[1].copy()
    bad[KNEE] = np.nan
    frames += conditioner.push(1 / 30, bad, [np.inf, 0, 0])
    frames += conditioner.push(np.nan, walking.poses[1], walking.transl[1])
    frames += conditioner.push(1 / 30, walking.poses[1], walking.transl[1])
    for i in range(2, 30):
        frames += conditioner.push(i / 30, walking.poses[i], walking.transl[i])
    assert conditioner.summary.refused["time stamp"] == 2
    assert sum("does not come after" in note for f in frames for note in f.notes) == 2
    assert all(np.isfinite(f.poses).all() and np.isfinite(f.transl).all() for f in frames)
    assert len(frames) == 28


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0, np.zeros((54, 3))), r"\(55, 3\)"),
        ((0.0, np.zeros((55, 3)), np.zeros(2)), "transl"),
        ((0.0, np.zeros((55, 3)), None, np.ones(3)), "confidence"),
        ((0.0, np.zeros((55, 3)), None, 2.0), "confidence must lie between 0, not seen, and 1, sure, got 2$"),
        ((0.0, np.zeros((55, 3)), None, np.where(np.arange(55) == 18, np.inf, 1)), r"got inf at joint 18 \(left_elbow"),
        ((0.0, np.zeros((55, 3)), None, None, np.ones((3, 3))), "rotation"),
    ],
)
def test_wrong_shapes_are_errors(arguments, words):
    with pytest.raises(CaphyError, match=words):
        Conditioner(Conditioning(frame="camera")).push(*arguments)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"cutoff": -1}, "cutoff must lie"),
        ({"cutoff": float("nan")}, "cutoff must lie"),
        ({"latency": "soon"}, "latency must lie"),
        ({"speed": 3}, "no setting 'speed'"),
        ({"frame": "moon"}, "frame must be one of"),
        ({"up": [0, 0, 0], "frame": "camera"}, "up must be a direction"),
        ({"up": [0, 1, 0]}, "set frame"),
        ({"floor": 1}, "floor must be true or false"),
        ([], "table of settings"),
    ],
)
def test_wrong_settings_are_errors(given, words):
    with pytest.raises(CaphyError, match=words):
        Conditioning.of(given)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(-1.0, 3.0) | st.sampled_from([np.nan, np.inf]),
            st.integers(0, 2**32 - 1),
            st.sampled_from(["pose", "nobody", "half", "wild"]),
        ),
        min_size=1,
        max_size=25,
    ),
    st.sampled_from(["world", "camera"]),
    st.sampled_from(["given", "feet"]),
)
def test_whatever_comes_frames_are_finite_and_in_time(steps, frame, translation):
    conditioner = Conditioner(Conditioning(frame=frame, translation=translation, floor=True, scale=None), longest=2.0)
    time, frames = 0.0, []
    for step, seed, kind in steps:
        rng = np.random.default_rng(seed)
        time = time + step if np.isfinite(step) else time
        poses = rng.normal(size=(55, 3)) * (50.0 if kind == "wild" else 0.5)
        trust = (rng.random(55) < 0.5).astype(float) if kind == "half" else None
        scale = 500.0 if kind == "wild" else 1.0
        frames += conditioner.push(
            step if not np.isfinite(step) else time,
            None if kind == "nobody" else poses,
            rng.normal(size=3) * scale,
            trust,
        )
    frames += conditioner.flush()
    assert all(np.isfinite(f.poses).all() and np.isfinite(f.transl).all() for f in frames)
    assert all(np.linalg.norm(f.poses, axis=-1).max() <= np.pi + 1e-9 for f in frames)
    assert np.all(np.diff([f.time for f in frames]) > 0)


@pytest.mark.parametrize(("rate", "latency"), [(30.0, 1.0), (30.0, 0.06), (120.0, 0.2), (240.0, 0.06)])
def test_a_steady_motion_is_followed_at_any_rate_and_latency(rate, latency):
    """A metre and a radian a second: what is shown is of its own moment, and not of the oldest that is remembered."""
    conditioner, frames = Conditioner(Conditioning(latency=latency)), []
    for i in range(round(2.5 * rate)):
        pose = np.zeros((55, 3))
        pose[0, 1] = i / rate
        frames += conditioner.push(i / rate, pose, np.array([i / rate, 0.0, 0.0]))
    late = [frame for frame in frames if frame.time > 1.2]
    assert len(late) > 5
    assert max(abs(frame.transl[0] - frame.time) for frame in late) < 2e-3
    assert max(abs(frame.poses[0, 1] - frame.time) for frame in late) < 2e-3


@pytest.mark.parametrize("fps", [2.0, 4.0])
def test_few_poses_a_second_of_a_file_are_no_steps(walking, fps):
    """In a stream nobody knows what comes after a gap so long; in a file one does."""
    few = walking.resample(fps)
    made = condition_sequence(few, Conditioner())
    assert made.fps == 30.0 and any(f"{fps:g} poses a second are few" in note for note in made.notes)
    turned = np.abs(np.diff(made.poses[:, 16], axis=0)).max()
    steps = np.abs(np.diff(made.poses[:, 16], axis=0)).max(axis=1)
    between = np.abs(np.diff(few.resample(30.0).poses[:, 16], axis=0)).max(axis=1)
    assert turned < 1.2 * between.max() and np.mean(steps < 0.05 * between.max()) < 0.5  # neither leaps nor rests
    assert len(made) == len(few.resample(30.0))
