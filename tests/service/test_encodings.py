"""Every encoding against float32 on real motion: the worst error that docs/protocol.md states, and no more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import caphy
from caphy.body.skinning import blend_transforms, skin
from caphy.errors import CaphyError
from caphy.io.blend_shapes import blend_shapes
from caphy.io.bundle import AvatarBundle, read_bundle
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from service.client import Client
from service.encodings import Encoding, JointMotion, Meshes, decode_meshes, encode_meshes
from service.engine import GarmentEngine
from service.errors import Problem
from service.frames import Wanted, answer
from service.normals import VertexNormals
from service.protocol import FramesRequest, FramesResponse, decode_response, encode_response

STATED_MM = {Encoding.FLOAT16: 0.5, Encoding.UINT16: 0.03, Encoding.WEIGHTS: 0.2}
"""Worst vertex error [mm] in docs/protocol.md."""
STATED_DEGREES = 0.5
"""Worst error of a normal in docs/protocol.md."""


@pytest.fixture(scope="module")
def default() -> AvatarBundle:
    return read_bundle(Path(caphy.__file__).parent / "data" / "avatars" / "default")


@pytest.fixture(scope="module")
def walk() -> PoseSequence:
    """Walking metres away from the origin, where half floats are coarse."""
    motion = procedural_motion(seed=5, seconds=3)
    return PoseSequence(
        poses=motion.poses, transl=motion.transl + np.array([7.3, 0.4, -9.1]), fps=motion.fps, source="walk"
    )


@pytest.fixture(scope="module")
def engines(default) -> list[GarmentEngine]:
    return [GarmentEngine(garment) for garment in default.garments]


def answered(default, engines, walk, encoding: str = "float32", normals: bool = False) -> FramesResponse:
    request = FramesRequest(walk.poses, walk.transl, walk.fps, np.zeros(0))
    return answer(request, engines, default.fps, Wanted.of(encoding, normals), default.joints[0])


@pytest.fixture(scope="module")
def plain(default, engines, walk) -> FramesResponse:
    return answered(default, engines, walk)


def distance_mm(a: np.ndarray, b: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(a - b, axis=-1).max())


@pytest.mark.parametrize("encoding", [Encoding.FLOAT16, Encoding.UINT16])
def test_vertices_come_back_within_the_stated_error(default, engines, walk, plain, encoding):
    response = answered(default, engines, walk, encoding.label)
    found = decode_response(b"".join(encode_response(response)))
    assert found.encoding is encoding
    assert list(found.vertices) == list(plain.vertices)
    for name, vertices in plain.vertices.items():
        error = distance_mm(found.vertices[name], vertices)
        assert STATED_MM[encoding] / 20 < error < STATED_MM[encoding]
        np.testing.assert_array_equal(found.states[name], plain.states[name])


def test_packed_answers_are_half_the_size(default, engines, walk, plain):
    size = len(b"".join(encode_response(plain)))
    for encoding in ("float16", "uint16"):
        assert len(b"".join(encode_response(answered(default, engines, walk, encoding)))) < 0.51 * size


@pytest.mark.parametrize("value", [1e5, -1e5, np.nan])
def test_what_half_floats_cannot_hold_is_no_infinity(value):
    joints = JointMotion(np.zeros((1, 3)), np.zeros((1, 55, 4)))
    for meshes, encoding in (
        (Meshes(1, weights={"tshirt": np.array([[0.5, value]], "f4")}, joints=joints), Encoding.WEIGHTS),
        (Meshes(1, {"tshirt": np.array([[[0, 0, 0], [0, 2 * value, 0]]], "f4")}), Encoding.FLOAT16),
    ):
        with pytest.raises(Problem, match="half floats"):
            encode_meshes(meshes, encoding)


def test_weights_and_joints_make_the_vertices(default, engines, walk, plain):
    """Blend shapes from the graph, skinned by the joints that a GLB's skeleton takes: glTF's formula in float64."""
    response = answered(default, engines, walk, "weights")
    body = b"".join(encode_response(response))
    assert len(body) / len(walk) < 2100  # bytes a frame, two garments, states included
    found = decode_response(body)
    assert found.joints is not None
    transforms = posed_skeleton(default, found.joints)
    for garment in default.garments:
        shapes = blend_shapes(garment)
        points = shapes.base + np.tensordot(found.weights[garment.name].astype(np.float64), shapes.targets, axes=1)
        blended = blend_transforms(garment.mesh.dense_weights(), transforms)
        assert distance_mm(skin(blended, points), plain.vertices[garment.name]) < STATED_MM[Encoding.WEIGHTS]
        np.testing.assert_array_equal(found.states[garment.name], plain.states[garment.name])


def posed_skeleton(bundle: AvatarBundle, joints: JointMotion) -> np.ndarray:
    """Joint matrices (T, 55, 3, 4) as glTF computes them: global transform times inverse bind matrix."""
    x, y, z, w = np.moveaxis(joints.rotations.astype(np.float64), -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    local = np.zeros((*x.shape, 4, 4))
    local[..., :3, :3] = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    local[..., 3, 3] = 1
    found = np.zeros_like(local)
    for joint, parent in enumerate(bundle.parents):
        local[:, joint, :3, 3] = joints.root if parent < 0 else bundle.joints[joint] - bundle.joints[parent]
        found[:, joint] = local[:, joint] if parent < 0 else found[:, parent] @ local[:, joint]
    bind = np.tile(np.eye(4), (len(bundle.parents), 1, 1))
    bind[:, :3, 3] = -bundle.joints
    return (found @ bind)[..., :3, :]


def test_normals_are_trimeshs(default, engines, walk):
    response = answered(default, engines, walk[:20], "uint16", normals=True)
    found = decode_response(b"".join(encode_response(response)))
    for garment in default.garments:
        for frame in (0, 19):
            vertices = response.vertices[garment.name][frame]
            mesh = trimesh.Trimesh(vertices, garment.mesh.faces, process=False)
            areas = mesh.area_faces[:, None] * mesh.face_normals
            expected = np.zeros_like(vertices, dtype=float)
            np.add.at(expected, garment.mesh.faces.ravel(), np.repeat(areas, 3, axis=0))
            expected /= np.linalg.norm(expected, axis=1, keepdims=True)
            np.testing.assert_allclose(response.normals[garment.name][frame], expected, atol=2e-4)
            received = found.normals[garment.name][frame]
            received = received / np.linalg.norm(received, axis=1, keepdims=True)
            sine = np.linalg.norm(np.cross(received, expected), axis=1)
            assert np.degrees(np.arcsin(sine.max())) < STATED_DEGREES


def test_normals_of_what_has_no_area_are_zero():
    normals = VertexNormals(np.array([[0, 1, 2], [0, 2, 1]]), 5)
    found = normals(np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [6, 6, 6]]], np.float32))
    np.testing.assert_array_equal(found, np.zeros((1, 5, 3)))


@given(
    encoding=st.sampled_from([Encoding.FLOAT32, Encoding.FLOAT16, Encoding.UINT16]),
    frames=st.integers(0, 3),
    counts=st.lists(st.integers(1, 6), min_size=1, max_size=3),
    normals=st.booleans(),
    extent=st.sampled_from([0.0, 1e-6, 1.0, 1000.0]),
    seed=st.integers(0, 99),
)
def test_any_mesh_survives(encoding, frames, counts, normals, extent, seed):
    rng = np.random.default_rng(seed)
    vertices = {f"g{i}": (extent * rng.random((frames, count, 3))).astype(np.float32) for i, count in enumerate(counts)}
    unit = {name: np.tile(np.float32([0, 0, 1]), (*array.shape[:2], 1)) for name, array in vertices.items()}
    body = b"head" + b"".join(encode_meshes(Meshes(frames, vertices, unit if normals else {}), encoding))
    assert len(body) % 4 == 0
    sizes = {name: array.shape[1] for name, array in vertices.items()}
    found, end = decode_meshes(body, 4, encoding, frames, sizes, normals)
    assert end == len(body)
    worst = {Encoding.FLOAT32: 0, Encoding.FLOAT16: 2**-12, Encoding.UINT16: 0.53 / 65535}[encoding]
    least = 2**-25 if encoding is Encoding.FLOAT16 else 0  # half of the smallest half float
    for name, expected in vertices.items():
        np.testing.assert_allclose(found.vertices[name], expected, rtol=0, atol=worst * extent + least)
        if normals:
            np.testing.assert_array_equal(found.normals[name], unit[name])
    for cut in range(4, len(body), 5):
        with pytest.raises(CaphyError, match="cut short"):
            decode_meshes(body[:cut], 4, encoding, frames, sizes, normals)


def test_what_cannot_be_had_is_refused():
    with pytest.raises(Problem, match="encoding: must be one of float32, float16"):
        Wanted.of("zip", False)
    with pytest.raises(Problem, match="GLB"):
        Wanted.of("weights", True)


def test_over_http(http, motion, bundle):
    from test_app import BINARY, FRAMES, body_of, refused

    plain = decode_response(http.post(FRAMES, content=body_of(motion), headers=BINARY).content)
    packed = decode_response(
        http.post(FRAMES + "?encoding=uint16&normals=true", content=body_of(motion), headers=BINARY).content
    )
    for garment in bundle.garments:
        name = garment.name
        assert 0 < distance_mm(packed.vertices[name], plain.vertices[name]) < STATED_MM[Encoding.UINT16]
        assert packed.normals[name].shape == plain.vertices[name].shape
    weights = decode_response(http.post(FRAMES + "?encoding=weights", content=body_of(motion), headers=BINARY).content)
    assert weights.joints is not None
    assert weights.joints.rotations.shape == (len(motion), 55, 4)
    refused(http.post(FRAMES + "?encoding=zip", content=body_of(motion), headers=BINARY), 422, "encoding")
    refused(http.post(FRAMES + "?encoding=weights&normals=1", content=body_of(motion), headers=BINARY), 422, "GLB")
    asked = {**BINARY, "accept": "application/json"}
    refused(http.post(FRAMES + "?encoding=uint16", content=body_of(motion), headers=asked), 422, "binary")


def test_the_http_client_takes_every_encoding(url, motion):
    client = Client(url)
    plain = client.run("shell", motion[:4])
    packed = client.run("shell", motion[:4], ["trousers"], encoding="uint16", normals=True)
    assert list(packed.vertices) == list(packed.normals) == ["trousers"]
    assert 0 < distance_mm(packed.vertices["trousers"], plain.vertices["trousers"]) < STATED_MM[Encoding.UINT16]
    assert set(client.run("shell", motion[:4], encoding="weights").weights) == set(plain.vertices)
