"""A capture session on disk: scans in one folder, the truth in another; it goes on where it was stopped.

``scans/`` is what a pipeline may see: a mesh per still, misestimated initial poses, units and axes. ``truth/`` is for
judging it afterwards: poses, body, garments, fabrics, labels.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from caphy.body.bundled import default_body
from caphy.capture.drape import Dresser
from caphy.capture.fusion import Fused
from caphy.capture.optics import Optics
from caphy.capture.poses import capture_poses, misestimated
from caphy.capture.rig import LABELS, Rig
from caphy.capture.subject import Fabric, Lower, Subject, Upper, make_subject
from caphy.errors import CaphyError
from caphy.garment.families import FAMILIES
from caphy.garment.template import Garment, read_npz, write_npz
from caphy.io.places import writable_folder, write_bytes, write_text
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.poses.canonical import write_poses
from caphy.pipeline.stage import fingerprint


@dataclass(frozen=True)
class Plan:
    """What is captured; everything follows from it."""

    seed: int = 0
    count: int = 80
    """Number of scans."""
    upper: Upper | None = None
    """Family of the upper garment; drawn from the seed unless given."""
    lower: Lower | None = None
    clips: str | None = None
    """Folder of motion capture; procedural motions unless given."""
    body: str = "fine"
    """Bundled body under the clothes: "medium" or "fine"."""
    edge_length: float = 0.018
    """Target edge length of the simulated garments [m]."""
    simulate: bool = True
    """Drape with the reference solver; else garments just follow the skeleton."""
    pose_error: float = 20.0
    """How far each joint of the initial poses is off [degrees]."""
    optics: Optics = field(default_factory=Optics)


Progress = Callable[[int, int, float, dict[str, Any]], None]
"""Told the scans done, their total, the seconds the last one took, and how the solver fared."""


def capture(plan: Plan, folder: Path, progress: Progress | None = None) -> None:
    """Capture a session into ``folder``, or what is missing of it.

    Raises:
        CaphyError: the folder holds another session or files of somebody's, or none can follow from the plan.
    """
    _check(plan)
    scans, truth = folder / "scans", folder / "truth"
    begun = _claim(plan, folder, truth)
    try:
        subject = _subject(plan, truth)
        poses = _poses(plan, truth, subject)
    except CaphyError:
        if begun:  # another plan may follow the advice in the same folder, in which all is this one's
            for path in sorted(truth.iterdir(), key=lambda path: path.name == "plan.json"):  # which claims the rest
                path.unlink()
        raise
    scans.mkdir(parents=True, exist_ok=True)
    rig = Rig(subject, poses, plan.optics, plan.seed, Dresser(subject, poses, plan.simulate))
    for index in range(plan.count):
        mesh, still = scans / f"scan_{index:03d}.ply", truth / "stills" / f"scan_{index:03d}.npz"
        if mesh.is_file() and still.is_file():
            continue
        started = monotonic()
        body, cloth, report = rig.still(index)
        fused = rig.scan(index, body, cloth)
        write_ply(mesh, fused)
        arrays = {"body": body, **cloth, "labels": fused.labels}
        write_npz(
            still, {key: _small(value) for key, value in arrays.items()} | {"report": np.array(json.dumps(report))}
        )
        if progress is not None:
            progress(index + 1, plan.count, monotonic() - started, report)
    write_poses(misestimated(poses, plan.pose_error, plan.seed), scans / "poses.npz")
    write_text(
        scans / "scans.toml",
        f'name = "subject {plan.seed}"\nunit = "m"\nup_axis = "y"\nscans = "*.ply"\nposes = "poses.npz"\n',
    )


def _check(plan: Plan) -> None:
    """Raises :class:`CaphyError`, before anything is written, where no session follows from a plan."""
    optics = plan.optics
    if plan.count < 1:
        raise CaphyError(f"a session needs at least one scan, got {plan.count}")
    if plan.seed < 0:
        raise CaphyError(f"a seed must not be negative, got {plan.seed}")
    if not 0 < plan.edge_length < float("inf"):
        raise CaphyError(f"edge_length must be positive and finite [m], got {plan.edge_length}")
    for name, size, low, high in (("voxel", optics.voxel, 0.002, 0.05), ("noise", optics.noise, 0, 0.05)):
        if not low <= size <= high:  # else there is no surface, or no memory for it
            raise CaphyError(f"{name} must lie in [{low}, {high}] m, got {size}")
    for name, size in (("pose_error", plan.pose_error), ("dropouts", optics.dropouts)):
        if not 0 <= size < float("inf"):
            raise CaphyError(f"{name} must be finite and not negative, got {size}")
    if not 1 <= min(optics.pixels) <= max(optics.pixels) <= 4096:
        raise CaphyError(f"a picture's width and height must lie in [1, 4096] pixels, got {optics.pixels}")


def write_ply(path: Path, scan: Fused) -> None:
    """A binary PLY with colours, whole or not at all."""
    import trimesh

    mesh: Any = trimesh.Trimesh(scan.vertices, scan.faces, vertex_colors=scan.colours, process=False)
    write_bytes(path, mesh.export(file_type="ply"))


def _small(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32) if values.dtype == np.float64 else values


_CONTENT = "content_of_the_clips"
"""Beside the folder that they were in, which may have been moved."""


def _claim(plan: Plan, folder: Path, truth: Path) -> bool:
    """Write the plan down, or make sure that the folder's is the same; whether it was new."""
    path, told = truth / "plan.json", asdict(plan)
    told[_CONTENT] = None if plan.clips is None else fingerprint(Path(plan.clips))
    if not path.is_file():
        for place in (folder / "scans", truth):
            _require_empty(place)
        write_text(path, json.dumps(told, indent=1))
        return True
    before = _read(path)
    if before.get(_CONTENT) is not None:  # else it was begun before that was written down, or has no clips
        before["clips"] = plan.clips
    if {_CONTENT: told[_CONTENT], **before} != json.loads(json.dumps(told)):
        raise CaphyError(f"{folder}: holds another session ({path}); choose another folder, or delete this one")
    return False


