"""``caphy validate``: hold a trained network against the reference solver, and let it stream for long."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from caphy.commands.begun import exporting, own_body
from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.io.training_folder import GARMENT, MODEL, NETWORK, RECORD

if TYPE_CHECKING:
    from caphy.io.poses import PoseSequence

REPORT = "validation.json"
"""Written into the run's folder; 'caphy export' puts it into the avatar's manifest."""


@dataclass(frozen=True)
class Validate:
    """Measure a trained network on motions: potential beside the reference solver's, and drift of a long stream."""

    run: tyro.conf.Positional[Path]
    """Folder that 'caphy train' wrote."""
    poses: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Pose files; those held out of training unless given."""
    seconds: float = 1.5
    """How much of each motion is solved [s]; the solver takes about a second a frame."""
    frames: int = 10_000
    """Length of the stream whose drift is measured [frames]."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own that the model uses."""


def main(arguments: list[str]) -> None:
    """Entry point of ``caphy validate``."""
    options = tyro.cli(Validate, args=arguments, prog="caphy validate")
    settings = _read(options.run / RECORD)
    if not 0.1 < options.seconds < float("inf"):
        raise CaphyError(f"--seconds must be more than 0.1 and finite, got {options.seconds}")
    if options.frames < 1:
        raise CaphyError(f"--frames must be at least 1, got {options.frames}")

    import numpy as np
    import torch

    from caphy.body.bundled import default_body
    from caphy.body.model import BodyModel
    from caphy.effects.cloth import Cloth
    from caphy.effects.model import Model
    from caphy.effects.own import use_file
    from caphy.effects.potential import Potential
    from caphy.garment.template import Garment
    from caphy.network.files import load_network
    from caphy.training.reference import Comparison, compare_with_solver
    from caphy.training.validate import stream_drift

    for file in options.effect_file:
        use_file(file)
    network = load_network(options.run / NETWORK)
    clips = _clips(options, settings, network.fps)
    garment, model = Garment.load(options.run / GARMENT), Model.load(options.run / MODEL)
    body = default_body() if (own := own_body(options.run)) is None else BodyModel.load(own)
    betas = np.array(settings["betas"]) if settings.get("betas") else None
    potential = Potential(model, Cloth.of(garment, model.density))

    started, parts = time.monotonic(), []
    report: dict[str, Any] = {"clips": {}}
    for number, (name, clip) in enumerate(zip(_names(clips), clips, strict=True), 1):
        short = clip.resample(network.fps)[: round(options.seconds * network.fps) + 1]
        parts.append(compare_with_solver(network, potential, body, garment, short, betas))
        report["clips"][name] = parts[-1].summary()
        left = (time.monotonic() - started) / number * (len(clips) - number)
        print(f"{name}: {_line(parts[-1].summary())}  ({left:.0f} s left)", flush=True)
    joined = (np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Comparison))
    report |= Comparison(*joined).summary()
    motion = max(clips, key=len).resample(network.fps)
    poses, transl = (torch.tensor(a, dtype=torch.float32) for a in (motion.poses, motion.transl))
    report["drift_mm"] = 1e3 * stream_drift(network, poses, transl, options.frames)
    report["drift_frames"] = options.frames
    report["network_sha256"] = hashlib.sha256((options.run / NETWORK).read_bytes()).hexdigest()
    print(f"all: {_line(report)}; drift over {options.frames} frames {report['drift_mm']:.2g} mm")
    write_text(options.run / REPORT, json.dumps(report, indent=2) + "\n")
    print(f"wrote {options.run / REPORT}\nnext: {exporting(options.run.name, options.run)}")


def _names(clips: Sequence[PoseSequence]) -> list[str]:
    """Names of the clips' files; where some are alike, with what tells their folders apart, or a number."""
    parts = [Path(clip.source).parts for clip in clips]
    most = len(set(parts))
    length = next(n for n in range(1, max(map(len, parts)) + 1) if len({each[-n:] for each in parts}) == most)
    names, tails = [each[-1] for each in parts], ["/".join(each[-length:]) for each in parts]  # avatars carry them on:
    told = [name if names.count(name) == 1 else tail for name, tail in zip(names, tails, strict=True)]  # no whole paths
    return [one if told.count(one) == 1 else f"{one} ({told[: i + 1].count(one)})" for i, one in enumerate(told)]


def _line(summary: dict) -> str:
    return (
        f"potential {summary['potential_J']:.3f} J, solver {summary['potential_of_solver_J']:.3f} J, "
        f"skinned template {summary['potential_of_skinned_template_J']:.3f} J; "
        f"{summary['distance_to_solver_mm']:.1f} mm from the solver"
    )


def _read(path: Path) -> dict:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CaphyError(f"{path.parent}: is not a folder that 'caphy train' wrote: {error}") from error


def _clips(options: Validate, settings: dict, fps: float) -> list[PoseSequence]:
    """Motions of 2 frames or more at a rate [Hz]."""
    from caphy.commands.train import FPS, PROCEDURAL_SECONDS
    from caphy.io.poses import read_poses
    from caphy.io.poses.parts import file_of, read_part
    from caphy.io.procedural import procedural_motion

    if options.poses:
        clips = [read_poses(path).require_world() for path in options.poses]
        for clip in clips:
            if len(clip.resample(fps)) < 2:
                raise CaphyError(f"{clip.source}: must have 2 frames or more at {fps:g} fps; give a longer motion")
        return clips
    clips = []
    for name in settings.get("held_out_paths", []):
        if (made := re.fullmatch(r"procedural motion, seed (\d+)", name)) is not None:
            clips.append(procedural_motion(int(made[1]), PROCEDURAL_SECONDS, FPS))
        elif not Path(file_of(name)).is_file():
            print(f"note: {name} was held out of training, and is not there any more")
        elif len((clip := read_part(name)).resample(fps)) >= 2:
            clips.append(clip)
    if not clips:
        raise CaphyError(f"{options.run}: none of the motions held out of training is there any more; give pose files")
    return clips
