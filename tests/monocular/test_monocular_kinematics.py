"""Inverse kinematics against poses that are known, seen through landmarks projected from them."""

from __future__ import annotations

import numpy as np
import pytest
from people import FOCAL, SIZE, into_camera, landmark_places, seen
from scipy.spatial.transform import Rotation

from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence
from service.clients.monocular import kinematics
from service.clients.monocular.estimator import confidence
from service.clients.monocular.kinematics import Kinematics
from service.clients.monocular.landmarks import LANDMARKS
from service.clients.monocular.posture import limits
from service.clients.monocular.rotations import best_turn, inverse_jacobians, smallest_turn, turns, turns_inverse
from service.clients.monocular.skeleton import Skeleton, seen_from_anatomy

BONES = [("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")]


def _followed(bundle: AvatarBundle, motion: PoseSequence, **faults: object) -> tuple[np.ndarray, np.ndarray]:
    """Joints (T, 22, 3) [m] in the camera: found, and true."""
    skeleton, random = Skeleton.of(bundle.joints), np.random.default_rng(1)
    follower = Kinematics(skeleton, FOCAL, SIZE)
    places = into_camera(landmark_places(bundle, motion.poses, motion.transl))
    found = []
    for points in places:
        posture = follower.fit(seen(points, random, **faults), 1 / 30)
        found.append(skeleton.posed(posture.rotations, posture.root)[1])
    transforms = bundle.transforms(motion.poses, motion.transl)
    joints = np.einsum("tjab,jb->tja", transforms[..., :3], bundle.joints) + transforms[..., 3]
    return np.array(found), into_camera(joints)[:, :22]


