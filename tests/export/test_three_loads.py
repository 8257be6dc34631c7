"""three.js, the one that the viewer's page is built from, loads the GLB files and shows the service's vertices."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import service.viewer
from caphy.io.blend_shapes import blend_shapes, blend_weights
from caphy.report.avatar_glb import avatar_glb
from export.glb import animated_glb

THREE = Path(service.viewer.__file__).parent / "static" / "three.js"
SCRIPT = """
import { readFileSync, writeFileSync } from "node:fs";
globalThis.self = globalThis;
const [three, glb, mesh, out, frame, weights] = process.argv.slice(1);
const { AnimationMixer, GLTFLoader, Vector3 } = await import(three);
const bytes = readFileSync(glb);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
const gltf = await new GLTFLoader().parseAsync(buffer, "");
if (gltf.animations.length) {
  const mixer = new AnimationMixer(gltf.scene);
  mixer.clipAction(gltf.animations[0]).play();
  mixer.setTime(Number(frame) / 30);
}
const found = gltf.scene.getObjectByName(mesh);
if (weights) JSON.parse(weights).forEach((weight, i) => { found.morphTargetInfluences[i] = weight; });
gltf.scene.updateMatrixWorld(true);
found.skeleton.update();
const count = found.geometry.attributes.position.count;
const points = new Float32Array(3 * count), point = new Vector3();
for (let i = 0; i < count; i++) {
  found.getVertexPosition(i, point).applyMatrix4(found.matrixWorld).toArray(points, 3 * i);
}
writeFileSync(out, points);
"""


@pytest.fixture(scope="module")
def node() -> str:
    found = shutil.which("node")
    assert found, "this test needs node 20 or newer (Debian: apt-get install nodejs)"
    return found


def shown(node: str, folder: Path, content: bytes, mesh: str, frame: int = 0, weights: str = "") -> np.ndarray:
    """Vertices (V, 3) of a mesh as three.js shows them."""
    (folder / "motion.glb").write_bytes(content)
    out = folder / "points"
    arguments = [THREE.as_uri(), str(folder / "motion.glb"), mesh, str(out), str(frame), weights]
    subprocess.run([node, "--input-type=module", "-e", SCRIPT, *arguments], check=True, timeout=60)
    return np.fromfile(out, "<f4").reshape(-1, 3)


@pytest.mark.parametrize(("name", "frame"), [("tshirt", 0), ("tshirt", 29), ("trousers", 44)])
def test_an_animation_shows_the_services_vertices(node, bundle, motion, served, tmp_path, name, frame):
    made = animated_glb(bundle, motion.poses, motion.transl, served)
    points = shown(node, tmp_path, made.content, name, frame)
    assert np.linalg.norm(points - served[name][frame], axis=1).max() < 2e-4


def test_the_body_follows(node, bundle, motion, served, tmp_path):
    made = animated_glb(bundle, motion.poses, motion.transl, served)
    expected = bundle.body.posed(bundle.transforms(motion.poses[[13]], motion.transl[[13]]))[0]
    assert np.linalg.norm(shown(node, tmp_path, made.content, "body", 13) - expected, axis=1).max() < 2e-4


def test_the_networks_weights_shape_the_avatar(node, bundle, motion, tmp_path):
    garment = bundle.garment("tshirt")
    shapes = blend_shapes(garment)
    weights = blend_weights(garment, shapes, motion.poses, motion.transl)[20].astype(float)
    points = shown(node, tmp_path, avatar_glb(bundle, tolerance=0.0), "tshirt", weights=str(weights.tolist()))
    expected = shapes.base + np.tensordot(weights, shapes.targets, axes=1)
    assert np.linalg.norm(expected - garment.mesh.vertices, axis=1).max() > 5e-3
    np.testing.assert_allclose(points, expected, atol=1e-5)
