"""The GLB against the service, evaluated by plain loops that know nothing but the glTF 2.0 specification."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from caphy.report.gltf import Gltf
from export.glb import animated_glb

COMPONENTS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A reader of its own."""

    def __init__(self, content: bytes) -> None:
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        json_length, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        self.json = json.loads(content[20 : 20 + json_length])
        binary_length, kind = struct.unpack_from("<I4s", content, 20 + json_length)
        assert kind == b"BIN\0"
        self.binary = content[28 + json_length :]
        assert len(self.binary) == binary_length == self.json["buffers"][0]["byteLength"]

    def accessor(self, index: int) -> np.ndarray:
        entry = self.json["accessors"][index]
        view = self.json["bufferViews"][entry["bufferView"]]
        width = WIDTHS[entry["type"]]
        dtype = np.dtype(COMPONENTS[entry["componentType"]])
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == entry["count"] * width * dtype.itemsize
        values = np.frombuffer(self.binary, dtype, entry["count"] * width, view["byteOffset"])
        return values.reshape(entry["count"], width).astype(np.float64)

    def node(self, name: str) -> int:
        return next(i for i, node in enumerate(self.json["nodes"]) if node["name"] == name and "mesh" in node)

    def posed(self, name: str, frame: int) -> np.ndarray:
        """Vertices (V, 3) of a mesh at a key frame."""
        nodes = [dict(node) for node in self.json["nodes"]]
        animation = self.json["animations"][0]
        node = nodes[self.node(name)]
        mesh = self.json["meshes"][node["mesh"]]
        targets = mesh["primitives"][0].get("targets", [])
        amounts = mesh.get("weights", [0] * len(targets))
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            output = self.accessor(sampler["output"])
            if channel["target"]["path"] != "weights":
                nodes[channel["target"]["node"]][channel["target"]["path"]] = output[frame]
            elif channel["target"]["node"] == self.node(name):
                amounts = output.reshape(-1, len(targets))[frame]
        attributes = mesh["primitives"][0]["attributes"]
        points = self.accessor(attributes["POSITION"]).copy()
        for amount, target in zip(amounts, targets, strict=True):
            points += amount * self.accessor(target["POSITION"])
        skin = self.json["skins"][node["skin"]]
        world = {}
        for root in self.json["scenes"][self.json["scene"]]["nodes"]:
            walk(nodes, root, np.eye(4), world)
        inverse = [m.reshape(4, 4).T for m in self.accessor(skin["inverseBindMatrices"])]
        matrices = [world[joint] @ bind for joint, bind in zip(skin["joints"], inverse, strict=True)]
        joints, weights = (self.accessor(attributes[a]) for a in ("JOINTS_0", "WEIGHTS_0"))
        answer = np.zeros_like(points)
        for v, point in enumerate(points):
            for j, w in zip(joints[v].astype(int), weights[v], strict=True):
                answer[v] += w * (matrices[j] @ [*point, 1])[:3]
        return answer


def walk(nodes, index, parent, world):
    x, y, z, w = nodes[index].get("rotation", (0, 0, 0, 1))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = nodes[index].get("translation", (0, 0, 0))
    world[index] = parent @ matrix
    for child in nodes[index].get("children", []):
        walk(nodes, child, world[index], world)


@pytest.fixture(scope="module")
def made(bundle, motion, served):
    return animated_glb(bundle, motion.poses, motion.transl, served)


@pytest.fixture(scope="module")
def glb(made):
    return Glb(made.content)


@pytest.mark.parametrize("name", ["tshirt", "trousers"])
def test_garments_are_where_the_service_puts_them(made, glb, served, name):
    worst = max(np.linalg.norm(glb.posed(name, frame) - served[name][frame], axis=1).max() for frame in (0, 1, 17, 44))
    assert worst < 2e-4
    assert worst <= made.errors[name] * 1.02 + 2e-6  # what the file says of itself holds
    stated = glb.json["extras"]["worst_vertex_error_mm"][name]
    assert stated == pytest.approx(1e3 * made.errors[name], abs=1e-4)


