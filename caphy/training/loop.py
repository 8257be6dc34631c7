"""The training loop: streams in, steps of Adam, checkpoints, metrics, and on with it after an interruption."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.io.training_folder import CHECKPOINT, METRICS, NETWORK
from caphy.network.files import save_network
from caphy.network.garment_network import GarmentNetwork
from caphy.training.checkpoint import load_checkpoint, save_checkpoint
from caphy.training.learner import Learner, stiffness
from caphy.training.motions import Motions
from caphy.training.objective import Objective
from caphy.training.scans import RANDOM_EPOCHS, SCAN_EPOCHS, Scans, ScanStreams
from caphy.training.streams import HELD_WINDOWS, Streams
from caphy.training.track import Track
from caphy.training.validate import validate

LOG_SECONDS = 10.0
"""Time between lines of metrics."""


USUAL = 0.12
"""Potential per area of cloth [J/m^2] beyond which a frame counts for less.

Of a T-shirt and of trousers that began as the default avatar's (SNUG's cotton, 1,000 steps), over held-out frames: mean
0.570 and 0.130 J, median 0.426 and 0.111; with 0.35 J/m^2 0.572 and 0.136, 0.487 and 0.114; with 1.0 0.581 and 0.144,
0.471 and 0.118.
"""


def evened(potential: Tensor, usual: float) -> Tensor:
    """Potentials [J] of frames as they are learnt from: of equal slope where small, logarithmic beyond ``usual`` [J].

    What each frame wants, its minimum, stays the same. In the plain mean a few frames with a limb in the trunk, of ten
    joules and more, drown the others. Potentials are above the skinned template's weight: counted from the height of
    the world's origin, a joule or two, nearly all frames lay beyond ``usual`` (the two trainings of :data:`USUAL` ended
    at 0.619 and 0.195 J in the mean then, 0.585 and 0.192 in the median, with 0.35 J/m^2).
    """
    return usual * torch.log1p(potential.clamp_min(0) / usual) + potential.clamp_max(0)


DECAY = 0.3
"""Decoupled decay of weights, per unit of learning rate (Loshchilov, Hutter, ICLR 2019); not of biases.

Without it a network learns its motions by heart: of the default T-shirt, trained for 24,000 steps, the mean potential
over held-out frames rose from 3.4 to 3.7 J while that over its own fell, and its stream drifted by 30 mm. With it
12,000 steps come to 2.7 J and 4 mm. Of a T-shirt taught by 32 scans besides, 1,000 steps, it brought the distance from
eight held-out scans from 16.3 to 14.9 mm; more of it, 1.0, gave 15.0.
"""


@dataclass(frozen=True)
class Schedule:
    """How long to train and how fast to learn.

    Attributes:
        steps: steps in all, or none to be bounded by time alone.
        minutes: time in all, interruptions not counted, or none.
        streams: windows per step.
        learning_rate: at its highest; it rises over the first steps and falls to a fiftieth along half a cosine.
    """

    steps: int | None = None
    minutes: float | None = 45.0
    streams: int = 8
    learning_rate: float = 1e-3
    warm_up: int = 50

    def done(self, step: int, seconds: float) -> float:
        """Share of the training that is behind, 0 to 1. By time it depends on the machine, by steps it does not."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(step / self.steps)
        if self.minutes is not None:
            shares.append(seconds / (60 * self.minutes))
        return min(max(shares), 1.0)

    def rate(self, step: int, done: float) -> float:
        """Learning rate of the step to come."""
        return self.learning_rate * min(1.0, (step + 1) / self.warm_up) * (0.51 + 0.49 * math.cos(math.pi * done))


@dataclass
class Progress:
    """Where a training stands."""

    step: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)
    """Mean losses [J] of the steps since the last line of metrics."""
    distances: list[float] = field(default_factory=list)
    """Distances from the scans [m] of those of these steps that were on scans."""


