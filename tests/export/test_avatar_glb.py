"""The avatar's own GLB: its blend shapes with the network's weights are the service's vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from test_glb import Glb

from caphy.errors import CaphyError
from caphy.io.blend_shapes import blend_shapes, blend_weights
from caphy.io.bundle import AvatarBundle, read_bundle
from caphy.io.bundled import bundled
from caphy.io.onnx_wire import read_graph, with_output
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.procedural import procedural_motion
from caphy.io.procedural_postures import posture_motion
from caphy.report.avatar_glb import SECONDS, SEED, avatar_glb
from service.engine import GarmentEngine

TOLERANCES = [2e-4, 2e-3]


def posed(glb: Glb, bundle, name: str, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of a mesh with morph ``weights`` and joint ``transforms`` (55, 3, 4), as glTF 2.0 orders them."""
    node = glb.json["nodes"][glb.node(name)]
    primitive = glb.json["meshes"][node["mesh"]]["primitives"][0]
    points = glb.accessor(primitive["attributes"]["POSITION"]).copy()
    for weight, target in zip(weights, primitive.get("targets", []), strict=False):
        points += weight * glb.accessor(target["POSITION"])
    joints, amounts = (glb.accessor(primitive["attributes"][a]) for a in ("JOINTS_0", "WEIGHTS_0"))
    blended = np.einsum("vn,vnij->vij", amounts, transforms[joints.astype(int)])
    return np.einsum("vij,vj->vi", blended[..., :3], points) + blended[..., 3]


def worst_gap(glb: Glb, bundle, name: str, motion, served: np.ndarray, frames) -> float:
    """Largest distance [m] of the GLB's vertices from the service's."""
    shapes = blend_shapes(bundle.garment(name))
    weights = blend_weights(bundle.garment(name), shapes, motion.poses, motion.transl)
    transforms = bundle.transforms(motion.poses, motion.transl)
    gaps = (posed(glb, bundle, name, weights[t], transforms[t]) - served[t] for t in frames)
    return max(np.linalg.norm(gap, axis=1).max() for gap in gaps)


@pytest.mark.parametrize("name", ["tshirt", "trousers"])
def test_the_networks_weights_show_the_services_vertices(bundle, motion, served, name):
    glb = Glb(avatar_glb(bundle, tolerance=0.0))
    assert worst_gap(glb, bundle, name, motion, served[name], (0, 1, 20, 44)) < 2e-5


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_the_stated_error_holds_on_the_motion_it_is_stated_for(bundle, tolerance):
    glb, motion = Glb(avatar_glb(bundle, tolerance)), posture_motion(SEED, SECONDS)[:300]
    for garment in bundle.garments:
        engine = GarmentEngine(garment)
        poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
        vertices, _ = engine.run(poses, transl, engine.initial_state())
        assert worst_gap(glb, bundle, garment.name, motion, vertices, range(0, 300, 12)) < 1.05 * tolerance


@pytest.fixture(scope="module")
def default() -> AvatarBundle:
    return read_bundle(bundled(Path("default")))


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_the_stated_error_holds_on_motions_that_it_was_not_measured_on(default, tolerance):
    motions = [procedural_motion(seed, seconds=20.0) for seed in (2, 5)]
    assert worst_over_stated(default, tolerance, motions) < 1


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_captured_motion_hardly_exceeds_the_stated_error(default, tolerance, shared_data):
    clips = sorted((shared_data / "cmu_mocap" / "bvh").glob("*.bvh"))
    motions = [read_poses(clip).to_y_up().about(default.joints[0]).resample(default.fps) for clip in clips]
    assert len(motions) == 4
    assert worst_over_stated(default, tolerance, motions) < 1.5


def worst_over_stated(bundle: AvatarBundle, tolerance: float, motions: list[PoseSequence]) -> float:
    """How far off canonical vertices are at the worst, of what the file states."""
    glb, worst = Glb(avatar_glb(bundle, tolerance)), 0.0
    for garment in bundle.garments:
        mesh = glb.json["meshes"][glb.json["nodes"][glb.node(garment.name)]["mesh"]]
        (primitive,), shapes = mesh["primitives"], blend_shapes(garment)
        base = glb.accessor(primitive["attributes"]["POSITION"])
        gaps = -shapes.targets.copy()
        for k, target in enumerate(primitive["targets"]):
            gaps[k] += glb.accessor(target["POSITION"])
        for motion in motions:
            weights = blend_weights(garment, shapes, motion.poses, motion.transl)
            off = (base - shapes.base).ravel() + weights @ gaps.reshape(len(gaps), -1)
            distance = np.linalg.norm(off.reshape(len(weights), -1, 3), axis=-1).max()
            worst = max(worst, 1e3 * distance / mesh["extras"]["worst_vertex_error_mm"])
    return worst


def test_fewer_blend_shapes_where_less_is_asked_for(bundle):
    counts = {}
    for tolerance in (0.0, 2e-3, 2e-2):
        glb = Glb(avatar_glb(bundle, tolerance))
        for mesh in glb.json["meshes"][1:]:
            stated = mesh["extras"]["worst_vertex_error_mm"] if "weights" in mesh else 0
            assert stated <= 1e3 * tolerance
            counts.setdefault(mesh["name"], []).append(len(mesh.get("weights", [])))
    for name, (whole, fine, coarse) in counts.items():
        assert whole == len(blend_shapes(bundle.garment(name)).targets)
        assert whole >= fine >= coarse
    assert sum(coarse for _, _, coarse in counts.values()) < sum(whole for whole, _, _ in counts.values())


def test_without_morph_targets_garments_stand_in_their_template(bundle):
    glb = Glb(avatar_glb(bundle, tolerance=None))
    rest = np.tile(np.eye(3, 4), (55, 1, 1))
    for name in ("tshirt", "trousers"):
        np.testing.assert_allclose(
            posed(glb, bundle, name, np.zeros(0), rest), bundle.garment(name).mesh.vertices, atol=1e-6
        )


def test_graphs_are_read_as_the_onnx_package_reads_them(bundle):
    content = bundle.garment("tshirt").onnx
    found, model = read_graph(content), onnx.load_from_string(content)
    assert [(n.kind, n.inputs, n.outputs) for n in found.nodes] == [
        (n.op_type, tuple(n.input), tuple(n.output)) for n in model.graph.node
    ]
    expected = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
    reals = {name: array for name, array in expected.items() if array.dtype.kind == "f"}
    assert set(found.constants) == set(reals)
    for name, array in reals.items():
        np.testing.assert_array_equal(found.constants[name], array)


def test_an_output_is_added_as_the_onnx_package_would(bundle):
    garment = bundle.garment("tshirt")
    tensor = blend_shapes(garment).tensor
    model = onnx.load_from_string(with_output(garment.onnx, tensor))
    onnx.checker.check_model(model)
    assert [output.name for output in model.graph.output] == ["vertices", "next_state", tensor]


@pytest.mark.parametrize("damage", [lambda c: c[:-20], lambda c: b"\x0b" + c, lambda c: b"\xff" * 40])
def test_damaged_graphs_are_refused_in_words(bundle, damage):
    with pytest.raises(CaphyError, match="export the avatar again"):
        read_graph(damage(bundle.garment("tshirt").onnx))
