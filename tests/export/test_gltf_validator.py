"""The Khronos validator's opinion, where node and its package are installed (npm install gltf-validator)."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest

from export.glb import animated_glb

SCRIPT = """
const validator = require('gltf-validator');
validator.validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


def test_no_errors_and_no_warnings(bundle, motion, served, tmp_path):
    node = shutil.which("node")
    probe = [node or "", "-e", "require('gltf-validator')"]
    if node is None or subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("needs node and its package gltf-validator (npm install gltf-validator, NODE_PATH)")
    path = tmp_path / "avatar.glb"
    path.write_bytes(animated_glb(bundle, motion.poses, motion.transl, served).content)
    found = subprocess.run([node, "-e", SCRIPT, str(path)], capture_output=True, text=True, check=True)
    issues = json.loads(found.stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"][:5]