class Trainer:
    """Trains one garment network in a folder.

    With ``torch.distributed`` initialised each process plays its share of the streams; gradients are averaged and the
    first process writes.
    """

    def __init__(
        self, folder: Path, network: GarmentNetwork, objective: Objective, motions: Motions, held_out: Motions | None,
        schedule: Schedule, seed: int = 0, say: Callable[[str], None] = print, scans: Scans | None = None,
    ) -> None:  # fmt: skip
        """``network`` is trained in place; ``held_out`` motions are validated on at checkpoints.

        With ``scans`` one epoch of the motions alternates with four of the scans' poses, an epoch being the steps in
        which every scan is shown once; if these come without physics the motions, which have nothing else, are left
        out.
        """
        self.folder, self.network, self.objective = folder, network, objective
        self.held_out, self.schedule, self.say = held_out, schedule, say
        self.rank, self.world = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        if schedule.streams % self.world:
            raise CaphyError(f"the {schedule.streams} streams must divide evenly among {self.world} processes")
        share = schedule.streams // self.world
        own = slice(self.rank * share, (self.rank + 1) * share)
        device = network.template.device
        self.learner = Learner(network, stiffness(objective.potential, network.fps)).to(device)
        self.model = self.learner
        if self.world > 1:
            self.model = torch.nn.parallel.DistributedDataParallel(self.learner, forward_sync_buffers=False)
        weights, biases = ([p for p in self.learner.parameters() if p.ndim == n] for n in (2, 1))
        groups = [{"params": weights, "weight_decay": DECAY}, {"params": biases, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), fused=True)
        self.usual = USUAL * float(objective.potential.cloth.vertex_area.sum())
        self.track = Track(motions, Streams(motions, schedule.streams, seed), objective, network, own)
        self.scans, self.scan_track = scans, None
        if scans is not None:
            streams = ScanStreams(len(scans.motions), schedule.streams, seed)
            self.scan_track = Track(scans.motions, streams, scans.loss, network, own, last=True)
        self.progress = Progress()

    def step(self, done: float = 0.0) -> float:
        """One step on the next window of every stream, ``done`` of the schedule being behind.

        Returns the mean loss [J] of this process's share.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.schedule.rate(self.progress.step, done)
        track = self._turn()
        loss = track.advance(self.model)[1]
        self._require_finite(loss.detach().sum())
        self.optimizer.zero_grad()
        self.averaged(loss).backward()
        self._require_finite(*(p.grad for p in self.learner.parameters() if p.grad is not None))
        self.optimizer.step()
        self.progress.step += 1
        if self.scans is not None and track is self.scan_track:
            self.progress.distances.append(self.scans.loss.distance)
        return float(loss.detach().mean())

    def averaged(self, loss: Tensor) -> Tensor:
        """Losses of windows [J] as one number to descend: their mean, evened where physics alone teaches."""
        return (loss if self.scans is not None else evened(loss, self.usual)).mean()

    def _turn(self) -> Track:
        """Whose turn the next step is."""
        if self.scans is None or self.scan_track is None:
            return self.track
        epoch = -(-len(self.scans.motions) * HELD_WINDOWS // self.schedule.streams)
        place = self.progress.step % ((RANDOM_EPOCHS + SCAN_EPOCHS) * epoch)
        return self.track if self.scans.loss.physics and place < RANDOM_EPOCHS * epoch else self.scan_track

    def _require_finite(self, *values: Tensor) -> None:
        if not torch.isfinite(torch.stack([value.sum() for value in values]).sum()):  # asked once: a GPU is waited for
            kept = (self.folder / CHECKPOINT).is_file()
            raise CaphyError(
                f"step {self.progress.step + 1}: the prediction, its potential or the gradient is not finite; check "
                "the garment with 'caphy garment info' and the model's parameters, then "
                + (f"go on with --resume from the last good checkpoint in {self.folder}" if kept else "train again")
            )

    def run(self, checkpoint_seconds: float = 120.0) -> None:
        """Train until the schedule is done, from wherever :attr:`progress` stands."""
        if self.rank == 0 and self.progress.step == 0:
            forget_later(self.folder / METRICS, 0)  # of a training that ended before its first checkpoint
        last = saved = time.monotonic()
        logged, first_step, first_seconds = last, self.progress.step, self.progress.seconds
        while (done := self._share_done()) < 1:
            self.progress.losses.append(self.step(done))
            now = time.monotonic()
            self.progress.seconds += now - last
            if now - logged >= LOG_SECONDS:
                pace = (self.progress.step - first_step) / (self.progress.seconds - first_seconds)
                self._log(pace)
                logged = now
            if self._agreed(now - saved >= checkpoint_seconds):
                self.save()
                saved = time.monotonic()
            last = time.monotonic() if saved > now else now
        self.save()

    @property
    def done(self) -> bool:
        """Whether the schedule leaves nothing to do; all processes agree on it once they have resumed."""
        return self.schedule.done(self.progress.step, self.progress.seconds) >= 1

    @property
    def written(self) -> bool:
        """Whether the network's file is there; all processes agree on it."""
        return self._agreed((self.folder / NETWORK).is_file())

    def _share_done(self) -> float:
        return self._common(self.schedule.done(self.progress.step, self.progress.seconds))

    def _agreed(self, flag: bool) -> bool:
        return self._common(float(flag)) > 0

    def _common(self, value: float) -> float:
        """The first process's value, in all of them."""
        if self.world == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64)
        dist.broadcast(shared, 0)
        return float(shared)

    def save(self) -> None:
        """Validate, and write the network, the checkpoint and a line of metrics."""
        streams = self.track.state()
        if self.scan_track is not None:
            streams |= {f"scans.{key}": value for key, value in self.scan_track.state().items()}
        if self.rank:
            return
        self.learner.fold(self.network)
        save_network(self.network, self.folder / NETWORK)
        if self.held_out is not None:
            self._write({"validation": validate(self.network, self.objective, self.held_out).summary()})
        save_checkpoint(self.folder, {"learner": self.learner}, self.optimizer, streams, vars(self.progress))

    def resume(self) -> None:
        """Go on from the folder's checkpoint.

        Raises
            CaphyError: if there is none, it is damaged or it does not fit.
        """
        streams, progress = load_checkpoint(self.folder, {"learner": self.learner}, self.optimizer)
        scans = {key.removeprefix("scans."): value for key, value in streams.items() if key.startswith("scans.")}
        if bool(scans) != (self.scan_track is not None):
            raise CaphyError(f"{self.folder}: was trained {'with' if scans else 'without'} scans; go on likewise")
        try:
            self.track.restore(streams)
            if self.scan_track is not None:
                self.scan_track.restore(scans)
        except CaphyError as error:
            raise CaphyError(f"{self.folder}: {error}") from error
        self.progress = Progress(**{key: progress[key] for key in vars(self.progress) if key in progress})
        if self.rank == 0:
            forget_later(self.folder / METRICS, self.progress.step)

    def _log(self, steps_per_second: float) -> None:
        done = self.schedule.done(self.progress.step, self.progress.seconds)
        loss = sum(self.progress.losses) / len(self.progress.losses)
        self.progress.losses.clear()
        if self.rank:
            return
        frames = steps_per_second * self.schedule.streams * 5
        left = self.progress.seconds * (1 - done) / max(done, 1e-9) / 60
        rate = self.optimizer.param_groups[0]["lr"]
        entry, beside = {"loss_J": round(loss, 6), "frames_per_s": round(frames, 1), "learning_rate": rate}, ""
        if self.progress.distances:
            apart = 1e3 * sum(self.progress.distances) / len(self.progress.distances)
            entry["rms_from_scans_mm"] = round(apart, 3)
            beside = f"{apart:.2f} mm from the scans  "
            self.progress.distances.clear()
        self._write(entry)
        self.say(
            f"{100 * done:5.1f} %  step {self.progress.step}  {'loss' if self.scans else 'potential'} {loss:.4f} J  "
            f"{beside}{frames:.0f} frames/s  {left:.0f} min left"
        )

    def _write(self, entry: dict) -> None:
        entry = {"step": self.progress.step, "seconds": round(self.progress.seconds, 1), **entry}
        with (self.folder / METRICS).open("a") as stream:
            stream.write(json.dumps(entry) + "\n")


def forget_later(path: Path, step: int) -> None:
    """Drop the lines of metrics written after a checkpoint of ``step``: they will be written again."""
    if path.exists():
        kept = [entry for entry in read_metrics(path) if entry["step"] <= step]
        write_text(path, "".join(f"{json.dumps(entry)}\n" for entry in kept))


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of metrics, oldest first; one that was cut when the training was killed is no line."""
    whole = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        with suppress(json.JSONDecodeError):
            whole.append(json.loads(line))
    return whole