def test_morph_targets_are_needed(glb, served):
    for target in glb.json["meshes"]:
        if "weights" in target:
            assert len(target["weights"]) > 3
    frozen = Glb.__new__(Glb)
    frozen.json, frozen.binary = json.loads(json.dumps(glb.json)), glb.binary
    frozen.json["animations"][0]["channels"] = [
        c for c in glb.json["animations"][0]["channels"] if c["target"]["path"] != "weights"
    ]
    assert np.linalg.norm(frozen.posed("tshirt", 30) - served["tshirt"][30], axis=1).max() > 5e-3


def test_body_follows_the_poses(bundle, glb, motion):
    from dataclasses import replace

    from caphy.body.bundled import default_body

    body = replace(default_body("medium"), v_template=bundle.body.vertices.astype(float))  # tucked in under clothes
    for frame in (0, 20):
        expected = body.pose(motion.poses[frame : frame + 1], motion.transl[frame : frame + 1])[0]
        np.testing.assert_allclose(glb.posed("body", frame), expected, atol=2e-5)


def test_time_runs_at_the_bundles_rate(glb, motion):
    sampler = glb.json["animations"][0]["samplers"][0]
    times = glb.accessor(sampler["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(len(motion)) / 30, atol=1e-6)


def test_normals_point_outward_and_are_unit(glb):
    for mesh in glb.json["meshes"]:
        primitive = mesh["primitives"][0]
        normals = glb.accessor(primitive["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
        points = glb.accessor(primitive["attributes"]["POSITION"])
        faces = glb.accessor(primitive["indices"])[:, 0].astype(int).reshape(-1, 3)
        a, b, c = (points[faces[:, i]] for i in range(3))
        face_normals = np.cross(b - a, c - a)
        assert np.mean(np.sum(face_normals * normals[faces[:, 0]], axis=1) > 0) > 0.97


def test_loads_in_trimesh(made, bundle):
    scene = trimesh.load(io.BytesIO(made.content), file_type="glb", process=False)
    assert {"body", "tshirt", "trousers"} <= set(scene.geometry)
    assert len(scene.geometry["tshirt"].faces) == len(bundle.garment("tshirt").mesh.faces)


def test_one_frame_and_one_garment(bundle, motion, served):
    made = animated_glb(bundle, motion.poses[:1], motion.transl[:1], {"trousers": served["trousers"][:1]})
    glb = Glb(made.content)
    assert [mesh["name"] for mesh in glb.json["meshes"]] == ["body", "trousers"]
    np.testing.assert_allclose(glb.posed("trousers", 0), served["trousers"][0], atol=2e-4)


def test_a_tighter_tolerance_takes_more_targets(bundle, motion, served, made):
    tight = animated_glb(bundle, motion.poses, motion.transl, served, tolerance=1e-5)
    for name, count in made.targets.items():
        assert tight.targets[name] > count
        assert tight.errors[name] <= 1e-5


def test_half_turns_stay_finite(bundle):
    """A joint at half a turn collapses blended transforms; offsets must not explode."""
    from service.engine import GarmentEngine

    poses = np.zeros((8, 55, 3), np.float32)
    poses[:, 16, 0] = np.linspace(0, np.pi, 8)
    transl = np.zeros((8, 3), np.float32)
    engine = GarmentEngine(bundle.garment("tshirt"))
    vertices, _ = engine.run(poses, transl, engine.initial_state())
    made = animated_glb(bundle, poses, transl, {"tshirt": vertices})
    assert made.errors["tshirt"] < 2e-4
    glb = Glb(made.content)
    for target in glb.json["meshes"][1]["primitives"][0].get("targets", []):
        assert np.abs(glb.accessor(target["POSITION"])).max() < 1


def test_matrices_are_stored_column_major():
    gltf = Gltf("test")
    index = gltf.accessor(np.arange(16, dtype=np.float32).reshape(1, 4, 4))
    assert Glb(gltf.glb()).accessor(index)[0, 1] == 4
