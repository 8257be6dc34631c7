"""``caphy evaluate SCANS -o RUN``: how well dressed avatars match scans that nothing was trained on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError

if TYPE_CHECKING:
    from caphy.evaluate.dressed import Dressed
    from caphy.evaluate.perceptual import Perceptual
    from caphy.evaluate.rows import Row
    from caphy.evaluate.score import HeldOut

REPORT, PICTURES = "evaluation.json", "evaluation"


@dataclass(frozen=True)
class Evaluate:
    """Print the table of CaPhy's section 4 for a run: distances from held-out scans, and differences of pictures."""

    scans: tyro.conf.Positional[Path]
    """Folder of labelled scans with a scans.toml, the ones the run was registered from."""
    output: Annotated[Path, OUTPUT]
    """Folder that 'caphy register' filled; gets evaluation.json, evaluation.txt and evaluation/NAME.png."""
    row: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A row besides those the run holds, as NAME=FOLDER: an avatar, a folder with upper and lower, or one with seed_1
    ... of them; may be given several times."""
    labels: Path | None = None
    """Folder of labels (NAME.npy) to use instead of the scans' own."""
    vgg: Path | None = None
    """Weights of VGG-16 (torchvision's .pth, or safetensors) for the perceptual error instead of FLIP."""
    classes: Path | None = None
    """JSON object with the motion class of each held-out scan; by default the half nearer to the trained poses, and
    the rest."""
    pictures: int = 4
    """How many held-out scans to picture; 0 for none."""


def main(arguments: list[str]) -> None:
    """Run ``caphy evaluate`` with the arguments after it."""
    command = tyro.cli(Evaluate, args=arguments, prog="caphy evaluate")
    if command.pictures < 0:
        raise CaphyError(f"--pictures must not be negative, got {command.pictures}")

    from caphy.commands.register import Progress
    from caphy.evaluate.classes import read_classes
    from caphy.evaluate.evaluation import evaluate
    from caphy.evaluate.perceptual import Flip, Vgg16
    from caphy.evaluate.table import table_lines
    from caphy.io.places import write_text
    from caphy.register.points import read_split
    from caphy.scan.scan_set import ScanSet

    rows = _rows(command)
    look = Flip() if command.vgg is None else Vgg16(command.vgg)
    names = read_split(command.output)["held_out"]
    classes = None if command.classes is None else read_classes(command.classes, names)
    scans = ScanSet.read(command.scans, command.labels)
    show = _Pictured(command.output / PICTURES, command.pictures, look)
    with Progress() as progress:
        found = evaluate(command.output, scans, rows, look, classes, progress, show)
    _forget(command.output, show.written)
    document = found.document() | {"pictures": show.written}
    lines = table_lines(document)
    write_text(command.output / REPORT, json.dumps(document, indent=1, allow_nan=False))
    write_text(command.output / "evaluation.txt", "\n".join(lines) + "\n")
    print("\n".join(lines))
    print(command.output / REPORT)


def _forget(run: Path, kept: Sequence[str]) -> None:
    """Remove the pictures that an earlier evaluation of the run wrote, but for those ``kept``."""
    try:
        earlier = json.loads((run / REPORT).read_text())["pictures"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in set(map(str, earlier)) - set(kept):
        if Path(name).parent == Path(PICTURES):
            (run / name).unlink(missing_ok=True)


def _rows(command: Evaluate) -> list[Row]:
    """What the run holds, and what was given, which takes the place of rows of the same name."""
    from caphy.evaluate.rows import given_row, known_rows

    rows = [given_row(row) for row in command.row]
    given = {row.name: row for row in rows}
    if len(given) < len(rows):
        raise CaphyError(f"--row names each row once, got {', '.join(row.name for row in rows)}")
    known = known_rows(command.output)
    return [given.pop(row.name, row) for row in known] + list(given.values())


class _Pictured:
    """Writes the pictures of the first held-out scans."""

    def __init__(self, folder: Path, count: int, look: Perceptual) -> None:
        self.folder, self.count, self.look, self.written = folder, count, look, []

    def __call__(self, held: HeldOut, rows: Mapping[str, Dressed]) -> None:
        from caphy.evaluate.pictures import side_by_side
        from caphy.report.render import write_png

        if len(self.written) < self.count:
            path = write_png(side_by_side(held, rows, self.look), self.folder / f"{held.scan.name}.png")
            self.written.append(f"{self.folder.name}/{path.name}")
