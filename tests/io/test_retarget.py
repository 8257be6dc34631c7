"""Retargeted motions: limbs point where the source's point, feet stand, legs bend forward."""

import re
from dataclasses import replace

import numpy as np
import pytest
from cmu_skeleton import BONES, bvh_text, random_angles, root_path

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, placed_on, read_poses
from caphy.io.poses.bvh import read_bvh
from caphy.io.poses.cmu import upright, without_calibration_frame
from caphy.io.procedural import procedural_motion
from caphy.io.retarget import retarget
from caphy.io.retarget_names import cmu_joints
from caphy.io.retarget_rest import default_rest, rest_of

LIMBS = [
    (f"{side}_{joint}", f"{side}_{child}", side[0] + bone, side[0] + end)
    for side in ("left", "right")
    for joint, child, bone, end in (
        ("hip", "knee", "femur", "tibia"),
        ("knee", "ankle", "tibia", "foot"),
        ("shoulder", "elbow", "humerus", "radius"),
        ("elbow", "wrist", "radius", "wrist"),
    )
]


def joints_of(sequence) -> np.ndarray:
    """World joints (T, 55, 3) by the body's own kinematics."""
    return default_body().posed_joints(sequence.poses, sequence.transl)


def limb_errors(motion, sequence) -> dict[str, float]:
    """Greatest angle between the direction of each limb and the source's [degrees]."""
    _, source = motion.world()
    bones, joints = cmu_joints(motion), joints_of(sequence)
    errors = {}
    for name, child, bone, end in LIMBS:
        a = source[:, bones[end]] - source[:, bones[bone]]
        b = joints[:, JOINT_NAMES.index(child)] - joints[:, JOINT_NAMES.index(name)]
        a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
        errors[name] = float(np.degrees(2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)).max())
    return errors


@pytest.mark.parametrize("max_names", [False, True])
def test_limbs_of_a_made_clip_point_as_the_source(tmp_path, max_names):
    angles = random_angles(np.random.default_rng(5), 8, 50.0)
    for side in "lr":
        angles[f"{side}wrist"][:, 1:] = 0  # the wrist bone only twists
    (tmp_path / "a.bvh").write_text(bvh_text(angles, root_path(8), max_names=max_names))
    motion = read_bvh(tmp_path / "a.bvh")
    assert max(limb_errors(motion, retarget(motion, default_rest())).values()) < 1e-3


def test_the_hips_follow_the_source(tmp_path):
    """Their midpoint travels as the source's does over ground, scaled by the ratio of leg lengths."""
    (tmp_path / "a.bvh").write_text(bvh_text(random_angles(np.random.default_rng(5), 8, 50.0), root_path(8)))
    motion = read_bvh(tmp_path / "a.bvh")
    bones, (_, source) = cmu_joints(motion), motion.world()
    joints = joints_of(retarget(motion, default_rest()))
    length = np.linalg.norm(np.diff(default_rest().joints[[1, 4, 7]], axis=0), axis=-1).sum()
    expected = source[:, [bones["lfemur"], bones["rfemur"]]].mean(axis=1) * length / (7.2 + 7.4)
    hips = joints[:, [1, 2]].mean(axis=1)
    np.testing.assert_allclose(hips[:, [0, 2]], expected[:, [0, 2]], atol=1e-5)


@pytest.mark.parametrize(
    "clip",
    [
        "bvh/01_01.bvh",
        "bvh/131_01.bvh",
        "bvh_from_expmap/train_walking_walking_1.bvh",
        "bvh_from_expmap/train_jumping_jumping_3.bvh",
        "bvh_from_expmap/test_running_running_1.bvh",
    ],
)
def test_real_clips(shared_data, clip):
    path = shared_data / "cmu_mocap" / clip
    motion = without_calibration_frame(read_bvh(path))
    sequence = read_poses(path)
    errors = limb_errors(motion, sequence)
    assert max(errors.values()) < 0.01, errors
    # knees bend forward only: the shin turns back about the knee's x axis
    knees = sequence.poses[:, [4, 5], 0]
    assert np.degrees(knees).min() > -15
    assert np.degrees(knees).max() > 30
    # the soles stand at the ground in most frames, by the body's own vertices
    body = default_body()
    frames = np.linspace(0, len(sequence) - 1, 40).astype(int)
    lowest = body.pose(sequence.poses[frames], sequence.transl[frames])[..., 1].min(axis=1)
    assert abs(np.median(lowest)) < 0.02
    assert lowest.min() > -0.06


def test_walkers_face_where_they_go(shared_data):
    for clip in ("train_walking_walking_1", "train_running_running_2"):
        sequence = read_poses(shared_data / "cmu_mocap" / "bvh_from_expmap" / f"{clip}.bvh")
        moved = (sequence.transl[-1] - sequence.transl[0])[[0, 2]]
        joints = joints_of(sequence)
        across = joints[:, JOINT_NAMES.index("left_hip")] - joints[:, JOINT_NAMES.index("right_hip")]
        ahead = np.cross(across, [0, 1, 0]).mean(axis=0)[[0, 2]]
        assert moved @ ahead / np.linalg.norm(moved) / np.linalg.norm(ahead) > 0.95


