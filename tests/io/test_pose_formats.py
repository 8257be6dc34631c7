"""Every estimator's and data set's layout, written here from its published description and read back."""

from collections import defaultdict

import joblib
import numpy as np
import pytest
import torch

from caphy.errors import CaphyError
from caphy.io.poses import read_poses
from caphy.rotations import matrix_from_axis_angle

T = 6
RNG = np.random.default_rng(11)
ROOT, BODY, HANDS = (RNG.normal(0, 0.3, (T, n, 3)) for n in (1, 21, 30))
JAW, EYES = RNG.normal(0, 0.1, (T, 1, 3)), RNG.normal(0, 0.1, (T, 2, 3))
TRANS = RNG.normal(0, 1, (T, 3))
UPRIGHT_Z = np.array([np.pi / 2, 0, 0])  # stands a y-up body up in a z-up world

Z_TO_Y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def turned_root(root: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return rotation @ matrix_from_axis_angle(root)


def check(sequence, *, hands=True, face=True, rotation=Z_TO_Y, pelvis, trans=TRANS):
    """Joints where SMPL-X has them, and the pelvis where the world's turn takes it."""
    np.testing.assert_allclose(
        matrix_from_axis_angle(sequence.poses[:, 0]), turned_root(ROOT[:, 0], rotation), atol=1e-9
    )
    np.testing.assert_allclose(sequence.poses[:, 1:22], BODY, atol=1e-12)
    np.testing.assert_allclose(sequence.poses[:, 22:25], np.concatenate([JAW, EYES], 1) * face, atol=1e-12)
    np.testing.assert_allclose(sequence.poses[:, 25:], HANDS * hands, atol=1e-12)
    np.testing.assert_allclose(sequence.transl + pelvis, (trans + pelvis) @ rotation.T, atol=1e-6)


SMPLX = np.array([0.0031233, -0.3514075, 0.0120366])
SMPLH_FEMALE = np.array([-0.0008763, -0.2114187, 0.0278211])
SMPL = np.array([-0.0017951, -0.2233338, 0.0282192])


def test_amass_smplh(tmp_path):
    poses = np.concatenate([ROOT, BODY, HANDS], 1).reshape(T, 156)
    np.savez(
        tmp_path / "a_poses.npz",
        poses=poses,
        trans=TRANS,
        betas=np.zeros(16),
        mocap_framerate=120.0,
        gender=np.array("female"),
        dmpls=np.zeros((T, 8)),
    )
    sequence = read_poses(tmp_path / "a_poses.npz")
    assert (sequence.fps, sequence.model, sequence.up_axis) == (120.0, "smplh", "y")
    check(sequence, face=False, pelvis=SMPLH_FEMALE)
    assert any("z was up in the file" in note for note in sequence.notes)


@pytest.mark.parametrize("rate", ["mocap_frame_rate", "mocap_framerate"])
def test_amass_stageii(tmp_path, rate):
    arrays = {
        "root_orient": ROOT.reshape(T, 3),
        "pose_body": BODY.reshape(T, 63),
        "pose_hand": HANDS.reshape(T, 90),
        "pose_jaw": JAW.reshape(T, 3),
        "pose_eye": EYES.reshape(T, 6),
        "poses": np.concatenate([ROOT, BODY, JAW, EYES, HANDS], 1).reshape(T, 165),
        "trans": TRANS,
        "betas": np.full(16, 0.5),
        rate: 100.0,
        "gender": np.array(b"neutral"),
        "surface_model_type": np.array("smplx"),
        "labels": np.array(["a", None], dtype=object),  # AMASS holds such; they are not unpickled
    }
    np.savez(tmp_path / "b_stageii.npz", **arrays)
    sequence = read_poses(tmp_path / "b_stageii.npz")
    assert (sequence.fps, sequence.model) == (100.0, "smplx")
    np.testing.assert_array_equal(sequence.betas, np.full(16, 0.5))
    check(sequence, pelvis=SMPLX)
    assert any("betas it is off" in note for note in sequence.notes)


def plain_smplx(**changes):
    return {
        "global_orient": ROOT[:, 0],
        "body_pose": BODY.reshape(T, 63),
        "left_hand_pose": HANDS[:, :15].reshape(T, 45),
        "right_hand_pose": HANDS[:, 15:],
        "jaw_pose": JAW[:, 0],
        "leye_pose": EYES[:, 0],
        "reye_pose": EYES[:, 1],
        "transl": TRANS,
        **changes,
    }


def test_plain_smplx(tmp_path):
    np.savez(tmp_path / "c.npz", **plain_smplx(fps=25))
    sequence = read_poses(tmp_path / "c.npz")
    assert sequence.fps == 25.0
    check(sequence, rotation=np.eye(3), pelvis=SMPLX)
    assert any("y, because the trunk" in note for note in sequence.notes)
    assert any("absolute" in note for note in sequence.notes)
    check(read_poses(tmp_path / "c.npz", up="z"), pelvis=SMPLX)


def test_up_axis_is_seen_or_asked_for(tmp_path):
    np.savez(tmp_path / "c.npz", **plain_smplx(fps=25, global_orient=np.tile(UPRIGHT_Z, (T, 1))))
    upright = read_poses(tmp_path / "c.npz")
    np.testing.assert_allclose(upright.poses[:, 0], 0, atol=1e-12)
    lying = np.tile([0, 0, np.pi / 2], (T, 1))  # the trunk points along -x
    np.savez(tmp_path / "d.npz", **plain_smplx(fps=25, global_orient=lying))
    with pytest.raises(CaphyError, match=r"d\.npz.*--up"):
        read_poses(tmp_path / "d.npz")
    assert len(read_poses(tmp_path / "d.npz", up="y")) == T


def test_smpl_hands_are_left_out_and_said(tmp_path):
    np.savez(
        tmp_path / "s.npz", poses=np.concatenate([ROOT, BODY, HANDS[:, :2]], 1).reshape(T, 72), trans=TRANS, fps=30
    )
    sequence = read_poses(tmp_path / "s.npz", up="z")
    check(sequence, hands=False, face=False, pelvis=SMPL)
    assert any("hands" in note for note in sequence.notes)


def test_hand_pca_is_left_out_and_said(tmp_path):
    np.savez(
        tmp_path / "p.npz", **plain_smplx(fps=30, left_hand_pose=np.ones((T, 6)), right_hand_pose=np.ones((T, 12)))
    )
    sequence = read_poses(tmp_path / "p.npz")
    assert not sequence.poses[:, 25:].any()
    assert sum("PCA" in note for note in sequence.notes) == 2


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (plain_smplx(), "frame rate.*--fps"),
        ({"poses": np.zeros((T, 66)), "trans": TRANS, "fps": 30}, r"72 \(SMPL.*got shape \(6, 66\)"),
        ({"poses": np.zeros((T, 135)), "trans": TRANS, "fps": 30}, r"165 \(SMPL-X"),
        ({"poses": np.zeros((T, 156)), "fps": 30}, "translation, transl or trans"),
        (plain_smplx(fps=30, transl=TRANS[:4]), r"translation must be \(6, 3\)"),
        (plain_smplx(fps=30, transl=TRANS.T.copy()), r"translation must be \(6, 3\) like the poses, got \(3, 6\)"),
        (plain_smplx(fps=30, body_pose=np.zeros((T, 69))), "SMPL's 23 joints"),
        (plain_smplx(fps=30, body_pose=np.zeros((T, 60))), "body_pose must hold 6 x 63 values"),
        (plain_smplx(fps=30, jaw_pose=np.array(["x"])), "jaw_pose must be numbers"),
        (plain_smplx(fps=30, transl=np.full((T, 3), np.nan)), "transl must be finite.*frame 0"),
        ({"verts": np.zeros(3)}, "must hold poses; it has verts"),
    ],
)
def test_says_what_is_wrong(tmp_path, arrays, words):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(CaphyError, match=f"(?s)bad.npz.*{words}"):
        read_poses(tmp_path / "bad.npz")


