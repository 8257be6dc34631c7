"""What it costs to screen a measurement against the whole library, on one core.

    OMP_NUM_THREADS=1 python -m benchmarks.screening

Two motions of the challenge's square of 48 frames each, in which nothing is hidden, seen on meshes of 289 and 1,225
vertices: all windows rolled out, tangents of every number of every effect, flexible forces, scores and the null. Then
the same with 26 explanations and no flexible forces.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro

from caphy.challenge.hidden import Hidden
from caphy.challenge.recording import record, seen_by_user
from caphy.challenge.sheets import corners, users_square
from caphy.challenge.square import square
from caphy.diagnose.groups import columns_of, explanations
from caphy.diagnose.screen import bounds, null_gains, screened
from caphy.diagnose.search import screen
from caphy.effects.model import Model
from caphy.measure.scene import Scene
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.study import Study

FRAMES = 48
SIDES = (17, 35)
"""Vertices along a side of the user's mesh."""
FEW = 26
"""Explanations of the smaller screen."""
CACHE = Path("challenge-cache")


def main() -> None:
    """Print seconds of processor time."""
    torch.set_num_threads(1)
    stage = square(1, FRAMES)
    plays = [play for play in stage.plays if play.part == "train"][:2]
    films = [record(stage, play, Hidden("nothing"), 1, FRAMES, CACHE) for play in plays]
    for side in SIDES:
        garment = users_square(side)
        seen = replace(stage, user=garment)
        measured = [
            seen_by_user(
                seen,
                replace(play, keys={**play.keys, "pinned": corners(garment)}),
                film,
                1.0,
                None,
                np.random.default_rng(play.number),
            )
            for play, film in zip(plays, films, strict=True)
        ]
        study = Study([Scene.of(measurement) for measurement in measured])
        began = time.process_time()
        found = screen(study, stage.model, stage.model)
        seconds = time.process_time() - began
        columns = sum(len(group.columns) for group in found.groups)
        print(
            f"{len(garment.vertices):,} vertices, {len(plays) * FRAMES} frames in {len(found.responses)} windows: "
            f"{seconds:.0f} s of one core for {len(found.groups)} explanations with {columns} numbers, and "
            f"{found.flexible.known.b.shape[1]} flexible forces",
            flush=True,
        )
        began = time.process_time()
        columns = _some(Study([Scene.of(measurement) for measurement in measured]), stage.model)
        print(f"  {FEW} explanations with {columns} numbers alone: {time.process_time() - began:.0f} s", flush=True)


def _some(study: Study, model: Model) -> int:
    """Screen against some of the library, and tell how many numbers they have."""
    groups = [group for group in explanations(study, model, model) if not group.own][:FEW]
    columns, places = columns_of(groups)
    responses = study.respond(model, columns)
    known = evidence(responses, study.variance(responses))
    known = replace(known, weight=robust_weights(known))
    screened(known, groups, places, model)
    null_gains(known, [*places.values()], bounds(columns, model))
    return len(columns)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
