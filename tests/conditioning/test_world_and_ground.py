"""Gravity, floor, scale and feet, against a motion whose world is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.conditioning import Body, Conditioner, Conditioning, condition, condition_sequence
from caphy.conditioning.body import bundled_body
from caphy.conditioning.quaternions import exponential
from caphy.errors import CaphyError
from caphy.io.poses.camera import OPENCV_TO_Y_UP, level_camera
from caphy.io.poses.ground import sole_points, world_joints
from caphy.io.procedural import procedural_motion
from caphy.rotations import matrix_from_axis_angle


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


def test_feet_carry_a_body_without_translation(walking, body):
    frames = condition(
        Conditioner(Conditioning(translation="feet")),
        np.arange(len(walking)) / 30,
        walking.poses,
        np.zeros_like(walking.transl),
    )
    poses, transl = arrays(frames)
    lowest = [(body.soles(exponential(p)) + body.joints[0] + t)[:, 1].min() for p, t in zip(poses, transl, strict=True)]
    assert np.abs(lowest).max() < 0.02
    way, true = (np.linalg.norm(np.diff(t[::20, [0, 2]], axis=0), axis=1).sum() for t in (transl, walking.transl))
    assert way == pytest.approx(true, rel=0.2)


@pytest.mark.parametrize("size", [0.7, 1.3])
def test_the_steps_tell_the_size(size, body):
    """Feet that tread on the spot while the given translation is too small or too large."""
    motion = procedural_motion(0, 20.0, 30.0)
    conditioner = Conditioner(Conditioning(scale=None))
    condition(conditioner, np.arange(len(motion)) / 30, motion.poses, motion.transl * [size, 1, size])
    assert conditioner.world()["scale"] == pytest.approx(1 / size, rel=0.15)
