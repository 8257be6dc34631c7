"""Gravity, floor, scale and feet, against a motion whose world is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.conditioning import Body, Conditioner, Conditioning, condition, condition_sequence, condition_upright
from caphy.conditioning.body import bundled_body
from caphy.conditioning.quaternions import exponential, logarithm
from caphy.conditioning.standing import standing_pose
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.poses.camera import OPENCV_TO_Y_UP, level_camera
from caphy.io.poses.ground import sole_points, world_joints
from caphy.rotations import matrix_from_axis_angle

JOINTS = ("hip", "knee", "ankle")


@pytest.fixture(scope="module")
def tilted(walking):
    """World-to-camera rotation of a camera that looks down by 18 degrees and leans by 7."""
    lean = matrix_from_axis_angle(np.array([0.0, 0.0, np.radians(7)]))
    look = matrix_from_axis_angle(np.array([np.radians(18), 0.0, 0.0]))
    return lean @ look @ OPENCV_TO_Y_UP.T


def arrays(frames):
    return np.array([f.poses for f in frames]), np.array([f.transl for f in frames])


def up_found(conditioner, tilted):
    """Error [degrees] of the direction of up that was found, and what is stated."""
    world = conditioner.world()
    return np.degrees(np.arccos(np.clip(np.dot(world["up"], tilted[:, 1]), -1, 1))), world["up_error_degrees"]


def test_soles_are_those_of_the_pose_files(walking, body):
    expected = sole_points(walking, body.joints, body.sole)
    for i in (0, 60, 200):
        found = body.soles(exponential(walking.poses[i])) + body.joints[0] + walking.transl[i]
        assert found == pytest.approx(expected[i], abs=1e-9)


def test_chest_is_where_kinematics_puts_it(walking, body):
    _, positions = world_joints(walking, body.joints)
    found = body.chest(exponential(walking.poses[50])) + body.joints[0] + walking.transl[50]
    assert found == pytest.approx(positions[50, 9], abs=1e-9)


def test_gravity_from_the_motion_with_its_uncertainty(walking, body, tilted):
    seen = walking.turned(tilted)
    conditioner = Conditioner(Conditioning(frame="camera"))
    errors, stated = [], []
    for i in range(len(seen)):
        conditioner.push(i / 30, seen.poses[i], seen.transl[i])
        error, said = up_found(conditioner, tilted)
        errors.append(error)
        stated.append(said)
    assert errors[0] > 10
    assert errors[-1] < 5
    assert stated[0] > 2 * stated[-1] > 2.5
    assert errors[-1] < 3 * stated[-1]


def test_noise_does_not_turn_gravity(walking, shaken, tilted):
    seen = replace(walking, poses=shaken).turned(tilted)
    conditioner = Conditioner(Conditioning(frame="camera"))
    frames = condition(conditioner, np.arange(len(seen)) / 30, seen.poses, seen.transl)
    assert up_found(conditioner, tilted)[0] < 5
    trunk = matrix_from_axis_angle(arrays(frames)[0][-60:, 0])[:, 1, 1]
    assert np.degrees(np.arccos(trunk)).mean() < 15


@pytest.mark.parametrize("told", ["up", "camera"])
def test_a_known_camera_is_believed(walking, tilted, told):
    pelvis = np.asarray(walking.pelvis)
    seen = walking.turned(tilted)
    settings = Conditioning(frame="camera", up=tuple(tilted[:, 1]) if told == "up" else None)
    conditioner = Conditioner(settings, Body(walking_body(pelvis), -1.2))
    frames = []
    for i in range(60):
        camera = tilted.T if told == "camera" else None
        frames += conditioner.push(i / 30, seen.poses[i], seen.transl[i], None, camera)
    poses, transl = arrays(frames)
    plain = condition(Conditioner(body=conditioner.body), np.arange(60) / 30, walking.poses[:60], walking.transl[:60])
    expected, places = (array[: len(frames)] for array in arrays(plain))
    upright = [matrix_from_axis_angle(p[:, 0])[:, 1, 1] for p in (poses, expected)]
    assert upright[0] == pytest.approx(upright[1], abs=1e-6)  # tilt agrees; heading is the camera's with "up"
    assert transl[:, 1] == pytest.approx(places[:, 1], abs=1e-6)
    if told == "camera":
        assert poses == pytest.approx(expected, abs=1e-6)
        assert transl == pytest.approx(places, abs=1e-6)


def walking_body(pelvis):
    joints = bundled_body().joints.copy()
    return joints + (pelvis - joints[0])


def test_files_in_a_cameras_axes_come_out_upright(walking, tilted):
    """A file as its reader gives it, taken as level, is turned upright by its own motion."""
    seen = replace(walking.turned(tilted), frame="camera")
    read = level_camera(seen)
    with pytest.raises(CaphyError, match="camera axes"):
        condition_sequence(read, Conditioner())
    made = condition_sequence(read, Conditioner(Conditioning(frame="camera", floor=True)))
    assert made.frame == "world"
    assert made.up_axis == "y"
    tilt = np.degrees(np.arccos(matrix_from_axis_angle(made.poses[:, 0])[120:, 1, 1]))
    true = np.degrees(np.arccos(matrix_from_axis_angle(walking.poses[:, 0])[120:, 1, 1]))
    assert np.abs(tilt - true).mean() < 6


def test_the_floor_is_where_the_soles_are(walking, body):
    raised = walking.transl + np.array([0, 0.7, 0])
    conditioner = Conditioner(Conditioning(floor=True))
    frames = condition(conditioner, np.arange(len(walking)) / 30, walking.poses, raised)
    lowest = [(body.soles(exponential(f.poses)) + body.joints[0] + f.transl)[:, 1].min() for f in frames]
    assert np.median(np.abs(lowest)) < 0.02
    assert conditioner.world()["floor"] == pytest.approx(0.7, abs=0.03)


@pytest.fixture(scope="module")
def striding(body):
    """Poses (T, 55, 3) and transl (T, 3) of eight seconds of stiff strides: the leg that is stood on turns steadily
    about the hip, its sole level and still on the ground; the other is bent and swings ahead."""
    hip, knee, ankle = ([JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right")] for name in JOINTS)
    time = np.arange(240) / 30
    poses = np.zeros((240, 55, 3))
    stood = (time % 1.0 >= 0.5).astype(int)
    share = time % 0.5 / 0.5
    rows = np.arange(240)
    for leg, sign in ((stood, 1), (1 - stood, -1)):
        swing = sign * np.radians(40) * (share - 0.5)
        bend = np.radians(50) * np.sin(np.pi * share) * (sign < 0)
        poses[rows, np.array(hip)[leg], 0] = swing - bend / 2
        poses[rows, np.array(knee)[leg], 0] = bend
        poses[rows, np.array(ankle)[leg], 0] = -swing - bend / 2
    soles = np.array([body.soles(exponential(p)) for p in poses]).reshape(240, 2, 3, 3).mean(axis=2)
    steps = -(soles[rows[1:], stood[1:]] - soles[rows[:-1], stood[1:]]) * [1, 0, 1]
    return poses, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def test_feet_carry_a_body_without_translation(striding, body):
    poses, transl = striding
    conditioner = Conditioner(Conditioning(translation="feet"))
    frames = condition(conditioner, np.arange(240) / 30, poses, np.zeros_like(transl))
    carried = arrays(frames)[1]
    lowest = [
        (body.soles(exponential(p)) + body.joints[0] + t)[:, 1].min() for p, t in zip(poses, carried, strict=True)
    ]
    assert np.abs(lowest).max() < 0.02
    assert transl[-1, 2] > 5
    assert carried[-1, 2] == pytest.approx(transl[-1, 2], rel=0.1)
    assert abs(carried[-1, 0]) < 0.3


@pytest.mark.parametrize("size", [0.7, 1.3])
def test_the_steps_tell_the_size(size, striding):
    poses, transl = striding
    conditioner = Conditioner(Conditioning(scale=None))
    frames = condition(conditioner, np.arange(240) / 30, poses, transl * [size, 1, size])
    assert conditioner.world()["scale"] == pytest.approx(1 / size, rel=0.1)
    late = arrays(frames)[1][120:, 2]
    assert late[-1] - late[0] == pytest.approx(transl[-1, 2] - transl[120, 2], rel=0.1)


def test_captured_walks_are_carried_as_far_as_they_went(shared_data):
    clip = read_poses(shared_data / "cmu_mocap" / "bvh" / "02_01.bvh").resample(30.0)
    conditioner = Conditioner(Conditioning(translation="feet"))
    frames = condition(conditioner, np.arange(len(clip)) / 30, clip.poses, clip.transl)
    way = np.linalg.norm((frames[-1].transl - frames[0].transl)[[0, 2]])
    assert way == pytest.approx(np.linalg.norm((clip.transl[-1] - clip.transl[0])[[0, 2]]), rel=0.1)
    conditioner = Conditioner(Conditioning(scale=None))
    condition(conditioner, np.arange(len(clip)) / 30, clip.poses, 0.7 * clip.transl)
    assert conditioner.world()["scale"] == pytest.approx(1 / 0.7, rel=0.1)


def test_a_whole_motion_is_upright_from_its_beginning(body):
    """Somebody stands still before a camera that looks down by 20 degrees: a stream tilts them back as it learns."""
    look = matrix_from_axis_angle(np.array([np.radians(20), 0.0, 0.0])) @ OPENCV_TO_Y_UP.T
    count = 60
    poses = np.tile(logarithm(standing_pose()), (count, 1, 1))
    still = PoseSequence(poses, np.tile([0.0, 0.0, -4.0], (count, 1)), 30.0, pelvis=body.joints[0])
    seen = level_camera(replace(still.turned(look), frame="camera"))
    settings = Conditioning(frame="camera")
    conditioner = Conditioner(settings)
    made = condition_sequence(seen, conditioner)
    stream = condition(
        Conditioner(settings), np.arange(count) / 30, still.turned(look).poses, still.turned(look).transl
    )
    leans = [np.degrees(np.arccos(matrix_from_axis_angle(p[:, 0])[:, 1, 1])) for p in (made.poses, arrays(stream)[0])]
    assert leans[0].max() < 8 and leans[1][0] > 15
    assert made.linear_speed().max() < 0.01
    world = conditioner.world()
    assert world["up_from"] == "motion" and world["up_error_degrees"] > 1


def test_what_a_motion_learns_of_up_is_looked_at_once(walking, tilted):
    """And learning goes on where the first look ended."""
    seen = walking.turned(tilted)
    settings, times = Conditioning(frame="camera"), np.arange(len(seen)) / 30
    once, whole = Conditioner(settings), Conditioner(settings)
    condition(once, times, seen.poses, seen.transl)
    condition_upright(whole, times, seen.poses, seen.transl)
    assert whole.world()["up"] == once.world()["up"]
    assert whole.world()["up_error_degrees"] == once.world()["up_error_degrees"]
