"""Body under clothing and template selection on a virtual rig's scans, held against the rig's truth.

    OMP_NUM_THREADS=1 python -m benchmarks.register [SESSION] [-o RUN] [--count N]

SESSION is a folder that ``caphy capture-sim`` wrote; without one a small session is made (clothes that follow the
skeleton, procedural poses, seconds a scan). The labels are the rig's own, so that the fit is judged and not the
segmentation. RUN keeps what is done: run it again to go on.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial import KDTree

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.body.surface import Surface
from caphy.capture.optics import Optics
from caphy.capture.session import Plan, capture
from caphy.garment.families import FAMILIES
from caphy.garment.landmarks import Landmarks
from caphy.register.articulation import Figure, Placement
from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.register.fit import BodyFit, Taken, fit_bodies
from caphy.register.pictures import fit_sheet
from caphy.register.result import write_fit
from caphy.register.store import Store
from caphy.register.styles import KINDS, TRIMS
from caphy.register.template import choose, plainest
from caphy.report.render import write_png
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from caphy.scan.scan_set import ScanSet, write_labels

BARE = 0.008
"""A true skin vertex is bare where a skin point of the scan lies within this [m], covered where only cloth is near."""
NEAR_CLOTH = 0.08
SHOWN = 0.01
"""A true cloth vertex is shown where a point of that cloth lies within this [m]."""


@dataclass(frozen=True)
class Options:
    """Fit and compare."""

    session: Annotated[Path | None, tyro.conf.Positional] = None
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    count: int = 12
    """Scans at most."""
    body: str = "medium"


def main(options: Options) -> None:
    """Fit, choose, print."""
    with tempfile.TemporaryDirectory() as scratch:
        session, run = options.session or _session(Path(scratch), options.count), options.output or Path(scratch)
        scans = ScanSet.read(session / "scans", _true_labels(session, run))
        body = default_body("fine" if options.body == "fine" else "medium")
        names = scans.names[: options.count]
        taken = [Taken(Cloud.of(scans[i]), _start(scans, i, body)) for i in range(len(names))]
        wall, work = time.monotonic(), time.process_time()
        fit = fit_bodies(body, taken, Store(run), _told())
        spent = time.monotonic() - wall, time.process_time() - work
        write_fit(fit, run, options.body)
        print(f"{len(fit.names)} of {len(names)} scans fitted; a scan took {spent[1] / len(names):.1f} s of one core")
        print(f"  ({spent[0] / len(names):.1f} s by the clock; 0 where RUN held it already)")
        for message in fit.failures.values():
            print(f"  left out: {message}")
        _print_body(fit, scans, session)
        _print_garments(fit, taken, session)
        shown = [scans[scans.names.index(name)] for name in fit.names[:4]]
        bodies = [fit.vertices(i) for i in range(len(shown))]
        print(write_png(fit_sheet(shown, bodies, body.faces), run / "body.png"))


def _session(folder: Path, count: int) -> Path:
    optics = Optics()
    capture(Plan(0, count, "tshirt", "trousers", None, "fine", 0.016, False, 20.0, optics), folder / "session")
    return folder / "session"


def _true_labels(session: Path, run: Path) -> Path:
    for still in sorted((session / "truth" / "stills").glob("*.npz")):
        path = run / "labels" / f"{still.stem}.npy"
        if not path.is_file():
            write_labels(path, np.load(still)["labels"])
    return run / "labels"


def _start(scans: ScanSet, index: int, body: BodyModel) -> Placement:
    assert scans.poses is not None
    transl = scans.poses.transl[index] + scans.poses.pelvis - body.joints[0]
    return Placement.of(scans.poses.poses[index], transl)


def _told():
    last = [0.0]

    def tell(what: str, done: int, total: int) -> None:
        if time.monotonic() - last[0] > 20:
            last[0] = time.monotonic()
            print(f"  {what}: {done} of {total}", flush=True)

    return tell


def _print_body(fit: BodyFit, scans: ScanSet, session: Path) -> None:
    truth = session / "truth"
    poses = np.load(truth / "poses.npz")["poses"]
    surface = Surface.of(fit.figure.body.faces, fit.figure.body.v_template)
    true_body = np.load(truth / "body.npz")
    true_surface = Surface.of(true_body["faces"], true_body["v_template"])
    turns, skin, covered, outside, hidden, start_turns = [], [], [], [], [], []
    for i, name in enumerate(fit.names):
        number, still = scans.names.index(name), np.load(truth / "stills" / f"{name}.npz")
        turns.append(_turns(fit.placements[i].rotations, poses[number]))
        assert scans.poses is not None
        start_turns.append(_turns(matrix_from_axis_angle(scans.poses.poses[number]), poses[number]))
        vertices, scan = fit.vertices(i), scans[number]
        away = np.abs(surface.nearest(still["body"], vertices).distance)
        bare, near = (
            KDTree(scan.vertices[mask]).query(still["body"])[0] for mask in (scan.labels == 0, scan.labels > 0)
        )
        skin.append(away[bare < BARE])
        covered.append(away[(near < NEAR_CLOTH) & (bare >= BARE)])
        for label, kind in enumerate(("upper", "lower"), 1):
            if kind in still:
                free = true_surface.nearest(still[kind], still["body"]).distance > 0  # where the truth itself is free
                cloth = still[kind][free]
                shown = KDTree(scan.vertices[scan.labels == label]).query(cloth)[0] < SHOWN
                out = -surface.nearest(cloth, vertices).distance
                outside.append(out[shown])
                hidden.append(out[~shown])
    skin, covered = np.concatenate(skin), np.concatenate(covered)
    start, turns = np.degrees(start_turns), np.degrees(turns)
    print("body against the truth (target in brackets)")
    print(f"  initial poses: joint angles {start.mean():.1f} degrees off in the mean")
    print(f"  joint angles {turns.mean():.2f} degrees off in the mean (4), worst scan {turns.mean(axis=1).max():.1f}")
    print(f"  bare skin {_mm(skin)} (3)")
    print(f"  covered skin {_mm(covered)} (8)")
    for what, parts in (("that the scan shows", outside), ("hidden under other cloth or unseen", hidden)):
        out = np.concatenate(parts)
        share, deepest = 100 * (out > 0.002).mean(), 1e3 * np.quantile(out, [0.99, 1.0])
        print(f"  true cloth {what}: body over 2 mm outside {share:.3f} % of it (0), ", end="")
        print(f"99 % within {max(deepest[0], 0):.1f} mm, all within {max(deepest[1], 0):.1f} mm")


def _turns(rotations: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Angles (22,) [rad] between body joints' rotations and a true pose (55, 3)."""
    true = matrix_from_axis_angle(pose[:22])
    return np.linalg.norm(axis_angle_from_matrix(rotations[:22].transpose(0, 2, 1) @ true), axis=-1)


