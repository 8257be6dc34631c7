"""4D-Humans, PyMAF-X and TRAM: their layouts, written by joblib, numpy and torch as they do, and read back."""

from types import SimpleNamespace

import joblib
import numpy as np
import pytest
import torch

from caphy.conditioning import Conditioner, Conditioning
from caphy.conditioning.files import condition_sequence
from caphy.errors import CaphyError
from caphy.io.pickles import read_boxed, read_pickle
from caphy.io.poses import read_poses
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

T = 8
RNG = np.random.default_rng(5)
TURNS = RNG.normal(0, 0.3, (T, 55, 3))
UPSIDE = np.diag([1.0, -1.0, -1.0])  # from a camera's axes to y up
TURNS[:, 0] = axis_angle_from_matrix(UPSIDE @ matrix_from_axis_angle(0.1 * TURNS[:, 0]))  # stands in front of a camera
TRANSL = np.array([0.2, 0.9, 4.0]) + RNG.normal(0, 0.05, (T, 3))
MATRICES = matrix_from_axis_angle(TURNS)
SMPL, SMPLX = np.array([-0.0017951, -0.2233338, 0.0282192]), np.array([0.0031233, -0.3514075, 0.0120366])
WIDTH, HEIGHT = 1920, 1080
DIAGONAL = np.hypot(WIDTH, HEIGHT)


def check(sequence, joints, pelvis, transl=TRANSL, turns=TURNS):
    """As seen by a camera, turned level: joints are those of SMPL-X, the pelvis stands where the file says."""
    assert (sequence.frame, sequence.up_axis) == ("camera", "y")
    root = matrix_from_axis_angle(sequence.poses[:, 0])
    np.testing.assert_allclose(root, UPSIDE @ matrix_from_axis_angle(turns[:, 0]), atol=1e-6)
    np.testing.assert_allclose(sequence.poses[:, 1:joints], turns[:, 1:joints], atol=1e-6)
    np.testing.assert_array_equal(sequence.poses[:, joints:], 0 if joints < 55 else sequence.poses[:, joints:])
    np.testing.assert_allclose(sequence.transl + pelvis, (transl + pelvis) @ UPSIDE, atol=1e-5)


def phalp(tracks=(3,), seen=None, **changes):
    """As PHALP.track() gathers it: one dictionary by picture, lists by track, embeddings as tensors."""
    frames = {}
    far = TRANSL * [1, 1, 5000 / 256 * max(WIDTH, HEIGHT) / DIAGONAL]
    for t in range(T):
        smpl = {
            "global_orient": MATRICES[t, :1].astype(np.float32),
            "body_pose": np.concatenate([MATRICES[t, 1:22], MATRICES[t, 25:27]]).astype(np.float32),
            "betas": np.linspace(0, 0.1, 10, dtype=np.float32),
        }
        since = 0 if seen is None or t in seen else 1
        frames[f"outputs/_DEMO/x/img/{t + 1:06d}.jpg"] = {
            "time": t,
            "shot": 0,
            "tracked_ids": list(tracks),
            "tid": list(tracks),
            "tracked_time": [since] * len(tracks),
            "bbox": [np.array([1.0, 2.0, 3.0, 4.0])] * len(tracks),
            "conf": [np.float32(0.9)] * len(tracks),
            "size": [[HEIGHT, WIDTH]] * len(tracks),
            "smpl": [smpl] * len(tracks),
            "camera": [(far[t] if since == 0 else far[t] + 9).astype(np.float32)] * len(tracks),
            "embedding": [torch.arange(5.0)] * len(tracks),
            **changes,
        }
    return frames


def test_4d_humans(tmp_path):
    path = tmp_path / "demo_x.pkl"
    joblib.dump(phalp(), path, compress=3)
    with pytest.raises(CaphyError, match=r"demo_x\.pkl: PHALP.*--fps"):
        read_poses(path)
    sequence = read_poses(path, fps=25)
    assert (sequence.fps, sequence.model) == (25.0, "smpl")
    np.testing.assert_allclose(sequence.betas, np.linspace(0, 0.1, 10), atol=1e-6)
    check(sequence, 22, SMPL)
    assert "track 3" in sequence.notes


def test_4d_humans_nearer_people_are_seen_at_the_same_place():
    far = phalp()
    frame = next(iter(far.values()))
    assert frame["camera"][0][2] > 50  # what PHALP says of a person 4 m away
    pixel = 5000 / 256 * WIDTH * frame["camera"][0][:2] / frame["camera"][0][2]
    np.testing.assert_allclose(pixel, DIAGONAL * TRANSL[0, :2] / TRANSL[0, 2], rtol=1e-5)