def _require_empty(folder: Path) -> None:
    """Raises :class:`CaphyError` where something lies in a folder of which no plan tells that caphy wrote it."""
    for path in sorted(writable_folder(folder).glob("*")):
        if not path.name.startswith("."):  # else a kill amid the plan left it, or the system's own
            raise CaphyError(
                f"{folder}: a session would be written there, and it holds {path.name!r} of no session; move it, or "
                "choose another folder"
            )


def _read(path: Path, *keys: str) -> dict[str, Any]:
    """The JSON that a session was made with, which must be an object with some keys."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(told, dict) or not set(keys) <= set(told):
            raise ValueError(" and ".join(("an object is needed", *(f"{key!r} in it" for key in keys))))
    except (OSError, ValueError) as error:
        raise _damaged(path, error) from error
    return told


def _damaged(path: Path, error: Exception) -> CaphyError:
    return CaphyError(f"{path}: cannot be read ({error}); delete the session and capture it again")


def _subject(plan: Plan, truth: Path) -> Subject:
    """The subject, as made before if it was."""
    if plan.body not in ("medium", "fine"):
        raise CaphyError(f"the body must be medium or fine, got {plan.body!r}")
    path = truth / "subject.json"
    if not path.is_file():
        subject = make_subject(default_body(plan.body), plan.seed, plan.upper, plan.lower, plan.edge_length)
        _write_subject(subject, truth)
        write_text(path, json.dumps(_told(subject), indent=1))
    return read_subject(truth)


def _told(subject: Subject) -> dict[str, Any]:
    return {
        "garments": {
            label: {
                "family": family.family,
                "options": asdict(family),
                "fabric": asdict(subject.fabrics[label]),
                "model": json.loads(subject.fabrics[label].model.to_json()),
            }
            for label, family in subject.families.items()
        },
        "labels": LABELS,
    }


def _write_subject(subject: Subject, truth: Path) -> None:
    write_npz(
        truth / "body.npz",
        {
            "v_template": subject.body.v_template,
            "joints": subject.body.joints,
            "faces": subject.body.faces,
            "betas": subject.betas,
            "displacement": subject.displacement,
        },
    )
    for label, garment in subject.garments.items():
        garment.save(truth / f"{label}.npz")
        subject.rough[label].save(truth / f"{label}_rough.npz")


def read_subject(truth: Path) -> Subject:
    """The subject of a session's ``truth`` folder; raises :class:`CaphyError` where it is damaged."""
    from caphy.capture.subject import frozen

    plan, path = _read(truth / "plan.json", "body"), truth / "subject.json"
    told = _read(path, "garments")["garments"]
    try:
        fabrics = {label: Fabric(**given["fabric"]) for label, given in told.items()}
        families = {label: FAMILIES[given["family"]](**given["options"]) for label, given in told.items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise _damaged(path, error) from error
    arrays = read_npz(truth / "body.npz")
    return Subject(
        body=frozen(default_body(plan["body"]), arrays["v_template"], arrays["joints"]),
        betas=arrays["betas"],
        displacement=arrays["displacement"],
        garments={label: Garment.load(truth / f"{label}.npz") for label in told},
        rough={label: Garment.load(truth / f"{label}_rough.npz") for label in told},
        fabrics=fabrics,
        families=families,
    )


def _poses(plan: Plan, truth: Path, subject: Subject) -> PoseSequence:
    path = truth / "poses.npz"
    if not path.is_file():
        clips = None if plan.clips is None else Path(plan.clips)
        write_poses(capture_poses(clips, plan.count, subject.body, plan.seed), path)
    return read_poses(path)