def test_python_objects_are_never_unpickled(tmp_path):
    np.savez(tmp_path / "o.npz", poses=np.array([{"a": 1}], dtype=object), trans=TRANS, fps=30)
    with pytest.raises(CaphyError, match=r"poses must be numbers, got Python objects"):
        read_poses(tmp_path / "o.npz")


def gvhmr(**changes):
    part = {
        "global_orient": torch.tensor(ROOT[:, 0]),
        "body_pose": torch.tensor(BODY.reshape(T, 63)),
        "transl": torch.tensor(TRANS),
        "betas": torch.zeros(T, 10, dtype=torch.float64),
    }
    return {"smpl_params_global": part, "smpl_params_incam": part, "K_fullimg": torch.eye(3), **changes}


def test_gvhmr(tmp_path):
    torch.save(gvhmr(), tmp_path / "hmr4d_results.pt")
    with pytest.raises(CaphyError, match=r"nominal 30 Hz.*--fps"):
        read_poses(tmp_path / "hmr4d_results.pt")
    sequence = read_poses(tmp_path / "hmr4d_results.pt", fps=24)
    assert (sequence.fps, sequence.frame) == (24.0, "world")
    check(sequence, hands=False, face=False, rotation=np.eye(3), pelvis=SMPLX)


def test_gvhmr_seen_only_by_the_camera_is_flagged(tmp_path):
    results = gvhmr()
    del results["smpl_params_global"]
    torch.save(results, tmp_path / "r.pt")
    sequence = read_poses(tmp_path / "r.pt", fps=24)
    assert sequence.frame == "camera"
    assert any("gravity" in note for note in sequence.notes)
    check(sequence, hands=False, face=False, rotation=np.diag([1, -1, -1]), pelvis=SMPLX)