def test_4d_humans_tracks_and_gaps(tmp_path):
    path = tmp_path / "demo_x.pkl"
    joblib.dump(phalp((3, 8)), path)
    with pytest.raises(CaphyError, match=r"2 tracks: 3 \(8 frames\), 8 \(8 frames\).*--person"):
        read_poses(path, fps=25)
    check(read_poses(path, fps=25, person=8), 22, SMPL)
    with pytest.raises(CaphyError, match="no track 5"):
        read_poses(path, fps=25, person=5)
    joblib.dump(phalp(seen={0, 1, 2, 4, 5, 6, 7}), path)
    sequence = read_poses(path, fps=25)
    assert any("1 frames were not detected and are interpolated: 3" in note for note in sequence.notes)
    np.testing.assert_allclose(sequence.transl[3], (sequence.transl[2] + sequence.transl[4]) / 2, atol=1e-6)
    joblib.dump(phalp(seen=set()), path)
    with pytest.raises(CaphyError, match="nobody was tracked in its 8 frames"):
        read_poses(path, fps=25)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"smpl": []}, r"000001\.jpg: must hold time, and lists of one length.*smpl 0"),
        ({"smpl": [{"betas": np.zeros(10)}]}, "frame 0: smpl must hold global_orient, body_pose and betas"),
        ({"camera": [np.zeros(2)]}, r"frame 0: must hold numbers of shape \(3,\), got float64 of shape \(2,\)"),
        (
            {"smpl": [{"global_orient": np.eye(3), "body_pose": np.ones((23, 3, 3)), "betas": np.zeros(10)}]},
            "frame 0: must be rotations; 23 of 24 matrices are not",
        ),
    ],
)
def test_4d_humans_says_what_is_wrong(tmp_path, changes, words):
    joblib.dump(phalp(**changes), tmp_path / "bad.pkl")
    with pytest.raises(CaphyError, match=f"bad.pkl.*{words}"):
        read_poses(tmp_path / "bad.pkl", fps=30)


def pymafx(person_ids=None, frame_ids=None, batch=3, **changes):
    """As apps/demo_smplx.py saves it: tensors in batches of the network, arrays joined."""
    order = {"body_pose": (0, 22), "jaw_pose": (22, 23), "leye_pose": (23, 24), "reye_pose": (24, 25)}
    order |= {"left_hand_pose": (25, 40), "right_hand_pose": (40, 55)}
    parts = {name: torch.tensor(MATRICES[:, a:b], dtype=torch.float32) for name, (a, b) in order.items()}
    parts |= {"shape": torch.full((T, 10), 0.2), "expression": torch.zeros(T, 10)}
    box, scale = 700.0, 0.9
    return {
        "pred_cam": np.tile([scale, 0.1, 0.2], (T, 1)).astype(np.float32),
        "orig_cam": np.tile([scale * box / WIDTH, scale * box / HEIGHT, 0.0, 0.0], (T, 1)),
        "orig_cam_t": TRANSL * [1, 1, 5000 / DIAGONAL],
        "bboxes": np.tile([900.0, 500.0, box, box], (T, 1)),
        "frame_ids": np.arange(T) if frame_ids is None else frame_ids,
        "person_ids": [f"000{t}_f{t}_p0" for t in range(T)] if person_ids is None else person_ids,
        "smplx_params": [{name: part[i : i + batch] for name, part in parts.items()} for i in range(0, T, batch)],
        **changes,
    }


def test_pymafx(tmp_path):
    path = tmp_path / "output.pkl"
    joblib.dump(pymafx(), path)
    with pytest.raises(CaphyError, match="--fps"):
        read_poses(path)
    sequence = read_poses(path, fps=30)
    assert sequence.model == "smplx"
    np.testing.assert_allclose(sequence.betas, 0.2, atol=1e-6)
    check(sequence, 55, SMPLX)


