"""Fine-tuning of garments worn together until they stop passing through each other (CaPhy, section 3.5)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.io.training_folder import METRICS, NETWORK
from caphy.kept import digest
from caphy.network.files import save_network
from caphy.training.checkpoint import load_checkpoint, save_checkpoint
from caphy.training.layers import Layers
from caphy.training.loop import Schedule, Trainer, evened, forget_later
from caphy.training.scans import Scans, ScanStreams
from caphy.training.streams import HELD_WINDOWS, Streams
from caphy.training.track import Track
from caphy.training.validate import SETTLED, validate

EPOCHS = 10
"""Epochs of fine-tuning (CaPhy, section 3.5)."""
LEAST_STEPS = 30
"""Steps of an epoch of random poses, and of one of the scans', at least."""
LEARNING_RATE = 3e-4
"""Above the rate at which a training ends, below the one it had: at 5e-4 finished networks lose what they know."""
USUAL_CONTACT = 0.02
"""Contact between garments [J] beyond which a frame counts for less: five vertices that have just changed places.

In the plain mean a few frames with a thigh in the belly, where there is no room to make, are all that is descended."""
STRONGEST = 2.0
"""Largest gradient of the contact in gradients of all else: a pose in which much collides must not undo the others."""
DEEP = 0.001
"""A vertex deeper than this on the wrong side of another garment counts as a collision [m]."""
EVERY = 5
"""Every so many frames collisions are counted."""


class Collisions(NamedTuple):
    """How many vertices lie deep on the wrong side of another garment, and how many meet one."""

    deep: int
    met: int


