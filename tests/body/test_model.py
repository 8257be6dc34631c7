"""The SMPL-X-format loader and its one skinning path against the published formula."""

import re

import numpy as np
import pytest
from smplx_file import posed_by_loops, random_arrays

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.errors import CaphyError


def saved(folder, arrays):
    np.savez(folder / "body.npz", **arrays)
    return folder / "body.npz"


def random_poses(count, seed=0):
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 55, 3)) * 0.7, random.normal(size=(count, 3))


@pytest.mark.parametrize(
    ("shape_count", "betas", "expression"), [(20, 10, 10), (20, 4, 0), (400, 300, 100), (400, 10, 10)]
)
def test_posed_vertices_are_those_of_the_formula(tmp_path, shape_count, betas, expression):
    arrays = random_arrays(shape_count=shape_count)
    body = BodyModel.load(saved(tmp_path, arrays))
    poses, transl = random_poses(2)
    random = np.random.default_rng(1)
    b, e = random.normal(size=betas), random.normal(size=expression)
    posed = body.pose(poses, transl, b, e if expression else None)
    first_expression = 300 if shape_count == 400 else 10
    coefficients = dict(enumerate(b)) | {first_expression + k: x for k, x in enumerate(e)}
    for t in range(2):
        expected, _ = posed_by_loops(arrays, poses[t], transl[t], coefficients)
        np.testing.assert_allclose(posed[t], expected, atol=1e-12)


def test_posed_joints_are_those_of_the_formula(tmp_path):
    arrays = random_arrays()
    poses, transl = random_poses(1)
    betas = np.random.default_rng(2).normal(size=10)
    joints = BodyModel.load(saved(tmp_path, arrays)).posed_joints(poses, transl, betas)
    expected = posed_by_loops(arrays, poses[0], transl[0], dict(enumerate(betas)))[1]
    np.testing.assert_allclose(joints[0], expected, atol=1e-12)


def test_many_frames_equal_one_by_one(tmp_path):
    body = BodyModel.load(saved(tmp_path, random_arrays()))
    poses, transl = random_poses(130)
    together = body.pose(poses, transl)
    one_by_one = np.concatenate([body.pose(poses[t : t + 1], transl[t : t + 1]) for t in range(130)])
    np.testing.assert_allclose(together, one_by_one, atol=1e-13)


def test_zero_pose_is_the_template(tmp_path):
    arrays = random_arrays()
    body = BodyModel.load(saved(tmp_path, arrays))
    np.testing.assert_allclose(body.pose(np.zeros((1, 55, 3)))[0], arrays["v_template"], atol=1e-13)


def test_the_root_turns_about_the_pelvis(tmp_path):
    body = BodyModel.load(saved(tmp_path, random_arrays()))
    poses, transl = random_poses(1)
    pelvis = body.posed_joints(poses, transl)[0, 0]
    np.testing.assert_allclose(pelvis, body.joints[0] + transl[0], atol=1e-13)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("count", [6, 12, 45])
@pytest.mark.parametrize("side", ["left", "right"])
def test_hand_pca(tmp_path, side, count, flat):
    arrays = random_arrays()
    body = BodyModel.load(saved(tmp_path, arrays))
    coefficients = np.random.default_rng(3).normal(size=(2, count))
    pose = body.hand_pose(coefficients, side, flat_hand_mean=flat)
    for t in range(2):
        expected = np.zeros(45) if flat else arrays[f"hands_mean{side[0]}"].copy()
        for k in range(count):
            expected += coefficients[t, k] * arrays[f"hands_components{side[0]}"][k]
        np.testing.assert_allclose(pose[t].ravel(), expected, atol=1e-13)


@pytest.fixture(scope="module")
def full_size_file(tmp_path_factory):
    """As many vertices as SMPL-X has, which the smplx package insists on, and its landmark keys."""
    arrays = random_arrays(vertex_count=10475)
    arrays = {key: a.astype(np.float32) if a.dtype == np.float64 else a for key, a in arrays.items()}
    arrays["lmk_faces_idx"] = np.zeros(51, dtype=np.int64)
    arrays["lmk_bary_coords"] = np.full((51, 3), 1 / 3)
    path = tmp_path_factory.mktemp("smplx") / "SMPLX_NEUTRAL.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("flat", [True, False])
