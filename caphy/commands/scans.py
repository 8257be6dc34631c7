"""``caphy scans``: check, picture and convert sets of scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.io.places import writable_file

Positional = tyro.conf.Positional


def main(arguments: list[str]) -> int | None:
    """Run ``caphy scans`` with the arguments after it."""
    return tyro.extras.subcommand_cli_from_dict(
        {"check": check, "render": render, "from-4d-dress": from_4d_dress}, prog="caphy scans", args=arguments
    )


def check(folder: Positional[Path]) -> int:
    """Say what is wrong with the scans of a folder, and what to do; status 1 if some cannot be used.

    Args:
        folder: folder with a scans.toml; see docs/scans.md.
    """
    from caphy.scan.checks import check_set, usable
    from caphy.scan.scan_set import ScanSet

    scans = ScanSet.read(folder)
    findings = check_set(scans, lambda done, total: print(f"\rread {done} of {total}", end="", flush=True))
    print()
    for finding in findings:
        print(f"{'refused' if finding.severe else 'note'}: {finding.scan}: {finding.message}")
    kept = usable(scans, findings)
    print(f"{len(kept)} of {len(scans)} scans can be used")
    return 0 if len(kept) == len(scans) else 1


def render(folder: Positional[Path], output: Annotated[Path, OUTPUT], count: int = 4) -> None:
    """Picture the first scans of a folder: three sides, and the labels where there are some.

    Args:
        folder: folder with a scans.toml.
        output: the PNG to write.
        count: how many scans to picture.
    """
    from caphy.report.render import contact_sheet, write_png
    from caphy.scan.pictures import scan_pictures
    from caphy.scan.scan_set import ScanSet

    if count < 1:
        raise CaphyError(f"--count must be at least 1, got {count}")
    writable_file(output, ".png")
    scans = ScanSet.read(folder)
    shown = [scans[i] for i in range(min(count, len(scans)))]
    images = [image for scan in shown for image in scan_pictures(scan)]
    print(write_png(contact_sheet(images, 4, [scan.name for scan in shown for _ in range(4)]), output))


def from_4d_dress(take: Positional[Path], output: Annotated[Path, OUTPUT], every: int = 1) -> None:
    """Convert a take of the 4D-DRESS data set, offline; its pickles may hold nothing but arrays.

    Args:
        take: the folder that holds Meshes_pkl.
        output: folder to write the scans to.
        every: take every this many frames.
    """
    from caphy.scan.dress4d import convert_take

    if every < 1:
        raise CaphyError(f"--every must be at least 1, got {every}")
    scans = convert_take(take, output, every, say=print)
    print(f"{output}: {len(scans)} scans" + ("" if scans.poses is not None else ", without poses"))
