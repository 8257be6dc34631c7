"""``caphy poses info|convert|condition|render``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder
from caphy.io.poses import PoseSequence, read_poses, write_poses
from caphy.io.poses.sequence import require_rate

LARGEST = 1e8
"""Pixels of a contact sheet, at most; a row of eight pictures has half a million unless said otherwise."""
Files = Annotated[tuple[Path, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class Source:
    """What pose files do not always say."""

    fps: float | None = None
    """True frame rate of the files [Hz], where they do not say."""
    up: Literal["y", "z"] | None = None
    """Up axis of the files, where they do not say."""
    person: int | None = None
    """Whom to take, where a file holds several."""

    def read(self, path: Path) -> PoseSequence:
        """The motion in ``path``."""
        return read_poses(path, fps=self.fps, up=self.up, person=self.person)


@dataclass(frozen=True)
class Info:
    """Say what pose files hold, what was assumed about them, and where they jump."""

    files: Files
    """Pose files of any format caphy reads."""
    source: tyro.conf.OmitArgPrefixes[Source]


@dataclass(frozen=True)
class Convert:
    """Write pose files in caphy's own pickle-free format."""

    files: Files
    """Pose files of any format caphy reads."""
    source: tyro.conf.OmitArgPrefixes[Source]
    output: Annotated[Path, OUTPUT] = Path(".")
    """Folder to write NAME.npz into."""
    resample: float | None = None
    """Frame rate to resample to [Hz]."""
    z_up: bool = False
    """Write with z up instead of y up."""


@dataclass(frozen=True)
class Condition:
    """Make estimated poses calm: smoothed, without jumps and gaps, on the ground (docs/conditioning.md)."""

    files: Files
    """Pose files of any format caphy reads, such as results of GVHMR, WHAM, 4D-Humans or TRAM."""
    source: tyro.conf.OmitArgPrefixes[Source]
    output: Annotated[Path, OUTPUT] = Path("conditioned")
    """Folder to write NAME.npz into, y up."""
    rate: float = 30.0
    """Frame rate to write [Hz]: the avatar's."""
    cutoff: float = 3.0
    """Motion faster than this is taken for noise [Hz]."""
    latency: float = 0.06
    """How far ahead the filter looks [s]; a stream would be this much later."""
    feet: bool = False
    """Let the feet carry the body, where the file's translation is not worth using."""
    floor: bool = True
    """Put the ground at y = 0 by the body's own soles."""
    estimate_scale: bool = False
    """Let the feet's steps tell the size of the file's translation."""


@dataclass(frozen=True)
class Render:
    """Picture motions on the bundled body as a contact sheet."""

    files: Files
    """Pose files of any format caphy reads."""
    source: tyro.conf.OmitArgPrefixes[Source]
    output: Annotated[Path, OUTPUT] = Path("poses.png")
    """The PNG to write, one row per file; times are counted from the row's first frame."""
    frames: int = 8
    """Frames per row, evenly spaced in time."""
    size: int = 240
    """Pixels of one frame."""
    azimuth: float = 35.0
    """Direction of the camera [degrees]: 0 looks at the front of a body facing +z, 90 at its left side."""


