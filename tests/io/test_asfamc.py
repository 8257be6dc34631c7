"""ASF/AMC against BVH of the same motion, and the axis rule against its formula."""

import numpy as np
import pytest
from cmu_skeleton import amc_text, asf_text, bvh_text, random_angles, root_path, rotation

from caphy.errors import CaphyError
from caphy.io.poses import read_poses
from caphy.io.poses.asfamc import read_amc
from caphy.rotations import matrix_from_axis_angle


def greatest_angle(a, b) -> float:
    """Greatest angle [degrees] between the joint rotations of two sequences."""
    difference = matrix_from_axis_angle(a.poses) - matrix_from_axis_angle(b.poses)
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(difference, axis=(-2, -1)) / np.sqrt(8))).max())


def write(folder, angles, root):
    (folder / "77.asf").write_text(asf_text())
    (folder / "77_01.amc").write_text(amc_text(angles, root))
    (folder / "77_01.bvh").write_text(bvh_text(angles, root))
    return folder / "77_01.amc", folder / "77_01.bvh"


def test_both_routes_agree_on_a_made_clip(tmp_path):
    amc, bvh = write(tmp_path, random_angles(np.random.default_rng(3), 6, 60.0), root_path(6))
    a, b = read_poses(amc, fps=120), read_poses(bvh)
    assert greatest_angle(a, b) < 1e-5
    np.testing.assert_allclose(a.transl, b.transl, atol=1e-6)


@pytest.mark.parametrize(
    ("bvh", "amc", "degrees", "metres"),
    [
        ("bvh/01_01.bvh", "asfamc/01_01.amc", 2e-4, 1e-5),
        ("bvh_from_expmap/test_soccer_soccer_1.bvh", "asfamc/11_01.amc", 2e-3, None),  # limb lengths of subject 02
    ],
)
def test_both_routes_agree_on_real_clips(shared_data, bvh, amc, degrees, metres):
    folder = shared_data / "cmu_mocap"
    a, b = read_poses(folder / amc, fps=120), read_poses(folder / bvh)
    assert len(a) == len(b)
    assert greatest_angle(a, b) < degrees
    if metres:
        np.testing.assert_allclose(a.transl, b.transl, atol=metres)


def test_a_bone_turns_about_its_own_axis(tmp_path):
    """R = C Rz Ry Rx C^-1 with C of the bone's axis, written out."""
    head, tail = asf_text().split("     name lfemur\n")
    tail = tail.replace("axis 0 0 0  XYZ", "axis 10 -30 50  XYZ", 1)
    (tmp_path / "77.asf").write_text(head + "     name lfemur\n" + tail)
    angles = random_angles(np.random.default_rng(3), 2, 40.0)
    (tmp_path / "77_01.amc").write_text(amc_text(angles, root_path(2)))
    motion = read_amc(tmp_path / "77_01.amc", 120)
    c = np.array(rotation("Z", 50)) @ np.array(rotation("Y", -30)) @ np.array(rotation("X", 10))
    x, y, z = np.round(angles["lfemur"][1], 6)
    turn = np.array(rotation("Z", z)) @ np.array(rotation("Y", y)) @ np.array(rotation("X", x))
    np.testing.assert_allclose(motion.rotations[1, motion.names.index("lfemur")], c @ turn @ c.T, atol=1e-9)


def test_the_frame_rate_must_be_given(tmp_path):
    amc, _ = write(tmp_path, random_angles(np.random.default_rng(3), 2), root_path(2))
    with pytest.raises(CaphyError, match=r"77_01\.amc.*--fps"):
        read_poses(amc)


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("77_01.amc", "\n2\n", "\n3\n", "frame 2 must come next, got 3"),
        ("77_01.amc", "lfemur ", "lfemurs ", "that its skeleton cannot take"),
        ("77_01.amc", "head ", "head 1 ", "'head' must hold 3 finite numbers"),
        ("77.asf", ":hierarchy", ":tree", "section :hierarchy"),
        ("77.asf", "dof rx ry rz", "dof rx rw", "may turn about rx, ry and rz"),
        ("77.asf", "order TX TY TZ RX RY RZ", "order TX TY TZ", "once each"),
    ],
)
def test_says_what_is_wrong(tmp_path, name, old, new, words):
    amc, _ = write(tmp_path, random_angles(np.random.default_rng(3), 3), root_path(3))
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(CaphyError, match=f"(?s){name}.*{words}"):
        read_poses(amc, fps=120)


def test_cut_files_are_refused(tmp_path):
    amc, _ = write(tmp_path, random_angles(np.random.default_rng(3), 3), root_path(3))
    text = amc.read_text()
    for share in (0.0, 0.3, 0.7, 0.97):
        amc.write_text(text[: int(share * len(text))])
        with pytest.raises(CaphyError, match="77_01"):
            read_poses(amc, fps=120)


def test_the_skeleton_must_lie_beside_the_motion(tmp_path):
    amc, _ = write(tmp_path, random_angles(np.random.default_rng(3), 2), root_path(2))
    (tmp_path / "77.asf").rename(tmp_path / "78.asf")
    assert len(read_poses(amc, fps=120)) == 2  # the only one there
    (tmp_path / "79.asf").write_text(asf_text())
    with pytest.raises(CaphyError, match=r"77\.asf"):
        read_poses(amc, fps=120)
