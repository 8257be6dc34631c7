"""Trainings of ``caphy fit`` that several processes share."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.garment.families import Skirt, make
from caphy.io.poses.canonical import write_poses
from caphy.io.procedural import procedural_motion
from caphy.network.files import load_network
from caphy.pipeline.processes import run_shared
from caphy.rotations import matrix_from_axis_angle


@pytest.fixture(scope="module")
def training(tmp_path_factory) -> list[str]:
    """The arguments of a short training, but for its folder."""
    folder = tmp_path_factory.mktemp("shared")
    make(Skirt(edge_length=0.05), default_body()).save(folder / "skirt.npz")
    write_poses(procedural_motion(0, 1.0, 30.0), folder / "motion.npz")
    return ["train", str(folder / "skirt.npz"), str(folder / "motion.npz"), "--steps", "3", "--seed", "1", "-o"]


def skinned_template(network, motion):
    """Where the skinned template is, which an untrained network predicts."""
    poses = torch.tensor(motion.poses).to(network.template)
    skinned = network.skinned(matrix_from_axis_angle(poses), torch.tensor(motion.transl).to(poses), network.template)
    return skinned.detach().numpy()


def test_two_processes_train_what_one_does(training, tmp_path, capsys):
    assert run_shared([*training, str(tmp_path / "two")], 2) == 0
    printed = capsys.readouterr().out
    assert printed.count(f"next: caphy export {tmp_path / 'two'}") == 1
    assert main([*training, str(tmp_path / "one")]) == 0
    one, two = (load_network(tmp_path / name / "network.safetensors") for name in ("one", "two"))
    motion = procedural_motion(3, 0.5, 30.0)
    vertices = [network.stream(motion.poses, motion.transl) for network in (one, two)]
    moved = np.linalg.norm(vertices[0] - skinned_template(one, motion), axis=-1).max()
    assert np.linalg.norm(vertices[0] - vertices[1], axis=-1).max() < 0.01 * moved


def test_what_a_process_refuses_is_told(training, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.safetensors").write_bytes(b"")
    assert run_shared([*training, str(tmp_path / "run")], 2) != 0
    assert "holds a training already: add --resume" in capsys.readouterr().out


def test_streams_must_divide(tmp_path, capsys):
    assert main(["fit", str(tmp_path), "-o", str(tmp_path / "run"), "--processes", "3"]) == 2
    assert "--processes must divide the 8 streams" in capsys.readouterr().err


def running_with(word: str) -> list[str]:
    """Command lines of all processes that have a word among their arguments."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_text().replace("\0", " "))
        except OSError:  # it has ended
            continue
    return [line for line in lines if word in line]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells processes that their parent has ended")
def test_processes_end_when_their_parent_is_killed(training, tmp_path):
    words = [*training[:3], "--steps", "1000000", "-o", str(tmp_path / "endless")]
    script = f"from caphy.pipeline.processes import run_shared; run_shared({words!r}, 2)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        parent.stdout.readline()
        assert len(running_with(words[-1])) == 4  # the parent, torchrun and its two
        parent.send_signal(signal.SIGKILL)
    until = time.monotonic() + 10  # at its next word, into a pipe that nobody reads, it would end a little later
    while left := running_with(words[-1]):
        assert time.monotonic() < until, left
        time.sleep(0.2)