def main(arguments: list[str]) -> None:
    """Run ``caphy poses`` with the arguments after it."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[
            Annotated[Info, tyro.conf.subcommand("info")]
            | Annotated[Convert, tyro.conf.subcommand("convert")]
            | Annotated[Condition, tyro.conf.subcommand("condition")]
            | Annotated[Render, tyro.conf.subcommand("render")]
        ],
        args=arguments,
        prog="caphy poses",
    )
    if not command.files:
        raise CaphyError("name at least one pose file")
    {Info: _info, Convert: _convert, Condition: _condition, Render: _render}[type(command)](command)


def _info(command: Info) -> None:
    rows: list[tuple[str, ...]] = [
        ("file", "frames", "fps", "seconds", "frame", "model", "root m/s", "joint rad/s", "jumps")
    ]
    remarks: list[str] = []
    errors: list[CaphyError] = []
    for path in command.files:
        try:
            sequence = command.source.read(path)
        except CaphyError as error:
            errors.append(error)
            continue
        jumps = sequence.jumps()
        rows.append(_row(path, sequence, len(jumps)))
        remarks += [f"{path.name}: {note}" for note in sequence.notes]
        remarks += [f"{path.name}: {jump}" for jump in jumps[:3]]
        if len(jumps) > 3:
            remarks.append(f"{path.name}: and {len(jumps) - 3} more such jumps")
    if len(rows) > 1:
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for name, *cells in rows:
            print(name.ljust(widths[0]), *(c.rjust(w) for c, w in zip(cells, widths[1:], strict=True)), sep="  ")
    if remarks:
        print("", *remarks, sep="\n")
    if errors:  # after what can be said of the others
        raise CaphyError("\n".join(map(str, errors)))


def _row(path: Path, sequence: PoseSequence, jumps: int) -> tuple[str, ...]:
    """One line of the table; speeds are the median and the highest."""
    moving = len(sequence) > 1
    root, joint = sequence.linear_speed(), sequence.angular_speed().max(axis=1)
    speeds = [f"{np.median(s):.1f}, {s.max():.1f}" if moving else "-" for s in (root, joint)]
    frame = f"{sequence.frame}, {sequence.up_axis} up"
    counts = (str(len(sequence)), f"{sequence.fps:g}", f"{sequence.duration:.2f}")
    return path.name, *counts, frame, sequence.model, *speeds, str(jumps)


def _targets(command: Convert | Condition) -> list[tuple[Path, Path]]:
    """Each file, and where its new form goes."""
    targets = [command.output / f"{path.stem}.npz" for path in command.files]
    if len(set(targets)) != len(targets):
        raise CaphyError("two files have the same name; convert them into different folders with -o")
    writable_folder(command.output)
    for target in targets:
        writable_file(target, inputs=command.files)
    return list(zip(command.files, targets, strict=True))


def _condition(command: Condition) -> None:
    from caphy.conditioning import Conditioner, Conditioning, condition_sequence

    require_rate(command.rate, "--rate", "give the rate to write")
    for path, target in _targets(command):
        sequence = command.source.read(path)
        settings = Conditioning(
            fps=command.rate,
            latency=command.latency,
            cutoff=command.cutoff,
            frame=sequence.frame,
            translation="feet" if command.feet else "given",
            floor=command.floor,
            scale=None if command.estimate_scale else 1.0,
        )
        conditioner = Conditioner(settings)
        made = condition_sequence(sequence, conditioner)
        write_poses(made, target)
        print(f"{target}: {len(made)} frames at {made.fps:g} fps")
        for name, counts in (("frames", conditioner.summary.frames), ("not used", conditioner.summary.refused)):
            print(f"  {name}: {', '.join(f'{key} {count}' for key, count in sorted(counts.items())) or 'none'}")
        print(f"  world: {', '.join(f'{key} {value}' for key, value in conditioner.world().items())}")


def _convert(command: Convert) -> None:
    for path, target in _targets(command):
        sequence = command.source.read(path)
        sequence = sequence if command.resample is None else sequence.resample(command.resample)
        write_poses(sequence.to_z_up() if command.z_up else sequence, target)
        print(f"{target}: {len(sequence)} frames at {sequence.fps:g} fps")


def _render(command: Render) -> None:
    from caphy.report.render import contact_sheet, write_png

    if command.frames < 1 or command.size < 16:
        raise CaphyError(f"--frames must be at least 1 and --size 16, got {command.frames} and {command.size}")
    if not np.isfinite(command.azimuth):
        raise CaphyError(f"--azimuth must be finite [degrees], got {command.azimuth:g}")
    pixels = len(command.files) * command.frames * command.size**2
    if pixels > LARGEST:
        raise CaphyError(
            f"a sheet has at most {LARGEST:.0e} pixels, got {pixels:.1e}; ask for fewer --frames or a smaller --size"
        )
    writable_file(command.output, ".png", command.files)
    images, labels = [], []
    for path in command.files:
        sequence = command.source.read(path)
        at = np.linspace(0, len(sequence) - 1, command.frames).round().astype(int)
        images += [_picture(sequence, frame, command) for frame in at]
        labels += [path.stem[: command.size // 9], *(f"{frame / sequence.fps:.2f} s" for frame in at[1:])]
    print(write_png(contact_sheet(images, command.frames, labels), command.output))


def _picture(sequence: PoseSequence, frame: int, command: Render) -> np.ndarray:
    """One frame on the bundled body, the camera beside it at the height of the chest."""
    from caphy.body.bundled import default_body
    from caphy.io.poses.ground import placed_on
    from caphy.io.retarget_rest import rest_of
    from caphy.report.camera import Camera
    from caphy.report.render import Shape, render

    body = default_body("fine")
    rest = rest_of(body)
    placed = placed_on(sequence, rest.joints, rest.sole)
    (vertices,) = body.pose(placed.poses[frame : frame + 1], placed.transl[frame : frame + 1])
    middle = np.array([*placed.transl[frame, [0, 2]] + body.joints[0, [0, 2]], 1.0])[[0, 2, 1]]
    angle = np.radians(command.azimuth)
    camera = Camera(middle + 5.2 * np.array([np.sin(angle), 0.12, np.cos(angle)]), middle)
    size = (command.size, command.size)
    return render([Shape(vertices, body.faces)], camera, size, ground=0.0, shadows=True)
