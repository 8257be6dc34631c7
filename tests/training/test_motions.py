"""Motions, their mirror images and speeds, and the windows that streams play."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_world import swaying

from caphy.body.bundled import default_body
from caphy.body.kinematics import joint_positions, joint_transforms
from caphy.cli import main
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, write_poses
from caphy.io.poses.parts import file_of, part, read_part
from caphy.network.features import pose_features, rest_state
from caphy.rotations import matrix_from_axis_angle
from caphy.training.motions import Motions, continuous_parts, find_poses, mirrored, varied
from caphy.training.streams import LONGEST, WINDOW, Streams, Windows, segment

DRIVING = [1, 2, 3, 16, 17]


@pytest.fixture(scope="module")
def motions() -> Motions:
    return Motions.of([swaying(60, 0), swaying(17, 1), swaying(3, 2)], default_body(), DRIVING, 30.0)


def places(sequence: PoseSequence) -> np.ndarray:
    joints = symmetric_joints()
    transforms = joint_transforms(matrix_from_axis_angle(sequence.poses), joints, default_body().parents)
    return joint_positions(transforms, joints) + sequence.transl[:, None]


def symmetric_joints() -> np.ndarray:
    joints = default_body().joints.copy()
    for name in JOINT_NAMES:
        if name.startswith("left"):
            left, right = JOINT_NAMES.index(name), JOINT_NAMES.index(name.replace("left", "right"))
            joints[right] = joints[left] * [-1, 1, 1]
        elif not name.startswith("right"):
            joints[JOINT_NAMES.index(name), 0] = 0
    return joints


def test_mirror_image_of_a_motion():
    random = np.random.default_rng(0)
    sequence = PoseSequence(
        random.normal(scale=0.4, size=(4, 55, 3)), random.normal(size=(4, 3)), 30.0, pelvis=symmetric_joints()[0]
    )
    swap = {"left": "right", "right": "left"}
    sides = [name.split("_", 1) for name in JOINT_NAMES]
    partner = [JOINT_NAMES.index("_".join([swap.get(side, side), *rest])) for side, *rest in sides]
    np.testing.assert_allclose(places(mirrored(sequence)), places(sequence)[:, partner] * [-1, 1, 1], atol=1e-12)


def test_speeds_and_sides():
    clips = varied(swaying(61), 30.0, (0.5, 2.0))
    assert [len(clip) for clip in clips] == [121, 31, 121, 31]
    np.testing.assert_allclose(clips[1].poses, swaying(61).poses[::2], atol=1e-12)


def test_a_tracking_error_cuts_a_clip():
    poses = swaying(90).poses.copy()
    poses[40:, 16, 0] += 3.0
    parts = continuous_parts(PoseSequence(poses, np.zeros((90, 3)), 30.0, source="clip"))
    assert [len(part) for part in parts] == [40, 50] and parts[1].source == "clip#40-90"
    assert continuous_parts(swaying(9))[0].source == "swaying 0"


def test_motions_that_are_all_jumps_are_refused_and_none_made_up(tmp_path, capsys):
    clip = swaying(24)
    transl = clip.transl + 3.0 * (np.arange(24) >= 12)[:, None]
    write_poses(replace(clip, transl=transl), tmp_path / "jump.npz")
    assert main(["train", "tshirt", str(tmp_path / "jump.npz"), "--steps", "1", "-o", str(tmp_path / "out")]) == 2
    assert "jump.npz: steps too fast for a body leave no half second of motion" in capsys.readouterr().err


def test_a_part_is_known_by_its_frames(tmp_path):
    path = tmp_path / "walk.npz"
    write_poses(swaying(90), path)
    whole = read_part(str(path))
    inner = part(part(whole, 20, 80), 10, 200)
    assert inner.source == f"{path}#30-80" and file_of(inner.source) == str(path) == whole.source
    np.testing.assert_array_equal(read_part(inner.source).poses, whole.poses[30:80])
    assert read_part(inner.source).source == inner.source
    with pytest.raises(CaphyError, match="must have the frames 30 to 90 that were asked for, has 90"):
        read_part(f"{path}#30-91")


def test_poses_of_a_camera_are_not_trained_on(tmp_path):
    write_poses(replace(swaying(9), frame="camera"), tmp_path / "film.npz")
    with pytest.raises(CaphyError, match=r"film\.npz: these poses are in a camera's frame"):
        find_poses([tmp_path])


def test_finds_pose_files_in_folders(tmp_path):
    (tmp_path / "deep").mkdir()
    write_poses(swaying(5), tmp_path / "deep" / "b.npz")
    write_poses(swaying(7), tmp_path / "a.npz")
    assert [len(clip) for clip in find_poses([tmp_path])] == [7, 5]
    with pytest.raises(CaphyError, match="no pose file"):
        (tmp_path / "empty").mkdir()
        find_poses([tmp_path / "empty"])


def test_shapes_among_motions_are_passed_over_and_named(tmp_path):
    """As a folder of AMASS has them."""
    write_poses(swaying(7), tmp_path / "walk_stageii.npz")
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16), gender="neutral")
    said: list[str] = []
    assert [len(clip) for clip in find_poses([tmp_path], said.append)] == [7]
    assert len(said) == 1 and "shape.npz" in said[0] and "without poses" in said[0]
    with pytest.raises(CaphyError, match=r"shape\.npz"):
        find_poses([tmp_path / "shape.npz"])
    (tmp_path / "walk_stageii.npz").write_bytes(b"PK damaged")
    with pytest.raises(CaphyError, match=r"walk_stageii\.npz"):
        find_poses([tmp_path], said.append)


def test_files_without_a_frame_rate_are_passed_over_and_named(tmp_path):
    write_poses(swaying(7), tmp_path / "a.npz")
    (tmp_path / "01_01.amc").write_text("whatever")
    said: list[str] = []
    assert [len(clip) for clip in find_poses([tmp_path], said.append)] == [7]
    assert len(said) == 1 and "01_01.amc" in said[0] and "--fps" in said[0]
    with pytest.raises(CaphyError, match=r"01_01\.amc.*poses convert"):
        find_poses([tmp_path / "01_01.amc"])
    (tmp_path / "a.npz").unlink()
    with pytest.raises(CaphyError, match="do not say their frame rate"):
        find_poses([tmp_path])


def test_segments_stay_inside_their_clip(motions):
    for number in range(300):
        part = segment(motions, 3, 1, number)
        last = part.first + (0 if part.held else part.windows * WINDOW - 1)
        clip = np.searchsorted(motions.starts, part.first, side="right") - 1
        assert motions.starts[clip] <= part.first - (not part.held) and last < motions.starts[clip + 1]
        assert 1 <= part.windows <= LONGEST


def test_windows_follow_on_from_one_another(motions):
    streams, last = Streams(motions, 5, 0), None
    kinds = set()
    for _ in range(60):
        now = streams.advance()
        for i in range(5):
            kinds.add((bool(now.fresh[i]), bool(now.held[i])))
            step = 0 if now.held[i] else 1
            assert (np.diff(now.frames[i]) == step).all() and now.before[i] == now.frames[i, 0] - step
            if last is not None and not now.fresh[i]:
                assert now.before[i] == last.frames[i, -1]
        last = now
    assert len(kinds) == 4


def test_streams_continue_where_they_were_saved(motions):
    first = Streams(motions, 6, 7)
    for _ in range(11):
        first.advance()
    second = Streams(motions, 6, 7)
    second.restore(first.place)
    for _ in range(30):
        one, two = first.advance(), second.advance()
        for name in ("frames", "before", "fresh", "held", "scored"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(Streams(motions, 6, 8).advance().frames, Streams(motions, 6, 7).advance().frames)


def test_windows_show_what_a_stream_would_see(motions):
    """Features of fresh, running and held windows equal those of the streaming form started afresh."""
    frames = np.array([np.arange(10, 15), np.arange(10, 15), np.full(5, 10)])
    windows = Windows(
        frames,
        np.array([9, 9, 10]),
        np.array([True, False, False]),
        np.array([False, False, True]),
        np.zeros((3, 1), int),
    )
    seen = windows.features(motions)

    def streamed(index: np.ndarray) -> torch.Tensor:
        rotations = torch.tensor(matrix_from_axis_angle(motions.poses[index]))
        transl = torch.tensor(motions.transl[index])
        return pose_features(rotations, transl, rest_state(transl), DRIVING, 30.0)[0].float()

    torch.testing.assert_close(seen[0], streamed(frames[0]))
    torch.testing.assert_close(seen[1], streamed(np.arange(15))[10:])
    torch.testing.assert_close(seen[2], streamed(frames[2]))
