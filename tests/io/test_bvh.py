"""BVH files against forward kinematics written out as plain loops, and whatever else a file may hold."""

import random
import re

import numpy as np
import pytest
from cmu_skeleton import bvh_text, random_angles, root_path, rotation
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.poses.bvh import read_bvh


def plain_joint_positions(text: str, frame: int) -> dict[str, list[float]]:
    """World position of every joint: a second reader, token by token, in scalar arithmetic."""
    head, motion = text.split("MOTION")
    values = iter([float(x) for x in motion.strip().splitlines()[2 + frame].split()])
    tokens = re.findall(r"\S+", head)
    positions, stack, joint = {}, [], None
    at = 0
    while at < len(tokens):
        word = tokens[at]
        if word in ("ROOT", "JOINT"):
            joint, at = tokens[at + 1], at + 1
        elif word == "End":
            joint, at = None, at + 1
        elif word == "{":
            parent = stack[-1] if stack else ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 0, 0])
            stack.append(parent)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            turn, place = stack[-1]
            offset = [float(x) for x in tokens[at + 1 : at + 4]]
            stack[-1] = (turn, [place[i] + sum(turn[i][k] * offset[k] for k in range(3)) for i in range(3)])
            at += 3
            if joint is not None:
                positions[joint] = stack[-1][1]
        elif word == "CHANNELS":
            count = int(tokens[at + 1])
            turn, place = stack[-1]
            for channel in tokens[at + 2 : at + 2 + count]:
                value = next(values)
                if channel.endswith("position"):
                    place = [place[i] + (value if "XYZ"[i] == channel[0] else 0.0) for i in range(3)]
                else:
                    by = rotation(channel[0], value)
                    turn = [[sum(turn[i][k] * by[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
            stack[-1] = (turn, place)
            positions[joint] = place
            at += 1 + count
        at += 1
    return positions


@pytest.mark.parametrize("max_names", [False, True])
def test_positions_agree_with_plain_loops(tmp_path, max_names):
    text = bvh_text(random_angles(np.random.default_rng(1), 5, 70.0), root_path(5), max_names=max_names)
    (tmp_path / "a.bvh").write_text(text)
    motion = read_bvh(tmp_path / "a.bvh")
    _, positions = motion.world()
    for frame in (0, 4):
        expected = plain_joint_positions(text, frame)
        assert set(expected) == set(motion.names)
        np.testing.assert_allclose(positions[frame], [expected[name] for name in motion.names], atol=1e-9)


@pytest.mark.parametrize("clip", ["bvh/01_01.bvh", "bvh/131_01.bvh", "bvh_from_expmap/train_jumping_jumping_3.bvh"])
def test_real_clips_agree_with_plain_loops(shared_data, clip):
    path = shared_data / "cmu_mocap" / clip
    motion = read_bvh(path)
    _, positions = motion.world()
    for frame in (0, 1, len(positions) - 1):
        expected = plain_joint_positions(path.read_text(), frame)
        np.testing.assert_allclose(positions[frame], [expected[name] for name in motion.names], atol=1e-9)


def test_printed_frame_times_mean_whole_rates(tmp_path):
    text = bvh_text(random_angles(np.random.default_rng(1), 2), root_path(2))
    for step, fps in (
        (".0083333", 120.0),
        ("0.008333", 120.0),
        ("0.033333", 30.0),
        ("0.04", 25.0),
        ("0.0333667", 1 / 0.0333667),
    ):
        (tmp_path / "a.bvh").write_text(re.sub(r"Frame Time: \S+", f"Frame Time: {step}", text))
        assert read_bvh(tmp_path / "a.bvh").fps == pytest.approx(fps, abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("Frames: 4", "Frames: 5", "says 5 frames but holds 4"),
        ("Frame Time: 0.0083333", "Frame Time: 0", "Frame Time must be between"),
        ("JOINT LowerBack", "JOINT LHipJoint", "appears twice"),
        ("JOINT LowerBack", "JOINT Tail", "joint layout is not the CMU skeleton's.*LowerBack"),
        ("OFFSET 0.000000000 2.000000000", "OFFSET 0.000000000 two", "OFFSET of .* must hold numbers"),
        ("CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 3 Zrotation Yrotation Wrotation", "must list up to six"),
        ("MOTION", "MOTIONS", "must begin with 'Frames:'"),
        ("MOTION", "", "must hold a HIERARCHY and a MOTION"),
    ],
)
def test_says_what_is_wrong(tmp_path, old, new, words):
    text = bvh_text(random_angles(np.random.default_rng(1), 4), root_path(4))
    assert old in text
    (tmp_path / "bad.bvh").write_text(text.replace(old, new, 1))
    with pytest.raises(CaphyError, match=f"(?s)bad.bvh.*{words}"):
        read_poses(tmp_path / "bad.bvh")


def test_says_where_a_number_is_missing_or_not_finite(tmp_path):
    text = bvh_text(random_angles(np.random.default_rng(1), 4), root_path(4))
    lines = text.splitlines()
    (tmp_path / "a.bvh").write_text("\n".join([*lines[:-2], lines[-2].rsplit(" ", 1)[0], lines[-1]]))
    with pytest.raises(CaphyError, match=r"frame 2 must hold \d+ values, got"):
        read_poses(tmp_path / "a.bvh")
    (tmp_path / "b.bvh").write_text("\n".join([*lines[:-1], "nan " + lines[-1].split(" ", 1)[1]]))
    with pytest.raises(CaphyError, match="frame 3 must hold finite numbers"):
        read_poses(tmp_path / "b.bvh")


TEXT = bvh_text(random_angles(np.random.default_rng(2), 3), root_path(3))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1))
def test_damaged_files_never_end_in_a_traceback(tmp_path, seed):
    """Cut, repeated, swapped and overwritten: the answer is a sequence or a CaphyError."""
    chance = random.Random(seed)
    words = re.split(r"(\s+)", TEXT)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(words))
        match chance.randrange(5):
            case 0:
                words = words[:at] or [""]
            case 1:
                words[at] = chance.choice(["{", "}", "JOINT", "End", "nan", "1e999", "-1", "", "\x00", "é", "9" * 400])
            case 2:
                del words[at]
            case 3:
                words.insert(at, chance.choice(words))
            case 4:
                other = chance.randrange(len(words))
                words[at], words[other] = words[other], words[at]
    path = tmp_path / "damaged.bvh"
    path.write_text("".join(words))
    try:
        assert isinstance(read_poses(path), PoseSequence)
    except CaphyError as error:
        assert "damaged.bvh" in str(error)


def test_binary_and_deeply_nested_files_are_refused(tmp_path):
    (tmp_path / "a.bvh").write_bytes(bytes(range(256)) * 10)
    (tmp_path / "b.bvh").write_text(
        "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 "
        + "".join(f"JOINT j{i} {{ OFFSET 0 0 0 CHANNELS 0 " for i in range(5000))
        + "}" * 5001
        + "\nMOTION\nFrames: 1\nFrame Time: 1\n0"
    )
    (tmp_path / "c.bvh").write_text("")
    for name in "abc":
        with pytest.raises(CaphyError, match=f"{name}.bvh"):
            read_poses(tmp_path / f"{name}.bvh")