class Collider:
    """Several trainings gone on with together: each one's own loss, and the contact of any two garments.

    Steps on random poses and on the scans' poses take turns; all garments wear the same pose. Without scans, or where
    one garment has none, all steps are on random poses; where scans came without physics none are. Scans that not all
    were trained on are passed over.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], trainings: Sequence[Trainer], epochs: int = EPOCHS, seed: int = 0,
        streams: int = 8, say: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        """``trainings`` from the inside out, ``names`` those of their folders under ``folder``.

        Raises:
            CaphyError: there are fewer than two, or they were not trained on the same body, motions and scans.
        """
        if len(trainings) < 2:
            raise CaphyError(f"collisions need at least two garments, got {len(trainings)}")
        _require_alike(names, trainings)
        self.folder, self.names, self.say, self.trainings = folder, list(names), say, list(trainings)
        self.layers = Layers([t.objective.potential.cloth for t in trainings])
        self.learners = nn.ModuleList(t.learner for t in trainings)
        groups = [
            {"params": group["params"], "weight_decay": group["weight_decay"]}
            for training in trainings
            for group in training.optimizer.param_groups
        ]
        self.optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), fused=True)
        self.inputs = _inputs(trainings, seed)
        """A digest of what the fine-tuning begins with."""
        scans, steps = [t.scans for t in trainings if t.scans is not None], 0
        shown = len(scans) == len(trainings)
        taught = all(each.loss.physics for each in scans)  # scans alone have no physics to show on random poses
        self.turns = [_random_tracks(trainings, streams, seed)] if taught or not shown else []
        if shown:
            self.turns.append(_scan_tracks(trainings, scans, streams, seed))
            steps = -(-len(self.turns[-1][0].motions) * HELD_WINDOWS // streams)
        self.epoch_steps = len(self.turns) * max(steps, LEAST_STEPS)
        """Steps of an epoch, those on random poses and those on scans."""
        self.schedule = Schedule(epochs * self.epoch_steps, None, streams, LEARNING_RATE, warm_up=20)
        self.done, self.seconds = 0, 0.0
        self.before: Collisions | None = None
        """Collisions of the networks as they were given."""
        folder.mkdir(parents=True, exist_ok=True)
        self.contact = 0.0
        """Mean energy [J] of contact between the garments in the last step."""

    def step(self) -> float:
        """One step of all garments; returns the mean loss of all together [J]."""
        assert self.schedule.steps is not None
        for group in self.optimizer.param_groups:
            group["lr"] = self.schedule.rate(self.done, self.done / self.schedule.steps)
        tracks = self.turns[self.done % len(self.turns)]
        results = [track.advance(learner) for track, learner in zip(tracks, self.learners, strict=True)]
        own = sum(float(loss.detach().mean()) for _, loss in results)
        learnt = torch.stack([t.averaged(loss) for t, (_, loss) in zip(self.trainings, results, strict=True)]).sum()
        self._require_finite(learnt.detach())
        contact = self.layers([x for x, _ in results])
        self._descend(learnt, evened(contact, USUAL_CONTACT).mean())
        self.optimizer.step()
        self.done, self.contact = self.done + 1, float(contact.detach().mean())
        return own + self.contact

    def _descend(self, own: Tensor, contact: Tensor) -> None:
        """Set gradients: those of the garments' own losses, and the contact's as far as they do not drown them."""
        parameters = list(self.learners.parameters())
        pull = torch.autograd.grad(own, parameters, retain_graph=True)
        push = torch.autograd.grad(contact, parameters, allow_unused=True, materialize_grads=True)
        self._require_finite(*pull, *push)
        size = [torch.stack([g.norm() for g in gradient]).norm() for gradient in (pull, push)]
        share = (STRONGEST * size[0] / size[1].clamp_min(1e-30)).clamp_max(1)
        for parameter, one, other in zip(parameters, pull, push, strict=True):
            parameter.grad = one + share * other

    def run(self) -> None:
        """Fine-tune to the end, saving after every epoch; then validate, and count collisions before and after."""
        assert self.schedule.steps is not None
        if self.done == 0:
            forget_later(self.folder / METRICS, 0)  # of a fine-tuning that ended before its first checkpoint
            self.before = self.collisions()
        while self.done < self.schedule.steps:
            started, losses, contacts = time.monotonic(), [], []
            for _ in range(self.epoch_steps):
                losses.append(self.step())
                contacts.append(self.contact)
            self.seconds += time.monotonic() - started
            self._log(float(np.mean(losses)), float(np.mean(contacts)))
            self.save()
        for name, training in zip(self.names, self.trainings, strict=True):
            training.learner.fold(training.network)
            if training.held_out is not None:
                found = validate(training.network, training.objective, training.held_out).summary()
                line = {"step": self.done, "seconds": round(self.seconds, 1), "validation": found}
                write_text(self.folder / name / METRICS, json.dumps(line) + "\n")
        before, after = self.before, self.collisions()
        if before is not None and after is not None:
            self.say(
                f"vertices over {1e3 * DEEP:g} mm on the wrong side of another garment, on motions held out: "
                f"{before.deep} of {before.met} before, {after.deep} of {after.met} now"
            )

    @torch.no_grad()
    def collisions(self) -> Collisions | None:
        """Of the networks as they are, in each fifth frame of motions held out; none without such motions."""
        motions = self.trainings[0].held_out
        if motions is None:
            return None
        depths = []
        for first, last in pairwise(motions.starts.tolist()):
            clip = slice(first, last)
            streams = [t.network.stream(motions.poses[clip], motions.transl[clip]) for t in self.trainings]
            depths += [self.layers.depths(frame) for frame in zip(*(x[SETTLED::EVERY] for x in streams), strict=True)]
        found = np.concatenate(depths)
        return Collisions(int((found > DEEP).sum()), len(found))

    def save(self) -> None:
        """Write the networks and the checkpoint."""
        for name, training in zip(self.names, self.trainings, strict=True):
            training.learner.fold(training.network)
            save_network(training.network, self.folder / name / NETWORK)
        states = {
            f"{turn}.{layer}.{key}": value
            for turn, tracks in enumerate(self.turns)
            for layer, track in enumerate(tracks)
            for key, value in track.state().items()
        }
        progress = {"done": self.done, "seconds": self.seconds, "names": self.names, "steps": self.schedule.steps}
        progress["inputs"] = self.inputs
        save_checkpoint(self.folder, self._modules(), self.optimizer, states, progress)

    def resume(self) -> None:
        """Go on from the folder's checkpoint.

        Raises:
            CaphyError: there is none, it is damaged or of other garments.
        """
        self.before = self.collisions()
        states, progress = load_checkpoint(self.folder, self._modules(), self.optimizer)
        for what, own in (("names", self.names), ("steps", self.schedule.steps)):
            if progress[what] != own:
                raise CaphyError(f"{self.folder}: its checkpoint is of {what} {progress[what]}, not {own}")
        if progress.get("inputs", self.inputs) != self.inputs:
            raise CaphyError(
                f"{self.folder}: its checkpoint is of other networks, models, motions, scans or another seed; go on "
                "with the same, or begin anew in another folder"
            )
        for turn, tracks in enumerate(self.turns):
            for layer, track in enumerate(tracks):
                prefix = f"{turn}.{layer}."
                track.restore({k.removeprefix(prefix): v for k, v in states.items() if k.startswith(prefix)})
        self.done, self.seconds = progress["done"], progress["seconds"]
        forget_later(self.folder / METRICS, self.done)

    def _modules(self) -> dict[str, nn.Module]:
        return {f"learner{i}": learner for i, learner in enumerate(self.learners)}

    def _require_finite(self, *values: Tensor) -> None:
        if not torch.isfinite(torch.stack([value.sum() for value in values]).sum()):
            raise CaphyError(
                f"step {self.done + 1}: a prediction, its loss or the gradient is not finite. The last good checkpoint "
                f"is kept in {self.folder}; check the trainings with 'caphy validate', then go on with --resume"
            )

    def _log(self, loss: float, contact: float) -> None:
        assert self.schedule.steps is not None
        left = self.seconds * (self.schedule.steps - self.done) / self.done / 60
        frames = self.done * self.schedule.streams * len(self.names) * 5 / self.seconds
        entry = {"step": self.done, "seconds": round(self.seconds, 1), "loss_J": round(loss, 6)}
        with (self.folder / METRICS).open("a") as stream:
            stream.write(json.dumps(entry | {"contact_J": round(contact, 8)}) + "\n")
        self.say(
            f"epoch {self.done // self.epoch_steps}  loss {loss:.4f} J  contact between garments {contact:.2g} J  "
            f"{frames:.0f} frames/s  {left:.0f} min left"
        )


def _inputs(trainings: Sequence[Trainer], seed: int) -> str:
    def of(training: Trainer) -> tuple:
        network = {name: value.cpu().numpy() for name, value in training.network.state_dict().items()}
        potential, motions, scans = training.objective.potential, training.track.motions, training.scans
        cloth = potential.cloth.vertices, potential.cloth.faces, potential.cloth.mass, potential.model.to_json()
        seen = None if scans is None else (scans.motions.names, [target.sample for target in scans.loss.targets])
        return network, cloth, (motions.poses, motions.transl, motions.starts), seen

    return digest(seed, [of(training) for training in trainings])


def _random_tracks(trainings: Sequence[Trainer], streams: int, seed: int) -> list[Track]:
    own = slice(0, streams)
    return [
        Track(t.track.motions, Streams(t.track.motions, streams, seed), t.objective, t.network, own) for t in trainings
    ]


def _scan_tracks(trainings: Sequence[Trainer], scans: Sequence[Scans], streams: int, seed: int) -> list[Track]:
    names = _in_all(scans)
    played = [(t.network, own.only(names)) for t, own in zip(trainings, scans, strict=True)]
    return [
        Track(own.motions, ScanStreams(len(names), streams, seed), own.loss, network, slice(0, streams), last=True)
        for network, own in played
    ]


def _in_all(scans: Sequence[Scans]) -> list[str]:
    """Names of the scans that all garments were trained on, as the first has them."""
    return [name for name in scans[0].motions.names if all(name in other.motions.names for other in scans)]


def _require_alike(names: Sequence[str], trainings: Sequence[Trainer]) -> None:
    first = trainings[0]
    scans = [] if first.scans is None else [first.scans]
    for name, other in zip(names[1:], trainings[1:], strict=True):
        mine, yours = first.track.motions, other.track.motions
        scans += [] if other.scans is None else [other.scans]
        apart = bool(scans) and not _in_all(scans)
        if not torch.allclose(first.network.joints, other.network.joints, atol=1e-4):
            raise CaphyError(f"{name}: was trained on another body than {names[0]}; train them on the same one")
        if first.network.fps != other.network.fps:
            raise CaphyError(f"{name}: runs at {other.network.fps:g} fps, {names[0]} at {first.network.fps:g}")
        if apart or mine.names != yours.names or not np.array_equal(mine.starts, yours.starts):
            raise CaphyError(f"{name}: was trained on other poses or scans than {names[0]}; give both the same")
