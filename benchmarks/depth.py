"""How much of the default T-shirt lies in the body, and how much of it would where its potential is least.

    OMP_NUM_THREADS=1 python -m benchmarks.depth POSES... [--garment trousers] [--stiffer 10]

At some moments of each motion the network's cloth is handed to the solver, which moves it, from the network's own
past, to the nearest minimum of the very potential that the network was trained on. Cloth between an arm and the ribs is
pushed from both sides and lies deeper than 1 mm there too, so that no training on this potential brings it to nothing.
``--stiffer`` and ``--thicker`` give the solver another contact than the network was trained on.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from caphy.body.bundled import default_body, default_body_path
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.garment.template import Garment
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.training.initial import read_initial
from caphy.training.motions import find_poses
from caphy.training.reference import correct
from caphy.training.validate import DEEP

BEFORE, LOOKED_AT = 40, 4
"""Frames that the network streams before each moment, and those that are looked at."""


@dataclass(frozen=True)
class Options:
    """What to look at."""

    poses: tyro.conf.Positional[tuple[Path, ...]]
    """Pose files, or folders of them."""
    garment: str = "tshirt"
    """Of the default avatar."""
    moments: int = 4
    """In each motion."""
    stiffer: float = 1.0
    """Times the stiffness of contact that the network was trained on: what the solver gets."""
    thicker: float = 1.0
    """Times the distance at which contact begins, likewise."""


def main(options: Options) -> None:
    """Print a line for each motion, then the mean over motions."""
    torch.set_num_threads(1)
    data, body = default_body_path().parent, default_body()
    garment = Garment.load(data / "garments" / f"{options.garment}.npz")
    avatar = read_initial(data / "avatars" / "default", garment)
    model = Model.from_json(json.dumps(avatar.model), "the default avatar's model")
    contact = model.effects["body_contact"]
    model = model.with_effect(
        "body_contact",
        stiffness=options.stiffer * contact["stiffness"],
        distance=options.thicker * contact["distance"],
    )
    newton = Newton(Potential(model, Cloth.of(garment, model.density)))
    found = []
    for clip in (clip.resample(avatar.network.fps) for clip in find_poses(options.poses)):
        if len(clip) < BEFORE + LOOKED_AT:
            continue
        shares = []
        for last in np.linspace(BEFORE + LOOKED_AT, len(clip), options.moments).astype(int):
            motion = BodyMotion(body, clip[last - BEFORE - LOOKED_AT : last], garment)
            seen = avatar.network.stream(motion.poses.poses[1:], motion.poses.transl[1:])[-LOOKED_AT:]
            short = BodyMotion(body, clip[last - LOOKED_AT - 1 : last], garment)
            predicted = torch.from_numpy(seen).double()
            shares.append([deep(short, predicted), deep(short, correct(newton, short, predicted))])
        found.append(np.mean(shares, axis=0))
        print(f"{Path(clip.source).name}: network {found[-1][0]:.2f} %, solver {found[-1][1]:.2f} %", flush=True)
    network, solver = np.mean(found, axis=0)
    print(f"deeper than {1e3 * DEEP:g} mm: network {network:.2f} %, solver from there {solver:.2f} % of the vertices")


def deep(motion: BodyMotion, frames: Tensor) -> float:
    """Percentage of the vertices of frames (T - 1, V, 3) [m] deeper than 1 mm in the body."""
    share = []
    for time, x in zip(motion.times[1:].tolist(), frames, strict=True):
        body = motion.state(time, x.numpy(), 1 / motion.fps)
        share.append(float((((body.point - x) * body.normal).sum(-1) > DEEP).double().mean()))
    return 100 * float(np.mean(share))


if __name__ == "__main__":
    main(tyro.cli(Options))
