"""``caphy simulate GARMENT POSES -o out.npz``: the reference solver's motion of a garment on a moving body."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from caphy.commands.output import OUTPUT
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.bundled import bundled
from caphy.io.places import writable_file
from caphy.kept import Kept

if TYPE_CHECKING:
    from caphy.effects.potential import Potential
    from caphy.solve.body_motion import BodyMotion
    from caphy.solve.integrators import State
    from caphy.solve.newton import Report


@dataclass(frozen=True)
class Simulate:
    """Move a garment with the reference solver: converged physics, for truth and for comparison with a network."""

    garment: Annotated[Path, tyro.conf.Positional]
    """A garment npz, or "tshirt" or "trousers" for the bundled ones."""
    poses: Annotated[Path, tyro.conf.Positional]
    """A pose file that 'caphy poses info' can read."""
    output: Annotated[Path, OUTPUT] = Path("trajectory.npz")
    """The npz to write: positions and velocities of every frame."""
    body: str = "medium"
    """The body the garment was made on: an SMPL-X-format npz, or "medium" for the bundled one."""
    betas: tuple[float, ...] = ()
    """Body shape that the garment was made on; the poses' own are not used."""
    fabric: str | None = None
    """A measured fabric, as listed by 'caphy effects list --fabrics'. Without it: SNUG's cotton."""
    model: Path | None = None
    """A physics model as JSON, instead of a fabric."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own that the model uses."""
    integrator: Literal["sdirk2", "implicit-euler"] = "sdirk2"
    """sdirk2 is second order; implicit-euler is what networks are trained with, and damps."""
    substeps: int = 1
    """Time steps per frame."""
    fps: float = 30.0
    """Frames per second to simulate at."""
    seconds: float | None = None
    """How much of the motion to simulate; all of it unless given."""
    render: Path | None = None
    """A contact sheet (PNG) to write as well."""


def main(arguments: list[str]) -> None:
    """Run ``caphy simulate`` with the arguments after it."""
    command = tyro.cli(Simulate, args=arguments, prog="caphy simulate")
    if command.substeps < 1:
        raise CaphyError(f"--substeps must be at least 1, got {command.substeps}")
    if command.seconds is not None and not 0 < command.seconds < float("inf"):
        raise CaphyError(f"--seconds must be positive and finite, got {command.seconds:g}")
    read = [command.garment, command.poses, command.body, *command.effect_file]
    read += [] if command.model is None else [command.model]
    for path, suffix in ((command.output, ".npz"), (command.render, ".png")):
        if path is not None:
            writable_file(path, suffix, read)
    if command.fabric is not None and command.model is not None:
        raise CaphyError("--fabric and --model exclude each other; give one of them")
    with unfinished(command.output.with_suffix(f".{UNFINISHED}")) as kept:
        _simulate(command, kept)


def _simulate(command: Simulate, folder: Path) -> None:
    from tqdm import tqdm

    from caphy.commands.body import load_body, tell_other_body
    from caphy.effects.cloth import Cloth
    from caphy.effects.mass import require_mass
    from caphy.effects.potential import Potential
    from caphy.garment.template import Garment
    from caphy.io.poses import read_poses
    from caphy.io.poses.sequence import RATES
    from caphy.solve.body_motion import BodyMotion
    from caphy.solve.integrators import find_integrator
    from caphy.solve.rollout import simulate

    garment, model, body = Garment.load(bundled(command.garment)), _model(command), load_body(command.body)
    kept = Kept(folder, command.effect_file)  # of effects that are registered by now
    if not RATES[0] <= command.fps <= RATES[1]:
        raise CaphyError(f"--fps must lie between {RATES[0]:g} and {RATES[1]:g}, got {command.fps:g}")
    poses = read_poses(command.poses).require_world().resample(command.fps)
    if command.seconds is not None:
        poses = poses[: round(command.seconds * command.fps) + 1]
    betas = np.array(command.betas) if command.betas else None
    motion = BodyMotion(body, poses, garment, betas)
    tell_other_body(garment, body.rest(betas)[1])
    potential = Potential(model, Cloth.of(garment, model.density))
    print(f"{garment.name}: {len(garment.vertices)} vertices, {len(poses)} frames at {poses.fps:g} fps; dressing ...")
    require_mass(potential)
    start, begun = _dressed(potential, motion, kept)
    with tqdm(total=len(poses), unit="frame") as bar:
        trajectory = simulate(
            potential,
            motion,
            start,
            integrator=find_integrator(command.integrator),
            substeps=command.substeps,
            progress=lambda done, total: _show(bar, done),
            kept=kept,
        )
    trajectory = replace(trajectory, reports=(begun, *trajectory.reports[1:]))
    trajectory.save(command.output)
    _report(command, trajectory, motion)
    if command.render is not None:
        print(_sheet(command.render, trajectory, motion))
    else:
        print("pictures come with --render sheet.png")