def test_pymafx_persons_and_their_order(tmp_path):
    path = tmp_path / "output.pkl"
    joblib.dump(pymafx([f"x_f{t // 2}_p{t % 2}" for t in range(T)], np.arange(T) // 2), path)
    with pytest.raises(CaphyError, match=r"2 persons \(0, 1\).*--person"):
        read_poses(path, fps=30)
    np.testing.assert_allclose(read_poses(path, fps=30, person=1).poses[:, 1:], TURNS[1::2, 1:], atol=1e-6)
    with pytest.raises(CaphyError, match="no person 7"):
        read_poses(path, fps=30, person=7)
    joblib.dump(pymafx(frame_ids=np.arange(T)[::-1]), path)  # detections come in any order
    np.testing.assert_allclose(read_poses(path, fps=30).poses[:, 1:], TURNS[::-1, 1:], atol=1e-6)


def test_pymafx_without_a_camera_says_so(tmp_path):
    results = pymafx()
    del results["orig_cam_t"]
    joblib.dump(results, tmp_path / "output.pkl")
    sequence = read_poses(tmp_path / "output.pkl", fps=30)
    assert any("translation feet" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"smplx_params": []}, "smplx_params is empty"),
        ({"smplx_params": [{"body_pose": np.zeros((8, 21, 3, 3))}]}, r"body_pose must have shape \(batch, 22, 3, 3\)"),
        ({"person_ids": []}, "frame_ids and person_ids must have 8 entries, got 8, 0"),
        ({"orig_cam": np.zeros((T, 4))}, "must tell the picture's size"),
        ({"bboxes": np.zeros((T, 3))}, r"bboxes must be numbers of shape \(8, 4\), got \(8, 3\)"),
        ({"orig_cam_t": np.full((T, 3), np.nan)}, "transl must be finite"),
    ],
)
def test_pymafx_says_what_is_wrong(tmp_path, changes, words):
    joblib.dump(pymafx(**changes), tmp_path / "bad.pkl")
    with pytest.raises(CaphyError, match=f"bad.pkl.*{words}"):
        read_poses(tmp_path / "bad.pkl", fps=30)


def tram(folder, camera=False, **changes):
    """As scripts/estimate_humans.py and estimate_camera.py save them: dictionaries in object arrays."""
    (folder / "hps").mkdir(exist_ok=True)
    matrices = np.concatenate([MATRICES[:, :22], MATRICES[:, 25:27]], axis=1)
    results = {
        "pred_cam": torch.zeros(T, 3),
        "pred_pose": torch.zeros(T, 144),
        "pred_shape": torch.full((T, 10), 0.3),
        "pred_rotmat": torch.tensor(matrices, dtype=torch.float32),
        "pred_trans": torch.tensor(TRANSL[:, None], dtype=torch.float32),
        "frame": torch.arange(2, T + 2),
        **changes,
    }
    np.save(folder / "hps" / "hps_track_0.npy", results)
    if camera:
        angles = np.linspace(0, 0.5, T + 2)[:, None] * [0.0, 1.0, 0.2]
        turns, moves = matrix_from_axis_angle(angles), np.linspace(0, 1, T + 2)[:, None] * [1.0, 0.0, 0.5]
        saved = {
            "pred_cam_R": turns.astype(np.float32),
            "pred_cam_T": moves.astype(np.float32),
            "img_focal": np.float64(1500.0),
            "img_center": np.array([960.0, 540.0]),
        }
        np.save(folder / "camera.npy", saved)
        return SimpleNamespace(path=folder / "hps" / "hps_track_0.npy", turns=turns[2:], moves=moves[2:])
    return SimpleNamespace(path=folder / "hps" / "hps_track_0.npy")


def test_tram(tmp_path):
    made = tram(tmp_path)
    with pytest.raises(CaphyError, match="--fps"):
        read_poses(made.path)
    sequence = read_poses(made.path, fps=30)
    assert sequence.model == "smpl"
    np.testing.assert_allclose(sequence.betas, 0.3, atol=1e-6)
    check(sequence, 22, SMPL)
    assert any("taken as still" in note for note in sequence.notes)