def test_gvhmr_says_what_is_wrong(tmp_path):
    torch.save({"smpl_params_global": {"betas": torch.zeros(3)}}, tmp_path / "r.pt")
    with pytest.raises(CaphyError, match="must hold smpl_params_global with"):
        read_poses(tmp_path / "r.pt", fps=30)
    (tmp_path / "r.pt").write_bytes(b"PK\x03\x04 no zip")
    with pytest.raises(CaphyError, match="cannot be read as tensors alone"):
        read_poses(tmp_path / "r.pt", fps=30)
    torch.save({"code": print}, tmp_path / "r.pt")
    with pytest.raises(CaphyError, match="cannot be read as tensors alone"):
        read_poses(tmp_path / "r.pt", fps=30)


def wham(persons=(0,), **changes):
    results = defaultdict(dict)
    for person in persons:
        results[person] = {
            "pose_world": np.concatenate([ROOT, BODY, HANDS[:, :2]], 1).reshape(T, 72),
            "trans_world": TRANS,
            "pose": np.zeros((T, 72), np.float32),
            "trans": np.zeros((T, 3), np.float32),
            "betas": np.asfortranarray(np.tile([[0.1, 0.3]], (T, 1))),
            "verts": np.zeros((T, 10, 3)),
            "frame_ids": np.arange(T),
            **changes,
        }
    return results


@pytest.mark.parametrize("compress", [0, 3, ("gzip", 3), ("bz2", 3), ("lzma", 3), ("xz", 3)])
def test_wham(tmp_path, compress):
    path = tmp_path / "wham_output.pkl"
    joblib.dump(wham(), path, compress=compress)
    with pytest.raises(CaphyError, match="--fps"):
        read_poses(path)
    sequence = read_poses(path, fps=29.97)
    assert (sequence.fps, sequence.model) == (29.97, "smpl")
    np.testing.assert_allclose(sequence.betas, [0.1, 0.3])
    check(sequence, hands=False, face=False, rotation=np.eye(3), pelvis=SMPL)