def test_jumps_keep_their_height(shared_data):
    path = shared_data / "cmu_mocap" / "bvh_from_expmap" / "train_jumping_jumping_3.bvh"
    sequence = read_poses(path)
    motion = read_bvh(path)
    bones = cmu_joints(motion)
    feet = motion.world()[1][:, [bones["ltoes"], bones["rtoes"]], 1].min(axis=1)
    scale = sequence.transl[:, 1].std() / motion.root[:, 1].std()
    body = default_body()
    lowest = body.pose(sequence.poses[::10], sequence.transl[::10])[..., 1].min(axis=1)
    assert lowest.max() == pytest.approx(scale * (feet.max() - np.median(feet)), abs=0.06)
    assert lowest.max() > 0.15


def test_the_zero_pose_is_upright_with_flat_feet(tmp_path):
    """A skeleton standing with vertical legs and arms out gives nearly the body's own T-pose."""
    zero = {name: np.zeros((3, 3)) for name in ("root", *BONES)}
    for side, sign in (("l", 1), ("r", -1)):
        zero[f"{side}femur"][:, 2] = -20 * sign  # takes the splay out
    (tmp_path / "t.bvh").write_text(bvh_text(zero, root_path(3)))
    motion = read_bvh(tmp_path / "t.bvh")
    body = default_body()
    sequence = retarget(motion, default_rest())
    vertices = body.pose(sequence.poses, sequence.transl)[0]
    assert vertices[:, 1].min() == pytest.approx(0, abs=0.01)
    feet = np.degrees(np.linalg.norm(sequence.poses[:, [10, 11]], axis=-1))
    assert feet.max() < 1e-3
    trunk = np.degrees(np.linalg.norm(sequence.poses[:, [0, 3, 6, 9, 12, 15]], axis=-1))
    assert trunk.max() < 1e-3
    toes = [joints_of(sequence)[0, JOINT_NAMES.index(f"{s}_foot")] for s in ("left", "right")]
    assert all(abs(toe[1] - (body.joints[10, 1] - default_rest().sole)) < 0.01 for toe in toes)


def test_the_calibration_frame_is_dropped(shared_data):
    sequence = read_poses(shared_data / "cmu_mocap" / "bvh" / "01_01.bvh")
    assert len(sequence) == 2751
    assert any("T-pose" in note for note in sequence.notes)
    assert len(read_poses(shared_data / "cmu_mocap" / "bvh" / "131_01.bvh")) == 994  # has none


def test_retargets_to_another_body(tmp_path):
    body = default_body()
    betas = np.array([2.0, -1.0])
    (tmp_path / "a.bvh").write_text(bvh_text(random_angles(np.random.default_rng(5), 6, 20.0), root_path(6)))
    motion = read_bvh(tmp_path / "a.bvh")
    sequence = retarget(motion, rest_of(body, betas))
    np.testing.assert_allclose(sequence.pelvis, body.rest(betas)[1][0])
    lowest = body.pose(sequence.poses, sequence.transl, betas)[..., 1].min(axis=1)
    assert abs(np.median(lowest)) < 0.03


def test_a_skeleton_upside_down_is_refused(tmp_path):
    text = bvh_text(random_angles(np.random.default_rng(5), 2), root_path(2))
    flipped = re.sub(r"OFFSET (\S+) -(6\.\d+)", r"OFFSET \1 \2", text)
    assert flipped != text
    (tmp_path / "a.bvh").write_text(flipped)
    with pytest.raises(CaphyError, match="legs down"):
        read_poses(tmp_path / "a.bvh")


def test_a_skeleton_with_z_up_is_refused_and_read_where_that_is_said(shared_data, tmp_path):
    """Offsets, rotations and places turned alike, as programs whose axes are z up write it."""
    motion = without_calibration_frame(read_bvh(shared_data / "cmu_mocap" / "bvh" / "02_01.bvh"))
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turned = replace(
        motion,
        offsets=motion.offsets @ turn.T,
        tips=motion.tips @ turn.T,
        rotations=turn @ motion.rotations @ turn.T,
        root=motion.root @ turn.T,
    )
    with pytest.raises(CaphyError, match=r"its shins point .* say which axis is up in the file: --up y or --up z"):
        retarget(turned, default_rest())
    np.testing.assert_allclose(upright(turned, "z").root, motion.root, atol=1e-12)
    there, here = (retarget(each, default_rest()) for each in (upright(turned, "z"), motion))
    np.testing.assert_allclose(there.poses, here.poses, atol=1e-9)
    np.testing.assert_allclose(there.transl, here.transl, atol=1e-9)


def test_a_motion_of_another_body_is_set_on_the_ground():
    """SMPL-X's translation means nothing on a body whose pelvis rests elsewhere."""
    rest = default_rest()
    made = procedural_motion(1, 6.0, 30.0)
    foreign = PoseSequence(made.poses, made.transl + np.array([0.4, 0.7, 0.0]), made.fps)  # refers to SMPL-X's pelvis
    placed = placed_on(foreign, rest.joints, rest.sole)
    lowest = default_body().pose(placed.poses, placed.transl)[..., 1].min(axis=1)
    assert abs(np.median(lowest)) < 0.01
    moved = placed.transl - foreign.transl
    np.testing.assert_allclose(moved[:, [0, 2]], np.tile((foreign.pelvis - rest.joints[0])[[0, 2]], (len(made), 1)))
    assert placed_on(made, rest.joints, rest.sole) is made