def _dressed(potential: Potential, motion: BodyMotion, kept: Kept) -> tuple[State, tuple[Report, ...]]:
    """Where the motion starts, and how the last step there ended; said where the solver did not converge on the way."""
    import torch

    from caphy.solve.integrators import State
    from caphy.solve.newton import Newton, Report
    from caphy.solve.preroll import dressed

    key = kept.key("dressed", potential.model, potential.cloth, motion.body, motion.betas, motion.garment, motion.poses)
    if (found := kept.recall(key)) is None:
        state, reports = dressed(Newton(potential), motion)
        found = {
            "x": state.x.numpy(),
            "v": state.v.numpy(),
            **{f"last_{each.name}": np.array([getattr(r, each.name) for r in reports[-1]]) for each in fields(Report)},
            "converged": np.array([all(report.converged for report in frame) for frame in reports]),
            "residual": np.array([max(report.residual for report in frame) for frame in reports]),
        }
        kept.keep(key, found)
    if not found["converged"].all():
        failed = int((~found["converged"]).sum())
        print(
            f"dressing: {failed} of {len(found['converged'])} frames on the way to the start did not converge; largest "
            f"force left {found['residual'].max():.1e} N. What the first frames show may come from there"
        )
    told = zip(*(found[f"last_{each.name}"].tolist() for each in fields(Report)), strict=True)
    return State(0.0, torch.from_numpy(found["x"]), torch.from_numpy(found["v"])), tuple(Report(*one) for one in told)


def _show(bar, done: int) -> None:
    bar.update(done - bar.n)


def _model(command: Simulate):
    from caphy.effects.model import Model
    from caphy.effects.own import use_file
    from caphy.effects.presets import fabric_model, snug_model

    own = [name for file in command.effect_file for name in use_file(file)]
    if command.model is not None:
        model = Model.load(command.model)
    else:
        model = snug_model() if command.fabric is None else fabric_model(command.fabric)
    if own and not set(own) & set(model.effects):
        raise CaphyError(
            f"{' and '.join(map(str, command.effect_file))}: the model has no {' or '.join(own)}, so it would not act; "
            "give a model that has it with --model"
        )
    return model


def _report(command: Simulate, trajectory, motion) -> None:
    """Print how the solver fared and how deep cloth lies in the body."""
    distances = np.stack(
        [motion.nearest(time, x).distance for time, x in zip(motion.times, trajectory.positions, strict=True)]
    )
    frames = trajectory.converged
    print(f"{command.output}: {len(trajectory)} frames, {command.output.stat().st_size / 1e6:.1f} MB")
    print(
        f"converged: {frames.sum()} of {len(frames)} frames; largest force left {trajectory.residual.max():.1e} N; "
        f"{np.median(trajectory.iterations[1:] if len(frames) > 1 else [0]):.0f} Newton iterations per frame"
    )
    if not frames.all():
        worst = int(trajectory.residual.argmax())
        print(f"the worst frame is {worst} ({trajectory.residual[worst]:.1e} N); more --substeps make it easier")
    print(f"deeper than 1 mm in the body: {100 * (distances < -1e-3).mean():.2f} % of vertices and frames")


def _sheet(path: Path, trajectory, motion) -> Path:
    from caphy.report.camera import Camera
    from caphy.report.render import CLOTH, Shape, contact_sheet, render, write_png

    images, labels = [], []
    for frame in np.linspace(0, len(trajectory) - 1, 8).round().astype(int):
        (skin,) = motion.vertices(motion.times[frame : frame + 1])
        cloth = trajectory.positions[frame]
        camera = Camera.framing(np.concatenate([skin, cloth]), azimuth=30.0)
        shapes = [Shape(skin, motion.body.faces), Shape(cloth, motion.garment.faces, CLOTH[0])]
        images.append(render(shapes, camera, (360, 360), shadows=True))
        labels.append(f"{motion.times[frame]:.2f} s")
    return write_png(contact_sheet(images, 4, labels), path)
