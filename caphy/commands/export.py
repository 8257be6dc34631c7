"""``caphy export``: trained garments become an avatar bundle; a bundle becomes files for other programs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from caphy.commands.following import following
from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.io.bundle import MANIFEST, require_place
from caphy.io.bundled import bundled
from caphy.io.places import writable_file, writable_folder, write_bytes

if TYPE_CHECKING:
    from caphy.body.model import BodyModel
    from caphy.io.poses import PoseSequence
    from export.motion import DressedMotion
    from export.runs import Run


@dataclass(frozen=True)
class Export:
    """Write an avatar bundle: one ONNX graph per trained garment, checked against its network, and the body.

    Given an avatar bundle instead, write its garments' graphs anew: older ones may be slower than today's.
    With --format, write an avatar bundle that exists for other programs, dressed on a motion; as glb also without one.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders that 'caphy train' wrote, one per garment, innermost garment first; or one avatar bundle ("default" is
    the one that comes along)."""
    output: Annotated[Path, OUTPUT]
    """The bundle to write, a folder that is replaced whole if it holds one; with --format, a file ending in .glb,
    .usdc or .usda, or a folder for pc2 or obj."""
    format: Literal["bundle", "glb", "usd", "pc2", "obj"] = "bundle"
    """What to write. glb without --poses is the avatar itself, with the networks' blend shapes as morph targets."""
    poses: Path | None = None
    """With --format: the motion to write, in any format caphy reads. It is held whole: a minute takes 1.4 GB of
    memory."""
    within_mm: float = 0.2
    """With --format glb and no --poses: as few blend shapes as keep vertices so near those of all of them, in postures
    all over the joints' limits [mm]."""
    motions: tuple[Path, ...] = ()
    """Pose files to fit the head on and, every third, to state its error on; those held out of training by default."""
    body: str | None = None
    """Body to show, with the joints trained on: an SMPL-X-format npz, or "medium" or "fine" (the default) for the
    bundled body."""
    licence: str | None = None
    """Licence of the body and garments in words; needed with a body of your own."""


def main(arguments: list[str]) -> None:
    """Run ``caphy export`` with the arguments after it."""
    command = tyro.cli(Export, prog="caphy export", args=arguments)
    command = replace(command, runs=tuple(map(bundled, command.runs)))
    if command.format == "bundle" and command.poses is not None:
        raise CaphyError("--poses is a motion for other programs; say which with --format glb, usd, pc2 or obj")
    again = command.format == "bundle" and len(command.runs) == 1 and (command.runs[0] / MANIFEST).is_file()
    if again or command.format != "bundle":
        _refuse_of_trainings(command)
    morphs = command.format == "glb" and command.poses is None
    if not morphs and command.within_mm != Export.within_mm:
        raise CaphyError("--within-mm is for the avatar with its blend shapes: --format glb without --poses")
    if not 0 <= command.within_mm < np.inf:
        raise CaphyError(f"--within-mm must be finite and not negative, got {command.within_mm}")
    if command.format == "bundle":
        require_place(command.output)
    if again:
        _export_again(command)
    elif command.format == "bundle":
        _export_runs(command)
    else:
        _export_bundle(command)


def _refuse_of_trainings(command: Export) -> None:
    """Options that say what an avatar is made of say nothing of one that is made."""
    usual = {field.name: field.default for field in fields(Export)}
    for name in ("licence", "body", "motions"):
        if getattr(command, name) != usual[name]:
            raise CaphyError(f"--{name} belongs to the export of trainings into an avatar; this one is made already")


def _export_again(command: Export) -> None:
    from caphy.io.bundle import read_bundle, write_bundle
    from export.again import exported_again

    bundle, parities = exported_again(read_bundle(command.runs[0]))
    write_bundle(bundle, command.output)
    for name, parity in parities.items():
        print(f"{name}: {1e3 * parity.network:.4f} mm from the network in the graph before")
    print(f"{command.output}: the same avatar with graphs of this version of caphy")


def _export_bundle(command: Export) -> None:
    from caphy.io.bundle import read_bundle
    from caphy.report.avatar_glb import avatar_glb

    if len(command.runs) != 1:
        raise CaphyError(f"--format {command.format} takes one avatar bundle, got {len(command.runs)} folders")
    for form, endings in (("glb", (".glb",)), ("usd", (".usdc", ".usda", ".usd"))):
        if command.format == form and command.output.suffix.lower() not in endings:
            raise CaphyError(f"{command.output}: a {form.upper()} file's name must end in {' or '.join(endings)}")
    bundle = read_bundle(command.runs[0])
    if command.poses is None:
        if command.format != "glb":
            raise CaphyError(f"--format {command.format} writes a motion; give one with --poses FILE")
        content = avatar_glb(bundle, 1e-3 * command.within_mm)
        write_bytes(command.output, content)
        print(f"{command.output}: the avatar with its blend shapes, {len(content) / 1e6:.1f} MB")
        return
    from caphy.io.poses import read_poses
    from export.motion import dressed_motion

    (writable_file if command.format in ("glb", "usd") else writable_folder)(command.output)
    motion = dressed_motion(bundle, read_poses(command.poses))
    print(f"{command.output}: {_write_motion(command, motion)}, {len(motion)} frames at {bundle.fps:g} fps")


