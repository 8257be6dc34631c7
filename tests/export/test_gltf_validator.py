"""The Khronos validator's opinion of every GLB. `make test` installs it beside the environment."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from caphy.report.avatar_glb import avatar_glb
from export.glb import animated_glb

SCRIPT = """
const validator = require('gltf-validator');
validator.validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))
  .then((report) => console.log(JSON.stringify(report.issues)));
"""
PACKAGES = Path(sys.prefix) / "node" / "node_modules"


def issues(path: Path) -> dict:
    node = shutil.which("node")
    assert node, "this test needs node (Debian: apt-get install nodejs npm)"
    assert (PACKAGES / "gltf-validator").is_dir(), "this test needs the Khronos validator: run `make node-packages`"
    environment = {**os.environ, "NODE_PATH": str(PACKAGES)}
    found = subprocess.run([node, "-e", SCRIPT, str(path)], capture_output=True, text=True, check=True, env=environment)
    return json.loads(found.stdout)


@pytest.mark.parametrize("kind", ["motion", "avatar", "template"])
def test_no_errors_and_no_warnings(bundle, motion, served, tmp_path, kind):
    path = tmp_path / f"{kind}.glb"
    if kind == "motion":
        path.write_bytes(animated_glb(bundle, motion.poses, motion.transl, served).content)
    else:
        path.write_bytes(avatar_glb(bundle, 2e-4 if kind == "avatar" else None))
    found = issues(path)
    assert (found["numErrors"], found["numWarnings"]) == (0, 0), found["messages"][:5]


def test_the_validator_sees_what_is_wrong(bundle, tmp_path):
    content = avatar_glb(bundle, None)
    (tmp_path / "broken.glb").write_bytes(content.replace(b'"VEC4"', b'"VEC3"', 1))
    assert issues(tmp_path / "broken.glb")["numErrors"] > 0
