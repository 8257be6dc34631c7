"""The base dependencies alone, in a fresh environment: the service starts, answers, and there is no torch."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.request import Request, urlopen

import numpy as np
import pytest

from service.client import Client
from service.protocol import MEDIA_TYPE

ROOT = Path(__file__).parents[2]
HEAVY = ("torch", "scipy", "onnx", "numba", "embreex", "anny", "smplx")


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with ``pip install .`` and nothing else."""
    folder = tmp_path_factory.mktemp("base")
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    found = folder / "venv" / "bin" / "python"
    source = folder / "source"
    for name in ("caphy", "service", "export"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):  # the files that Dockerfile copies
        shutil.copy(ROOT / name, source)
    install = [str(found), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", str(source)]
    subprocess.run(install, check=True, env=environment, cwd=folder)
    return found


@pytest.fixture(scope="module")
def base_url(python: Path, avatars: Path) -> Iterator[str]:
    """``caphy serve`` in that environment, away from the checkout."""
    command = [str(python.parent / "caphy"), "serve", "--avatars", str(avatars), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=python.parent)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "http://" in line, line + process.stdout.read()
    yield line.split()[3]
    process.terminate()
    process.wait(timeout=10)


def test_nothing_heavy_is_installed(python):
    listed = subprocess.run([str(python), "-m", "pip", "list", "--format", "json"], check=True, capture_output=True)
    names = {package["name"].lower() for package in json.loads(listed.stdout)}
    assert not names & set(HEAVY)
    assert {"caphy", "onnxruntime", "fastapi"} <= names


def test_the_service_answers(base_url, motion, http):
    client = Client(base_url, timeout=20)
    assert [avatar["id"] for avatar in client.avatars()] == ["shell"]
    assert json.load(urlopen(base_url + "/ready", timeout=5)) == {"status": "ready"}
    meshes = client.frames("shell", motion)
    asked = {"fps": 30, "poses": motion.poses.tolist(), "transl": motion.transl.tolist()}
    for name, garment in http.post("/avatars/shell/frames", json=asked).json()["garments"].items():
        np.testing.assert_allclose(meshes[name], garment["vertices"], atol=2e-5)
    glb = urlopen(base_url + "/avatars/shell/mesh?format=glb", timeout=20).read()
    assert glb.startswith(b"glTF")
    request = Request(base_url + "/avatars/shell/frames", b"nonsense", {"content-type": MEDIA_TYPE})
    with pytest.raises(Exception, match="422"):
        urlopen(request, timeout=5)


def test_the_command_line_says_what_is_missing(python):
    command = [str(python), "-m", "caphy.cli", "export", "x", "-o", "y"]
    found = subprocess.run(command, check=False, capture_output=True, text=True, cwd=python.parent)
    assert found.returncode == 2
    assert "Traceback" not in found.stderr
    assert "pip install" in found.stderr
