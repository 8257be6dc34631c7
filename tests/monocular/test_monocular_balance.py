"""How somebody stands: the centre of mass over the feet, the tilt of the pelvis, and where landmarks are seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from people import FOCAL, SIZE, into_camera, landmark_places, seen
from scipy.spatial.transform import Rotation

from benchmarks import monocular_landmarks
from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence
from caphy.rotations import matrix_from_axis_angle
from service.clients.monocular.estimator import Estimator
from service.clients.monocular.kinematics import Kinematics
from service.clients.monocular.landmarks import LANDMARKS
from service.clients.monocular.skeleton import SEGMENTS, Skeleton, centre_of_mass, seen_from_anatomy
from service.clients.monocular.video import Picture


def _posed(**bends: tuple[float, float, float]) -> np.ndarray:
    """Poses (1, 55, 3) of rotation vectors by joint [degrees]; arms hang."""
    poses = np.zeros((1, 55, 3))
    for name, bend in {"left_shoulder": (0, 0, -70), "right_shoulder": (0, 0, 70), **bends}.items():
        poses[0, JOINT_NAMES.index(name)] = np.radians(bend)
    return poses


def test_the_centre_of_mass_lies_where_textbooks_have_it(bundle: AvatarBundle) -> None:
    """At 55 to 58 % of the height of people standing (Winter 2009, section 4.1.4; Palmer 1944), in the middle."""
    moved = bundle.transforms(_posed(), np.zeros((1, 3)))[0]
    joints = np.einsum("jab,jb->ja", moved[..., :3], bundle.joints) + moved[..., 3]
    centre = centre_of_mass(joints[:BODY_JOINT_COUNT])
    low, high = bundle.body.vertices[:, 1].min(), bundle.body.vertices[:, 1].max()
    assert 0.54 < (centre[1] - low) / (high - low) < 0.59
    assert abs(centre[0]) < 1e-3
    assert 2 * sum(mass for _, _, mass, _ in SEGMENTS) == pytest.approx(1)
    move = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(centre_of_mass(joints[:BODY_JOINT_COUNT] + move), centre + move)


def test_somebody_standing_in_a_picture_without_lines_shows_up(bundle: AvatarBundle) -> None:
    """Leaning forward from the ankles to the neck, as people stand, and still in balance."""
    tilt = Rotation.from_euler("zx", [4, 20], degrees=True).as_matrix()
    axes = tilt @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    poses = _posed(pelvis=(12, 0, 0), left_hip=(-14, 0, 0), right_hip=(-14, 0, 0), spine1=(6, 0, 0))
    points = into_camera(landmark_places(bundle, poses, np.zeros((1, 3))), axes)[0]
    estimator = Estimator(bundle.joints, lambda picture: None, FOCAL, SIZE)
    grey = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    for t in range(30):
        estimate = estimator.estimate(Picture(t / 30, grey), seen(points), False)
    assert np.degrees(np.arccos(estimate.turn[1] @ axes[:, 1])) < 4


def test_a_squat_bends_hips_and_not_the_back(bundle: AvatarBundle) -> None:
    bends = {"left_hip": (-95, 0, 0), "right_hip": (-95, 0, 0), "left_knee": (105, 0, 0), "right_knee": (105, 0, 0)}
    poses = _posed(pelvis=(30, 40, 0), left_ankle=(-25, 0, 0), right_ankle=(-25, 0, 0), **bends)
    points = into_camera(landmark_places(bundle, poses, np.zeros((1, 3))))[0]
    posture = Kinematics(Skeleton.of(bundle.joints), FOCAL, SIZE).fit(seen(points), 1 / 30)
    hips = [JOINT_NAMES.index("left_hip"), JOINT_NAMES.index("right_hip")]
    true = matrix_from_axis_angle(poses[0, hips])
    turned = Rotation.from_matrix(np.swapaxes(true, 1, 2) @ posture.rotations[hips]).magnitude()
    assert np.degrees(turned).max() < 14


def _filmed(folder: Path, name: str, bundle: AvatarBundle, motion: PoseSequence, offsets: np.ndarray) -> None:
    """A film's truth and record in ``folder``: landmarks seen at ``offsets`` (33, 3) [m] from anatomy."""
    skeleton = Skeleton.of(bundle.joints)
    moved = bundle.transforms(motion.poses, motion.transl)[:, skeleton.carrier]
    sites = skeleton.sites - seen_from_anatomy() + offsets
    axes, eye = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]), np.array([0.0, 0.2, 3.5])
    points = (np.einsum("tsab,sb->tsa", moved[..., :3], sites) + moved[..., 3] - eye) @ axes.T
    pixels = 1000.0 * points[..., :2] / points[..., 2:] + np.array([1280, 720]) / 2
    pixels[5] = np.nan  # nobody was found
    times = np.arange(len(pixels)) / 30
    np.savez(folder / f"{name}.record.npz", time=times, pixels=pixels, visibility=np.ones(pixels.shape[:2]))
    np.savez(folder / f"{name}.npz", poses=motion.poses, transl=motion.transl, axes=axes, eye=eye, focal=1000.0)


def test_where_landmarks_are_seen_is_measured(
    tmp_path: Path,
    bundle: AvatarBundle,
    motion: PoseSequence,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Offsets that were planted are found, the same for left and right, whatever the client's own are."""
    planted = np.random.default_rng(0).normal(0, 0.02, (len(LANDMARKS), 3))
    planted[0, 0] = 0.0
    for i, name in enumerate(LANDMARKS):
        if name.startswith("right_"):
            planted[i] = planted[LANDMARKS.index(name.replace("right_", "left_"))] * [-1, 1, 1]
    turned = motion.turned(Rotation.from_euler("y", 80, degrees=True).as_matrix())
    for camera, sequence in (("front", motion), ("low", turned)):
        _filmed(tmp_path, f"one_clip-{camera}", bundle, sequence, planted)
        _filmed(tmp_path, f"another-{camera}", bundle, sequence, planted)
    monkeypatch.setattr(monocular_landmarks, "CLIPS", {"one clip": None, "another": None})
    monkeypatch.setattr(monocular_landmarks, "EVERY", 1)  # enough pictures that the usual offset hardly pulls
    monocular_landmarks.main(monocular_landmarks.Arguments(tmp_path))
    printed = capsys.readouterr().out
    assert printed.count("\n") == 17
    films = [monocular_landmarks._films(tmp_path, clip, bundle) for clip in ("one clip", "another")]
    found = monocular_landmarks.offsets([film for several in films for film in several])
    np.testing.assert_allclose(found, planted, atol=2e-3)


def test_landmarks_are_seen_alike_on_both_sides() -> None:
    offsets = seen_from_anatomy()
    for i, name in enumerate(LANDMARKS):
        if not name.startswith("right_"):
            twin = LANDMARKS.index(name.replace("left_", "right_"))
            np.testing.assert_array_equal(offsets[twin], offsets[i] * [-1, 1, 1])
    assert 0.05 < abs(offsets).max() < 0.07  # metres
