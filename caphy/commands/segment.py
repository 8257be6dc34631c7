"""``caphy segment SCANS``: which vertices are skin, upper and lower garment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from caphy.commands.following import following
from caphy.commands.made_labels import MadeLabels
from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder

if TYPE_CHECKING:
    from caphy.scan.scan import Scan
    from caphy.scan.scan_set import ScanSet

LEARNED_FROM = 10
"""Scans that the colour model is learned from, spread over the set."""


@dataclass(frozen=True)
class Segment:
    """Label the vertices of scans as body, upper or lower garment.

    Resumes: labels that it made of the same scan by the same parser are kept, and those that it did not make, or that
    were edited since, are left alone."""

    scans: Annotated[Path, tyro.conf.Positional]
    """Folder with a scans.toml."""
    output: Annotated[Path | None, OUTPUT] = None
    """Folder for the labels, one NAME.npy per scan; SCANS/labels unless given, where they are found by themselves."""
    parser: str = "colour"
    """colour: a colour model learned from the set; labels: what comes with the scans, smoothed; else an ONNX file."""
    layout: str = "schp-atr"
    """What the ONNX file's classes are: schp-lip, schp-atr, segformer-clothes, sapiens, or a JSON file."""
    render: Path | None = None
    """A contact sheet (PNG) of the first scans and their labels."""


def main(arguments: list[str]) -> int:
    """Run ``caphy segment`` with the arguments after it."""
    command = tyro.cli(Segment, args=arguments, prog="caphy segment")
    failed = label(command)
    elsewhere = () if command.output is None else ("--labels", command.output)
    print(f"next: {following('register', 'body', command.scans, *elsewhere, '-o', 'run')}")
    return 1 if failed else 0


def label(command: Segment) -> dict[str, str]:
    """Label scans; the names of those that could not be, and why.

    Raises:
        CaphyError: none could, labels would be read and written in one place, or the picture's name is no PNG's.
    """
    from caphy.scan.scan_set import ScanSet

    if command.render is not None:
        writable_file(command.render, ".png")
    scans = ScanSet.read(command.scans)
    out = command.output or command.scans / "labels"
    by_itself = out.resolve() == (scans.labels or command.scans / "labels").resolve()
    _require_apart(command, scans, out, by_itself)
    writable_folder(out)
    method, learnt = _method(command, scans)
    made = MadeLabels(out, command.parser, command.layout, learnt)
    failed = _segment_all(scans, made, method, command.parser == "labels")
    done = len(scans) - len(failed)
    print(f"{out}: labels of {done} of {len(scans)} scans")
    if command.render is not None and done:
        print(_sheet(command.render, ScanSet.read(command.scans, out), set(failed)))
    if not done:
        raise CaphyError(f"{command.scans}: no scan could be segmented; see the messages above")
    return failed


def _require_apart(command: Segment, scans: ScanSet, out: Path, by_itself: bool) -> None:
    """Raise CaphyError where labels would be read and written in one place, or be given another meaning there."""
    if command.parser == "labels" and scans.labels is not None and scans.labels.resolve() == out.resolve():
        raise CaphyError(f"{out}: holds the labels to work on; give another folder to write into with -o")
    if by_itself and scans.label_numbers is not None:
        raise CaphyError(
            f"{out}: the label_numbers of scans.toml would be applied to what is written there; give another folder "
            "with -o, and the same one with --labels to what reads it"
        )


def _segment_all(
    scans: ScanSet, made: MadeLabels, method: Callable[[Scan], np.ndarray], of_labels: bool
) -> dict[str, str]:
    """Label every scan whose labels are not made of it by this method yet; the names of those that failed, and why.

    of_labels: whether the method works on the scans' own labels. If not they are not read, for they may be those of
    another mesh that a scan was before.
    """
    from caphy.scan.checks import require_size
    from caphy.scan.scan import LOWER, UPPER

    scans = scans if of_labels else scans.without_labels()
    failed: dict[str, str] = {}
    foreign: list[str] = []
    started, fresh = monotonic(), 0
    for index, name in enumerate(scans.names):
        try:
            if made.foreign(name):
                foreign.append(name)
                continue
            scan = scans[index]
            if made.up_to_date(scan):
                continue
            require_size(scan)
            labels = method(scan)
            made.write(scan, labels)
            if not np.isin(labels, (UPPER, LOWER)).any():
                print(f"note: {name}: no clothes were found in it", flush=True)
        except CaphyError as error:
            made.remove(name)  # of another parser or another scan: nobody may use them beside the others
            print(f"left out {name}: {error}", flush=True)
            failed[name] = str(error)
            continue
        fresh += 1
        left = (monotonic() - started) / fresh * (len(scans) - index - 1)
        print(f"{name}: {index + 1} of {len(scans)}; about {left / 60:.1f} min left", flush=True)
    if foreign:
        print(
            f"{made.folder}: labels of {len(foreign)} scans were kept, for 'caphy segment' did not make them, or they "
            f"were edited since ({', '.join(foreign)}); remove them to have them made"
        )
    return failed


def _method(command: Segment, scans: ScanSet) -> tuple[Callable[[Scan], np.ndarray], np.ndarray | None]:
    """What labels a scan's vertices (V,), and what it learnt of the set for that, if anything."""
    from caphy.scan.segmentation import given_labels, segment, smoothed_labels

    if command.parser == "labels":
        return given_labels, None
    if command.parser == "colour":
        from caphy.scan.colour_model import ColourModel

        print("learning the subject's colours ...", flush=True)
        model = ColourModel.fit(_some(scans.without_labels()))
        return lambda scan: smoothed_labels(scan, model.votes(scan)), model.likelihood
    from caphy.scan.label_layouts import find_layout
    from caphy.scan.parsers import OnnxParser

    parser = OnnxParser(Path(command.parser), find_layout(command.layout))
    return lambda scan: segment(scan, parser), None


def _some(scans: ScanSet) -> list[Scan]:
    """Scans to learn from; those that cannot be read are told of later."""
    found, problem = [], None
    for index in np.unique(np.linspace(0, len(scans) - 1, LEARNED_FROM).round().astype(int)):
        try:
            scan = scans[int(index)]
            if scan.colours is not None and np.ptp(scan.colours, axis=0).any():
                found.append(scan)
        except CaphyError as error:
            problem = error
    if not found:
        raise problem or CaphyError(
            f"{scans.folder}: the scans have no colours to learn from; use --parser labels, or an ONNX human parser"
        )
    return found


def _sheet(path: Path, scans: ScanSet, failed: set[str], count: int = 4) -> Path:
    from caphy.report.render import contact_sheet, write_png
    from caphy.scan.pictures import scan_pictures

    shown = [i for i, name in enumerate(scans.names) if name not in failed][:count]
    images = [image for i in shown for image in scan_pictures(scans[i])]
    return write_png(contact_sheet(images, 4, [scans.names[i] for i in shown for _ in range(4)]), path)
