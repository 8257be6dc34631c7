"""What a GPU trains is what a CPU would: run where there is one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed as dist
from small_scans import supervised_trainer
from small_world import small_trainer, swaying, tube

from caphy.cli import main
from caphy.io.poses import write_poses
from caphy.io.training_folder import NETWORK
from caphy.network.files import load_network
from caphy.training.loop import Trainer

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def _gradients(trainer: Trainer) -> tuple[float, list[torch.Tensor]]:
    """Loss [J] and gradients of a trainer's first step."""
    trainer.optimizer.zero_grad()
    track = trainer._turn()
    _, loss = track.advance(trainer.model)
    trainer.averaged(loss).backward()
    return float(loss.detach().mean()), [p.grad.cpu() for p in trainer.learner.parameters() if p.grad is not None]


@pytest.mark.parametrize("make", [small_trainer, supervised_trainer])
def test_a_gpu_descends_the_same_gradient(tmp_path: Path, make: Callable[..., Trainer]) -> None:
    """After some steps of the CPU, so that the network answers and its streams have a past."""
    here, there = make(tmp_path / "here"), make(tmp_path / "there", device="cuda")
    for _ in range(5):
        here.step()
    here.save()
    for file in (tmp_path / "here").iterdir():
        (tmp_path / "there" / file.name).write_bytes(file.read_bytes())
    there.resume()
    mine, theirs = _gradients(here), _gradients(there)
    assert theirs[0] == pytest.approx(mine[0], rel=1e-4)
    assert len(mine[1]) == len(theirs[1])
    for one, other in zip(mine[1], theirs[1], strict=True):
        assert float((other - one).norm()) < 1e-3 * float(one.norm())


@pytest.mark.parametrize("make", [small_trainer, supervised_trainer])
def test_what_a_gpu_began_goes_on_on_a_cpu(tmp_path: Path, make: Callable[..., Trainer]) -> None:
    there = make(tmp_path, device="cuda")
    for _ in range(4):
        there.step()
    there.save()
    here = make(tmp_path)
    here.resume()
    assert here.progress.step == 4
    assert here.step() == pytest.approx(there.step(), rel=1e-3)


def test_trains_and_validates_from_the_command_line(tmp_path: Path) -> None:
    tube().save(tmp_path / "tube.npz")
    write_poses(swaying(30, 0), tmp_path / "motion.npz")
    write_poses(swaying(20, 5), tmp_path / "unseen.npz")
    seen = {}
    for device in ("cpu", "cuda"):
        words = ["train", tmp_path / "tube.npz", tmp_path / "motion.npz", "--held-out", tmp_path / "unseen.npz"]
        words += ["-o", tmp_path / device, "--steps", 3, "--device", device]
        assert main([str(word) for word in words]) == 0
        last = json.loads((tmp_path / device / "metrics.jsonl").read_text().splitlines()[-1])
        seen[device] = last["validation"]["potential_J"]
    assert seen["cuda"] == pytest.approx(seen["cpu"], rel=0.01)
    stream = [
        load_network(tmp_path / device / NETWORK).stream(swaying(20, 5).poses, swaying(20, 5).transl)
        for device in ("cpu", "cuda")
    ]
    assert np.abs(stream[0] - stream[1]).max() < 1e-3


def test_goes_on_from_a_trained_network(tmp_path: Path) -> None:
    """What is read is in evaluation mode, in which cuDNN differentiates no recurrent layer."""
    tube().save(tmp_path / "tube.npz")
    write_poses(swaying(30, 0), tmp_path / "motion.npz")
    words = ["train", str(tmp_path / "tube.npz"), str(tmp_path / "motion.npz"), "--device", "cuda", "--steps", "3"]
    assert main([*words, "-o", str(tmp_path / "first")]) == 0
    assert main([*words, "-o", str(tmp_path / "second"), "--init", str(tmp_path / "first")]) == 0


def test_what_processes_agree_on_lies_on_the_cpu(tmp_path: Path) -> None:
    """Each process has a GPU of its own, and their clocks and flags are on the CPU: both backends are needed."""
    dist.init_process_group("cpu:gloo,cuda:nccl", init_method=f"file://{tmp_path}/meeting", rank=0, world_size=1)
    try:
        trainer = small_trainer(tmp_path / "run", device="cuda")
        trainer.world = 2  # asks the others, of whom there are none
        assert trainer._common(0.25) == 0.25 and trainer._agreed(True)
        model = torch.nn.parallel.DistributedDataParallel(trainer.learner)
        _, loss = trainer.track.advance(model)
        trainer.averaged(loss).backward()
        assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in trainer.learner.parameters())
    finally:
        dist.destroy_process_group()
