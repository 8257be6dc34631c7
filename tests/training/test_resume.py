"""A training that was killed goes on as if it had not been; two processes do what one would; damage is reported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from small_world import small_trainer

from caphy.commands.begun import interrupted
from caphy.errors import CaphyError
from caphy.io.training_folder import CHECKPOINT, METRICS, NETWORK
from caphy.network.files import load_network, save_network
from caphy.training.loop import read_metrics

HERE = Path(__file__).parent

RUN = """
import sys, torch
from pathlib import Path
sys.path.insert(0, {here!r})
from small_world import small_trainer
torch.set_num_threads(1)
trainer = small_trainer(Path(sys.argv[1]), steps=40)
if sys.argv[2] == "resume":
    trainer.resume()
trainer.run(checkpoint_seconds=float(sys.argv[3]))
"""


def start(folder: Path, how: str, checkpoint_seconds: float) -> subprocess.Popen:
    code = RUN.format(here=str(HERE))
    return subprocess.Popen([sys.executable, "-c", code, str(folder), how, str(checkpoint_seconds)])


def test_killed_and_resumed_equals_uninterrupted(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    uninterrupted = start(whole, "new", 1e9)
    killed = start(broken, "new", 0)
    deadline = time.monotonic() + 120
    while not (broken / CHECKPOINT).exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    os.kill(killed.pid, signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL
    assert uninterrupted.wait() == 0
    first = small_trainer(broken, steps=40)
    first.resume()
    assert 0 < first.progress.step < 40
    assert start(broken, "resume", 1e9).wait() == 0
    one, two = (load_network(folder / NETWORK).state_dict() for folder in (whole, broken))
    assert one.keys() == two.keys()
    for name in one:
        assert torch.equal(one[name], two[name]), name


def test_continued_in_one_process_equals_uninterrupted(make_trainer):
    whole, first = make_trainer("whole", steps=8), make_trainer("first", steps=8)
    for _ in range(8):
        whole.step()
    for _ in range(3):
        first.step()
    first.save()
    torch.manual_seed(99)
    second = make_trainer("first", steps=8, seed=0)
    second.resume()
    assert second.progress.step == 3
    losses = [second.step() for _ in range(5)]
    for one, two in zip(whole.learner.parameters(), second.learner.parameters(), strict=True):
        assert torch.equal(one, two)
    assert all(loss > 0 for loss in losses)


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "other", "missing", "nan"])
def test_damaged_checkpoints_are_refused(make_trainer, damage):
    trainer = make_trainer()
    trainer.step()
    trainer.save()
    path = trainer.folder / CHECKPOINT
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        content[3] ^= 0xFF
        path.write_bytes(content)
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "other":
        save_network(trainer.network, path)
    elif damage == "missing":
        path.unlink()
    else:
        trainer.learner.head.bias.data[0] = float("nan")
        trainer.save()
    with pytest.raises(CaphyError, match=r"checkpoint\.safetensors"):
        make_trainer().resume()


def test_a_checkpoint_of_another_training_is_refused(make_trainer):
    make_trainer("small", streams=2).save()
    with pytest.raises(CaphyError, match="2 streams, not 4"):
        make_trainer("small").resume()


def test_stops_at_a_potential_that_is_not_finite(make_trainer):
    trainer = make_trainer()
    trainer.step()
    trainer.save()
    before = (trainer.folder / CHECKPOINT).read_bytes()
    trainer.learner.head.bias.data[5] = float("inf")
    with pytest.raises(CaphyError, match="go on with --resume"):
        trainer.run()
    assert (trainer.folder / CHECKPOINT).read_bytes() == before


def test_metrics_after_the_checkpoint_are_forgotten(make_trainer):
    trainer = make_trainer()
    lines = [json.dumps({"step": step}) for step in (0, 1, 5)]
    (trainer.folder / METRICS).write_text("\n".join(lines) + '\n{"step": 6, "lo')
    trainer.step()
    trainer.save()
    make_trainer().resume()
    assert [json.loads(line)["step"] for line in (trainer.folder / METRICS).read_text().splitlines()] == [0, 1]


def test_metrics_before_the_first_checkpoint_are_not_another_trainings(make_trainer):
    """It was stopped, so its folder has a line or two and no checkpoint; the next begins at the first step."""
    trainer = make_trainer(steps=2)
    (trainer.folder / METRICS).write_text('{"step": 38, "loss_J": 1.0}\n{"step": 80, "energies_J": {"bending": 0.1}')
    assert "nothing was kept" in interrupted(trainer.folder)
    trainer.run()
    assert {entry["step"] for entry in read_metrics(trainer.folder / METRICS)} <= {0, 1, 2}
    assert "--resume" in interrupted(trainer.folder)
    with (trainer.folder / METRICS).open("a") as stream:
        stream.write('{"step": 3, "energies_J": {"bending": 0.1}')
    assert all(entry["step"] < 3 for entry in read_metrics(trainer.folder / METRICS))


def test_learns(make_trainer):
    trainer = make_trainer(steps=60)
    losses = [trainer.step(step / 60) for step in range(60)]
    assert sum(losses[-15:]) < 0.8 * sum(losses[:15])


def _one_of_two(rank: int, folder: Path) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    trainer = small_trainer(folder / "run")
    for _ in range(3):
        trainer.step()
    trainer.save()
    torch.save([p.grad for p in trainer.learner.parameters()], folder / f"gradients{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_equal_one(tmp_path, make_trainer):
    context = mp.get_context("spawn")
    workers = [context.Process(target=_one_of_two, args=(rank, tmp_path)) for rank in range(2)]
    for worker in workers:
        worker.start()
    alone = make_trainer("alone")
    for _ in range(3):
        alone.step()
    for worker in workers:
        worker.join(120)
        assert worker.exitcode == 0
    for rank in range(2):
        shared = torch.load(tmp_path / f"gradients{rank}.pt", weights_only=True)
        for one, parameter in zip(shared, alone.learner.parameters(), strict=True):
            torch.testing.assert_close(
                one, parameter.grad, rtol=2e-3, atol=1e-5 * float(parameter.grad.abs().max()) + 1e-8
            )
    resumed = small_trainer(tmp_path / "run")
    resumed.resume()
    torch.testing.assert_close(resumed.track.hidden, alone.track.hidden, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(resumed.track.past.previous, alone.track.past.previous, rtol=1e-3, atol=1e-5)