def _write_motion(command: Export, motion: DressedMotion) -> str:
    """Write the motion; returns what was written, in words."""
    if command.format == "glb":
        from export.glb import animated_glb

        made = animated_glb(motion.bundle, motion.poses, motion.transl, motion.vertices)
        write_bytes(command.output, made.content)
        return f"animated GLB, vertices within {1e3 * max(made.errors.values()):.2f} mm of the service's"
    if command.format == "usd":
        from export.usd import write_usd

        write_usd(motion, command.output)
        return "USD with time samples"
    if command.format == "pc2":
        from export.pc2 import write_pc2

        return f"{len(write_pc2(motion, command.output))} files, an OBJ and a PC2 point cache per mesh"
    from export.obj import write_obj_sequence

    return f"{len(write_obj_sequence(motion, command.output))} OBJ files"


def _export_runs(command: Export) -> None:
    import caphy
    from caphy.commands.body import is_bundled, load_body
    from caphy.io.bundle import write_bundle
    from export.avatar import BODY_LICENCE, avatar_bundle, bundled_garment
    from export.runs import read_run

    name = command.body or "fine"
    if command.licence is None and not is_bundled(name):
        raise CaphyError("a body of your own needs its licence in words: --licence TEXT")
    body = load_body(name)
    runs = [read_run(folder) for folder in command.runs]
    _require_one_body(runs, body)
    fitted, held_out = _motions(tuple(map(str, command.motions)) or _held_out(runs))
    garments = []
    for run in runs:
        garment, metrics = bundled_garment(run.garment, run.network, fitted, held_out)
        print(
            f"{garment.name}: {len(garment.mesh.vertices)} vertices, head of rank {metrics['head_rank']} "
            f"({metrics['head_worst_vertex_error_mm']:.3f} mm), {metrics['parity_with_torch_mm']:.4f} mm from torch"
        )
        garments.append((garment, {**metrics, "held_out": dict(run.metrics)}))
    provenance: dict[str, Any] = {
        "exported_by": f"caphy {caphy.__version__}",
        "head_fitted_on": [Path(motion.source).name for motion in fitted],
        "head_error_measured_on": [Path(motion.source).name for motion in held_out],
        "garments": {run.garment.name: dict(run.provenance) for run in runs},
    }
    bundle = avatar_bundle(
        command.output.resolve().name,
        body,
        garments,
        fps=runs[0].network.fps,
        betas=runs[0].betas,
        licence=command.licence or BODY_LICENCE,
        provenance=provenance,
    )
    write_bundle(bundle, command.output)
    size = sum(path.stat().st_size for path in command.output.iterdir())
    print(f"{command.output}: avatar of {len(garments)} garment{'s' * (len(garments) != 1)}, {size / 1e6:.1f} MB")
    print(f"next: {following('demo', '--avatar', command.output)}")


def _held_out(runs: list[Run]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for run in runs for name in run.held_out))


def _require_one_body(runs: list[Run], body: BodyModel) -> None:
    if not runs:
        raise CaphyError("give at least one folder that 'caphy train' wrote")
    joints = body.rest(runs[0].betas)[1]
    for run in runs:
        name = run.garment.name
        if run.network.fps != runs[0].network.fps:
            raise CaphyError(
                f"garments must run at one rate: {name} at {run.network.fps:g} fps, "
                f"{runs[0].garment.name} at {runs[0].network.fps:g}; train one of them again"
            )
        gap = float(np.abs(run.network.joints.numpy() - joints).max())
        if gap > 1e-4:
            raise CaphyError(
                f"garment {name} was trained on another body: joints differ by {1e3 * gap:.1f} mm; "
                "give that body with --body"
            )


def _motions(sources: tuple[str, ...]) -> tuple[list[PoseSequence], list[PoseSequence]]:
    """Motions to fit the head on, and others, every third of those given, to state its error on."""
    from caphy.io.poses.parts import part, read_part
    from caphy.io.procedural import procedural_motion

    if not sources:
        print("note: no motions held out of training are there; the head is fitted to motions made from seeds")
        made = [procedural_motion(seed, seconds=20.0) for seed in range(6)]
        return made[:4], made[4:]
    motions = [read_part(source) for source in sources]
    for motion in motions:
        if len(motion) < 2:
            raise CaphyError(f"{motion.source}: must have 2 frames or more to fit a head on; give a longer motion")
    if len(motions) == 1:
        middle, end = len(motions[0]) // 2, len(motions[0])
        motions = [part(motions[0], 0, middle), part(motions[0], middle, end)]
    held_out = motions[1::3]
    return [procedural_motion(seconds=20.0), *(motion for motion in motions if motion not in held_out)], held_out