def test_equals_the_smplx_package(full_size_file, flat):
    smplx = pytest.importorskip("smplx", reason="the smplx package is non-commercial and only an oracle")
    import torch

    poses, transl = random_poses(2)
    random = np.random.default_rng(4)
    betas, expression, hands = random.normal(size=10), random.normal(size=10), random.normal(size=(2, 2, 6))
    stock = smplx.SMPLX(
        str(full_size_file), num_betas=10, num_pca_comps=6, flat_hand_mean=flat, batch_size=2, dtype=torch.float64
    )
    part = {
        "global_orient": poses[:, 0],
        "body_pose": poses[:, 1:22].reshape(2, -1),
        "jaw_pose": poses[:, 22],
        "leye_pose": poses[:, 23],
        "reye_pose": poses[:, 24],
        "left_hand_pose": hands[0],
        "right_hand_pose": hands[1],
        "transl": transl,
        "betas": np.tile(betas, (2, 1)),
        "expression": np.tile(expression, (2, 1)),
    }
    expected = stock(**{name: torch.as_tensor(array) for name, array in part.items()})
    body = BodyModel.load(full_size_file)
    poses[:, 25:40] = body.hand_pose(hands[0], "left", flat_hand_mean=flat)
    poses[:, 40:55] = body.hand_pose(hands[1], "right", flat_hand_mean=flat)
    mine = body.pose(poses, transl, betas, expression)
    np.testing.assert_allclose(mine, expected.vertices.detach().numpy(), atol=1e-6)  # it adds 1e-8 to axis-angles


def without(key):
    return lambda arrays: arrays.pop(key) is None


def replaced(key, value):
    return lambda arrays: arrays.__setitem__(key, value)


def wrong_parent(arrays):
    arrays["kintree_table"][0, 20] = 3


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        *(
            (without(key), f"key '{key}' is missing")
            for key in ("v_template", "f", "weights", "kintree_table", "shapedirs")
        ),
        (without("J_regressor"), "key 'J_regressor' is missing"),
        (replaced("weights", np.ones((30, 24))), r"'weights' must have shape \(30, 55\), got \(30, 24\).*SMPL-H"),
        (replaced("posedirs", np.ones((30, 3, 207))), "'posedirs' must have shape"),
        (replaced("v_template", np.full((30, 3), np.nan)), "'v_template' contains NaN"),
        (replaced("f", np.full((2, 3), 30)), "'f' must index vertices 0 to 29, got 30"),
        (replaced("J_regressor", np.array({"sparse": 1})), "'J_regressor' is not a plain numeric array"),
        (wrong_parent, "joint 20 must hang on 18, got 3"),
    ],
)
def test_a_bad_file_is_named_with_its_key(tmp_path, spoil, message):
    arrays = random_arrays()
    spoil(arrays)
    with pytest.raises(CaphyError, match=message) as caught:
        BodyModel.load(saved(tmp_path, arrays))
    assert str(tmp_path / "body.npz") in str(caught.value)


def test_a_file_that_is_no_npz(tmp_path):
    with pytest.raises(CaphyError, match="no such body model"):
        BodyModel.load(tmp_path / "nothing.npz")
    for name, content in {"text.npz": b"hello", "empty.npz": b"", "cut.npz": b"PK\x03\x04broken"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CaphyError, match=re.escape(name)):
            BodyModel.load(tmp_path / name)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(CaphyError, match=r"SMPL-X-format \.npz"):
        BodyModel.load(tmp_path / "array.npy")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda body: body.pose(np.zeros((2, 24, 3))), r"\(T, 55, 3\).*got \(2, 24, 3\)"),
        (lambda body: body.pose(np.zeros((2, 55, 3)), np.zeros((3, 3))), r"transl must have shape \(2, 3\)"),
        (lambda body: body.rest(np.zeros(11)), r"betas: this body takes 1 to 10 coefficients, got shape \(11,\)"),
        (lambda body: body.rest(3.0), "betas"),
        (lambda body: body.rest(np.zeros((2, 10))), "betas"),
    ],
)
def test_wrong_shapes_are_refused(tmp_path, call, message):
    body = BodyModel.load(saved(tmp_path, random_arrays()))
    with pytest.raises(CaphyError, match=message):
        call(body)


@pytest.mark.parametrize("coefficient", [1e9, np.nan, -np.inf])
def test_coefficients_of_nobody_are_refused(coefficient):
    with pytest.raises(CaphyError, match="betas must be numbers from -30 to 30"):
        default_body().rest(np.array([0.0, coefficient]))