def _bone_angles(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Angles (T, 8) [deg] between limb bones."""
    pairs = [
        (JOINT_NAMES.index(f"{s}_{a}"), JOINT_NAMES.index(f"{s}_{b}")) for s in ("left", "right") for a, b in BONES
    ]
    u, v = (np.stack([x[:, b] - x[:, a] for a, b in pairs], axis=1) for x in (found, true))
    cosine = np.einsum("tbc,tbc->tb", u, v) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def test_a_person_seen_perfectly_is_found_where_they_are(
    bundle: AvatarBundle, motion: PoseSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the trust that a real detector deserves usual postures pull a little; with full trust they do not."""
    found, true = _followed(bundle, motion)
    assert _bone_angles(found, true).mean() < 5
    monkeypatch.setattr(kinematics, "_SPREAD", 0.1 * kinematics._SPREAD)
    monkeypatch.setattr(kinematics, "SPACE_SPREAD", 0.1 * kinematics.SPACE_SPREAD)
    found, true = _followed(bundle, motion)
    assert _bone_angles(found, true).mean() < 1
    assert np.linalg.norm(found - true, axis=-1).mean() < 0.01


def test_noise_of_a_detector_is_survived(bundle: AvatarBundle, motion: PoseSequence) -> None:
    """4 pixels are 16 mm here: half of what was measured of mediapipe; its errors are not independent."""
    found, true = _followed(bundle, motion, pixel_noise=4.0, space_noise=0.04)
    assert _bone_angles(found, true).mean() < 8.0
    relative = (found - found[:, :1]) - (true - true[:, :1])
    assert np.linalg.norm(relative, axis=-1).mean() < 0.04


def test_the_trunk_turns_as_it_is_seen(bundle: AvatarBundle, motion: PoseSequence) -> None:
    """Twist and root: the same posture, turned by a third of a turn, is found turned by that."""
    skeleton = Skeleton.of(bundle.joints)
    turned = motion.turned(Rotation.from_euler("y", 120, degrees=True).as_matrix())
    roots = []
    for sequence in (motion, turned):
        follower = Kinematics(skeleton, FOCAL, SIZE)
        points = into_camera(landmark_places(bundle, sequence.poses[:1], sequence.transl[:1]))[0]
        roots.append(follower.fit(seen(points), 1 / 30).rotations[0])
    between = Rotation.from_matrix(roots[1] @ roots[0].T).as_rotvec(degrees=True)
    assert np.linalg.norm(between - [0, -120, 0]) < 6  # the camera's second axis points down


def test_an_arm_that_nobody_sees_hangs_in_reach(bundle: AvatarBundle, motion: PoseSequence) -> None:
    hidden = np.ones(len(LANDMARKS))
    lost = [LANDMARKS.index(f"left_{part}") for part in ("elbow", "wrist", "pinky", "index", "thumb")]
    hidden[lost] = 0.0
    follower = Kinematics(Skeleton.of(bundle.joints), FOCAL, SIZE)
    low, high = limits()
    random = np.random.default_rng(5)
    for points in into_camera(landmark_places(bundle, motion.poses, motion.transl)):
        faulty = points.copy()
        faulty[lost] += random.normal(0, 0.5, (len(lost), 3))
        posture = follower.fit(seen(faulty, visibility=hidden), 1 / 30)
        assert np.isfinite(posture.rotations).all()
        vectors = turns_inverse(posture.rotations)
        for name in ("left_shoulder", "left_elbow", "left_wrist"):
            joint = JOINT_NAMES.index(name)
            assert (vectors[joint] > low[joint] - 0.35).all(), name
            assert (vectors[joint] < high[joint] + 0.35).all(), name


def test_a_joint_is_trusted_as_the_least_of_its_landmarks(bundle: AvatarBundle, motion: PoseSequence) -> None:
    visibility = np.ones(len(LANDMARKS))
    visibility[LANDMARKS.index("left_wrist")] = 0.15
    points = into_camera(landmark_places(bundle, motion.poses[:1], motion.transl[:1]))[0]
    trust = confidence(seen(points, visibility=visibility))
    assert trust[JOINT_NAMES.index("left_elbow")] == trust[JOINT_NAMES.index("left_wrist")] == 0.15
    assert trust[JOINT_NAMES.index("left_shoulder")] == trust[JOINT_NAMES.index("right_elbow")] == 1


def test_knees_and_elbows_do_not_bend_backwards(bundle: AvatarBundle) -> None:
    """Landmarks of limbs that bend the wrong way by 40 degrees, as depth flips make them."""
    poses = np.zeros((1, 55, 3))
    wrong = {"left_knee": (0, -1), "right_knee": (0, -1), "left_elbow": (1, 1), "right_elbow": (1, -1)}
    for name, (axis, sign) in wrong.items():
        poses[0, JOINT_NAMES.index(name), axis] = sign * np.radians(40)
    points = into_camera(landmark_places(bundle, poses, np.zeros((1, 3))))[0]
    posture = Kinematics(Skeleton.of(bundle.joints), FOCAL, SIZE).fit(seen(points), 1 / 30)
    vectors = turns_inverse(posture.rotations)
    for name, (axis, sign) in wrong.items():
        assert np.degrees(sign * vectors[JOINT_NAMES.index(name), axis]) < 6, name


def test_a_person_of_another_size_takes_the_same_postures(bundle: AvatarBundle, motion: PoseSequence) -> None:
    """A child's landmarks are the adult's, smaller: the angles stay, and the child is not taken for far away."""
    skeleton = Skeleton.of(bundle.joints)
    points = into_camera(landmark_places(bundle, motion.poses[:1], motion.transl[:1]))[0]
    adult = Kinematics(skeleton, FOCAL, SIZE).fit(seen(points), 1 / 30)
    child = Kinematics(skeleton, FOCAL, SIZE).fit(seen(points * 0.7), 1 / 30)
    turned = Rotation.from_matrix(np.swapaxes(adult.rotations, 1, 2) @ child.rotations).magnitude()
    assert np.degrees(turned).max() < 3


def test_every_landmark_has_a_place_on_its_own_side(bundle: AvatarBundle) -> None:
    skeleton = Skeleton.of(bundle.joints)
    assert len(LANDMARKS) == len(set(LANDMARKS)) == 33
    for name, place in zip(LANDMARKS, skeleton.sites, strict=True):
        if name.startswith("left"):
            mirrored = skeleton.sites[LANDMARKS.index(name.replace("left", "right"))]
            assert place[0] > 0
            np.testing.assert_allclose(mirrored, place * [-1, 1, 1], atol=2e-3)
        by_anatomy = place - seen_from_anatomy()[LANDMARKS.index(name)]
        surface = np.linalg.norm(bundle.body.vertices - by_anatomy, axis=1).min()
        assert surface < 0.06, name


def test_rotations_against_scipy() -> None:
    vectors = np.random.default_rng(2).normal(size=(50, 3))
    matrices = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(turns(vectors), matrices, atol=1e-12)
    np.testing.assert_allclose(turns_inverse(matrices), Rotation.from_matrix(matrices).as_rotvec(), atol=1e-7)
    assert np.isfinite(turns_inverse(np.eye(3)[None])).all()
    start, end = vectors[:2]
    np.testing.assert_allclose(np.cross(smallest_turn(start, end) @ start, end), 0, atol=1e-9)
    turned = best_turn(vectors, vectors @ matrices[0].T + 3.0, np.linspace(0.1, 1, 50))
    np.testing.assert_allclose(turned, matrices[0], atol=1e-9)


@pytest.mark.parametrize("axis", range(3))
def test_the_slope_of_rotation_vectors_is_the_finite_difference(axis: int) -> None:
    vectors, small = np.random.default_rng(4).normal(size=(20, 3)), 1e-6
    step = np.tile(small * np.eye(3)[axis], (20, 1))
    moved = (Rotation.from_rotvec(vectors) * Rotation.from_rotvec(step)).as_rotvec()
    keep = np.linalg.norm(vectors, axis=1) < 3.0
    difference = (moved - Rotation.from_rotvec(vectors).as_rotvec()) / small
    np.testing.assert_allclose(inverse_jacobians(vectors)[keep][:, :, axis], difference[keep], atol=1e-4)