def test_tram_with_a_moving_camera_stands_in_the_first_picture(tmp_path):
    made = tram(tmp_path, camera=True)
    sequence = read_poses(made.path, fps=30)
    turns = TURNS.copy()
    turns[:, 0] = axis_angle_from_matrix(made.turns @ MATRICES[:, 0])
    joint = np.einsum("tij,tj->ti", made.turns, TRANSL + SMPL) + made.moves  # a point on the body, as TRAM moves it
    check(sequence, 22, SMPL, joint - SMPL, turns)
    still = tram(tmp_path, frame=torch.arange(T) + 9)
    with pytest.raises(CaphyError, match=r"camera\.npy: holds 10 pictures, the track those from 9 to 16"):
        read_poses(still.path, fps=30)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pred_rotmat": None}, "must hold pred_rotmat"),
        ({"pred_trans": torch.zeros(T, 3)}, r"pred_trans must have shape \(8, 1, 3\), got \(8, 3\)"),
        ({"pred_rotmat": torch.ones(T, 24, 3, 3)}, "pred_rotmat: must be rotations; 192 of 192"),
        ({"frame": torch.zeros(T, dtype=torch.int64)}, "frame numbers must rise"),
        ({"pred_shape": torch.zeros(T, 10, dtype=torch.bfloat16)}, "tensors of torch.BFloat16Storage are not read"),
    ],
)
def test_tram_says_what_is_wrong(tmp_path, changes, words):
    made = tram(tmp_path, **changes)
    with pytest.raises(CaphyError, match=f"hps_track_0.npy.*{words}"):
        read_poses(made.path, fps=30)


@pytest.mark.parametrize("kind", ["phalp", "pymafx", "tram"])
def test_they_go_through_conditioning(tmp_path, kind):
    """Still people come out upright and where they were, at the avatar's rate."""
    path = tmp_path / "x.pkl"
    if kind == "tram":
        path = tram(tmp_path).path
    else:
        joblib.dump(phalp() if kind == "phalp" else pymafx(), path)
    sequence = read_poses(path, fps=25)
    made = condition_sequence(sequence, Conditioner(Conditioning(fps=30.0, frame="camera", translation="given")))
    assert (made.frame, made.up_axis, made.fps) == ("world", "y", 30.0)
    assert len(made) == round((T - 1) / 25 * 30) + 1
    up = matrix_from_axis_angle(made.poses[:, 0])[:, 1, 1]
    assert (up > np.cos(np.radians(25))).all()
    np.testing.assert_allclose(np.linalg.norm(made.transl - made.transl.mean(axis=0), axis=1), 0, atol=0.2)


def test_tensors_come_back_as_they_were(tmp_path):
    base = torch.arange(24, dtype=torch.float64).reshape(2, 3, 4)
    kept = {
        "plain": base,
        "turned": base.permute(2, 0, 1),
        "part": base[1:, ::2, 1:],
        "one": torch.tensor(4.5),
        "none": torch.zeros(0, 3),
        "wide": torch.ones(1).expand(5, 2),
        **{
            str(kind): torch.tensor([0, 1, 2]).to(kind) for kind in (torch.float16, torch.int8, torch.uint8, torch.bool)
        },
        **{str(kind): torch.tensor([-1, 1, 2]).to(kind) for kind in (torch.float32, torch.int16, torch.int32)},
    }
    joblib.dump(kept, tmp_path / "a.pkl")
    found = read_pickle(tmp_path / "a.pkl")
    for name, tensor in kept.items():
        assert found[name].dtype == tensor.numpy().dtype, name
        np.testing.assert_array_equal(found[name], tensor.numpy(), name)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("_rebuild_tensor_v2", (np.zeros(3), 1, (3,), (1,), False, {})),
        ("_rebuild_tensor_v2", (np.zeros(3), 0, (2**20, 2**20), (0, 0), False, {})),
        ("_rebuild_tensor_v2", (np.zeros(3), 0, (3,), (-1,), False, {})),
        ("_rebuild_tensor_v2", (b"abc", 0, (3,), (1,), False, {})),
    ],
)
def test_tensors_that_reach_beyond_their_numbers_are_refused(tmp_path, name, arguments):
    class Handmade:
        def __reduce__(self):
            return getattr(torch._utils, name), arguments

    joblib.dump({"x": Handmade()}, tmp_path / "a.pkl")
    with pytest.raises(CaphyError, match=r"a\.pkl.*not read"):
        read_pickle(tmp_path / "a.pkl")


def test_boxes_hold_one_object_and_no_programs(tmp_path):
    class Program:
        def __reduce__(self):
            return exec, ("raise SystemError",)

    np.save(tmp_path / "a.npy", {"x": Program()})
    with pytest.raises(CaphyError, match=r"a\.npy.*builtins\.exec is not on the list"):
        read_boxed(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(CaphyError, match="holds an array of float64"):
        read_boxed(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", {"x": np.array([1, "a"], dtype=object)})
    assert read_boxed(tmp_path / "a.npy") == {"x": [1, "a"]}
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-20])
    with pytest.raises(CaphyError, match=r"a\.npy.*damaged"):
        read_boxed(tmp_path / "a.npy")