def test_wham_persons_and_gaps(tmp_path):
    path = tmp_path / "wham_output.pkl"
    joblib.dump(wham((0, 4)), path)
    with pytest.raises(CaphyError, match=r"2 persons \(0, 4\).*--person"):
        read_poses(path, fps=30)
    assert "person 4" in read_poses(path, fps=30, person=4).notes
    with pytest.raises(CaphyError, match="no person 7"):
        read_poses(path, fps=30, person=7)
    joblib.dump(wham(frame_ids=np.array([3, 4, 5, 8, 9, 10])), path)
    sequence = read_poses(path, fps=30)
    assert len(sequence) == 8
    assert any("2 frames were not detected and are interpolated: 6, 7" in note for note in sequence.notes)
    np.testing.assert_allclose(sequence.transl[3], TRANS[2] + (TRANS[3] - TRANS[2]) / 3)
    np.testing.assert_allclose(sequence.transl[5:], TRANS[3:])
    joblib.dump(wham(frame_ids=np.array([3, 4, 5, 5, 9, 10])), path)
    with pytest.raises(CaphyError, match="frame numbers must rise"):
        read_poses(path, fps=30)


def smplerx(folder, frame, person=0, t=None):
    t = frame if t is None else t
    np.savez(
        folder / f"{frame:05}_{person}.npz",
        global_orient=ROOT[t, 0][None],
        body_pose=BODY[t],
        left_hand_pose=HANDS[t, :15],
        right_hand_pose=HANDS[t, 15:],
        jaw_pose=JAW[t],
        leye_pose=EYES[t, :1],
        reye_pose=EYES[t, 1:],
        betas=np.zeros((1, 10)),
        expression=np.zeros((1, 10)),
        transl=TRANS[t][None],
    )


def test_smplerx(tmp_path):
    for frame in range(T):
        smplerx(tmp_path, frame)
    with pytest.raises(CaphyError, match="--fps"):
        read_poses(tmp_path)
    sequence = read_poses(tmp_path, fps=25)
    assert sequence.frame == "camera"
    check(sequence, rotation=np.diag([1, -1, -1]), pelvis=SMPLX, trans=0 * TRANS)  # a crop's camera knows no place
    assert any("condition it with translation feet" in note for note in sequence.notes)
    smplerx(tmp_path, 2, person=1)
    with pytest.raises(CaphyError, match="2 persons per frame"):
        read_poses(tmp_path, fps=25)
    assert len(read_poses(tmp_path, fps=25, person=0)) == T
    (tmp_path / "00003_0.npz").unlink()
    gappy = read_poses(tmp_path, fps=25, person=0)
    assert any("interpolated: 3" in note for note in gappy.notes)
    assert gappy.unseen.tolist() == [False, False, False, True, False, False]


def test_empty_missing_and_unknown(tmp_path):
    (tmp_path / "walk.fbx").write_text("")
    for path, words in (
        (tmp_path, "FRAME_PERSON"),
        (tmp_path / "no.npz", "no such file"),
        (tmp_path / "walk.fbx", "end in"),
    ):
        with pytest.raises(CaphyError, match=words):
            read_poses(path, fps=30)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"global_orient": np.tile(np.eye(3), (T, 1, 1, 1))}, "rotation matrices; save them as axis-angle"),
        ({"global_orient": np.ones((T, 6))}, "6D rotations; save them as axis-angle"),
    ],
)
def test_other_rotations_are_named(changes, words, tmp_path):
    np.savez(tmp_path / "c.npz", **plain_smplx(fps=25, **changes))
    with pytest.raises(CaphyError, match=words):
        read_poses(tmp_path / "c.npz")


def test_files_of_nothing_are_named(tmp_path):
    np.savez(tmp_path / "none.npz", poses=np.zeros((0, 165)), trans=np.zeros((0, 3)), mocap_frame_rate=120.0)
    with pytest.raises(CaphyError, match=r"none\.npz: holds no frames"):
        read_poses(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(CaphyError, match="no archive at all"):
        read_poses(tmp_path / "text.npz")


def test_what_a_format_does_not_ask_for_is_refused(tmp_path):
    np.savez(tmp_path / "one.npz", **plain_smplx(fps=30))
    with pytest.raises(CaphyError, match="holds one person; leave --person out"):
        read_poses(tmp_path / "one.npz", person=3)
    (tmp_path / "wham.pkl").write_bytes(b"")
    with pytest.raises(CaphyError, match="say their axes themselves; leave --up out"):
        read_poses(tmp_path / "wham.pkl", fps=25, up="z")