def _mm(values: np.ndarray) -> str:
    return f"{1e3 * values.mean():.2f} mm off in the mean, 95 % within {1e3 * np.quantile(values, 0.95):.1f} mm"


def _print_garments(fit: BodyFit, taken: list[Taken], session: Path) -> None:
    told = json.loads((session / "truth" / "subject.json").read_text(encoding="utf-8"))["garments"]
    chosen = plainest(fit.placements)
    clouds = {scan.cloud.name: scan.cloud for scan in taken}
    for kind in KINDS:
        if kind not in told:
            continue
        wall, work = time.monotonic(), time.process_time()
        targets = [Target.of(clouds[fit.names[i]], fit.figure.placed(fit.placements[i]), kind) for i in chosen]
        choice = choose(fit.figure, targets, kind, _told())
        spent = time.process_time() - work
        print(f"{kind}: {choice.style.family}, truth {told[kind]['family']}; {choice.looked_at} styles, refined, in")
        print(
            f"  {spent:.0f} s of one core ({time.monotonic() - wall:.0f} s by the clock; 120); two-way distance "
            f"{1e3 * choice.distance:.1f} mm; best of " + ", ".join(f"{n} {1e3 * d:.1f}" for n, d in choice.runners_up)
        )
        for name, found, true in _lengths(choice.style, told[kind], fit.figure, session):
            print(f"  {name} {100 * found:.1f} cm, truth {100 * true:.1f} cm, {100 * (found - true):+.1f} (1.5)")


def _lengths(style, told: dict, figure: Figure, session: Path) -> Iterator[tuple[str, float, float]]:
    """Each length of the style and the true one [m]; what the truth leaves open is proportioned to the true body."""
    truth = np.load(session / "truth" / "body.npz")
    body = default_body("fine" if len(truth["v_template"]) > 5000 else "medium")
    marks = Landmarks(body, truth["v_template"], truth["joints"])
    usual = {
        "length": marks.joint("neck")[1] - marks.crotch - 0.03,
        "rise": 0.13 * marks.height,
        "sleeve": FAMILIES[told["family"]].arm_share
        * float(np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder")))
        if hasattr(FAMILIES[told["family"]], "arm_share")
        else 0.0,
        "leg": getattr(FAMILIES[told["family"]], "leg_share", 0.0) * (marks.crotch - marks.joint("left_ankle")[1]),
    }
    if told["family"] == "skirt":
        usual["length"] = 0.55 * (marks.crotch + usual["rise"] - marks.joint("left_ankle")[1])
    for name in (*TRIMS[style.family], "neck_width", "neck_depth"):
        if name in told["options"] and hasattr(style, name):
            true = told["options"][name]
            yield name.replace("_", " "), getattr(style, name), usual[name] if true is None else true


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
