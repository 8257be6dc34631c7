"""How near the reference solver itself comes to held-out scans of a virtual session: what networks hardly beat.

    OMP_NUM_THREADS=1 python -m benchmarks.solver_floor RUN SESSION [--fabric gray-interlock]

SESSION is what ``caphy capture-sim`` wrote, RUN what ``caphy fit`` or ``caphy register`` made of it. Six rows: what
made the scans, draped again; the same on another mesh than the rig's, and also on the way into the pose, for clothes
that do not rub on the skin come to rest where their way led them; the true body and poses in the templates that were
found; and body, poses and templates as found, in the true fabric and in the measured one that a fit starts from.
Chamfer as ``caphy evaluate`` has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from caphy.capture.drape import Dresser
from caphy.capture.session import read_subject
from caphy.capture.subject import Fabric
from caphy.capture.subject import Subject as Person
from caphy.evaluate.dressed import Dressed, Subject
from caphy.evaluate.score import HeldOut
from caphy.garment.families import make
from caphy.io.poses import PoseSequence, read_poses
from caphy.register.points import read_points
from caphy.scan.scan_set import ScanSet
from caphy.solve.body_motion import BodyMotion

EDGE_LENGTH = 0.0205
"""Of the true cut's other mesh [m], about that of templates; the rig's is 0.018."""


@dataclass(frozen=True)
class Options:
    """What to hold against what."""

    run: tyro.conf.Positional[Path]
    """Folder with subject_body.npz, upper.npz, lower.npz, points, split.json, scans and labels."""
    session: tyro.conf.Positional[Path]
    """Folder of the session, with its truth."""
    fabric: str = "gray-interlock"
    """The measured fabric that a fit starts from."""


def main() -> None:
    """Drape, compare, print."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    truth, found = read_subject(options.session / "truth"), Subject.read(options.run)
    poses = read_poses(options.session / "truth" / "poses.npz")
    scans = ScanSet.read(options.run / "scans", options.run / "labels")
    names = [path.stem for path in sorted((options.session / "truth" / "stills").glob("*.npz"))]
    templates = {label: found.garments[label] for label in truth.garments}
    as_found = replace(truth, body=found.body, garments=templates, rough=templates)
    cuts = {k: make(replace(cut, edge_length=EDGE_LENGTH), truth.body) for k, cut in truth.families.items()}
    started = {label: Fabric(options.fabric, 1.0, 1.0, fabric.density) for label, fabric in truth.fabrics.items()}
    rows: Mapping[str, tuple[Person, bool]] = {
        "what made the scans": (truth, True),
        "true body, poses, cut and fabric; another mesh": (replace(truth, garments=cuts), True),
        "the same, worn into the pose on that mesh too": (replace(truth, garments=cuts, rough=cuts), True),
        "true body, poses and fabric; found templates": (replace(truth, garments=templates, rough=templates), True),
        "found body, poses and templates; true fabric": (as_found, False),
        f"found body, poses and templates; {options.fabric}": (replace(as_found, fabrics=started), False),
    }
    for row, (subject, true_poses) in rows.items():
        scores = []
        for points in read_points(options.run, "held_out"):
            true = poses[names.index(points.name) : names.index(points.name) + 1]
            pose = true if true_poses else replace(true, poses=points.pose[None], transl=points.transl[None])
            held = HeldOut(scans[scans.names.index(points.name)], points, tuple(subject.garments))
            scores.append(_score(subject, pose, held))
            print(f"  {row}, {points.name}: {scores[-1]['clothes_chamfer_mm']:.2f} mm", flush=True)
        mean = {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}
        print(
            f"{row}: Chamfer {mean['clothes_chamfer_mm']:.2f} mm ("
            + ", ".join(f"{kind} {mean[f'{kind}_chamfer_mm']:.2f}" for kind in subject.garments)
            + f"), mean {mean['mean_mm']:.2f} mm",
            flush=True,
        )


def _score(subject: Person, pose: PoseSequence, held: HeldOut) -> dict[str, float]:
    """Figures of what the solver drapes in a pose."""
    cloth, _ = Dresser(subject, pose).dressed(0)
    skin = BodyMotion(subject.body, pose, next(iter(subject.garments.values()))).vertices(np.zeros(1))[0]
    worn = {kind: (cloth[kind], garment.faces) for kind, garment in subject.garments.items()}
    return held.score(Dressed(skin, subject.body.faces, worn), None)


if __name__ == "__main__":
    main()
