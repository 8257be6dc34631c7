"""The first stages of ``caphy fit``: which scans can be used, and what is what on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caphy.errors import CaphyError

if TYPE_CHECKING:
    from caphy.scan.checks import Finding
    from caphy.scan.scan import Scan
    from caphy.scan.scan_set import ScanSet

CHECKED, LABELLED = "check.json", "segment.json"
SCANS, LABELS = "scans", "labels"
KINDS = ("upper", "lower")
WORN = 0.5
"""Share of the scans that must show a garment for it to count as worn."""


def check_scans(folder: Path, run: Path, parser: str | None) -> None:
    """Write what can be used into ``RUN/scans``, in metres and y up, and what was found into ``check.json``.

    Raises:
        CaphyError: nothing can be used.
    """

    from caphy.io.places import write_text
    from caphy.scan.checks import check_set, usable
    from caphy.scan.scan_set import ScanSet

    scans = ScanSet.read(folder)
    if parser not in (None, "labels"):  # the set's own labels do not count, whatever is wrong with them
        scans = scans.without_labels()
    bare: set[str] = set()

    def note_labels(scan: Scan) -> None:
        if scan.labels is None:
            bare.add(scan.name)

    findings = check_set(scans, _every_tenth("read"), note_labels)
    refused, notes = _reasons(findings, True), _reasons(findings, False)
    notes = {scan: why for scan, why in notes.items() if scan not in refused}
    for what, reasons in (("left out", refused), ("note", notes)):
        for scan, why in reasons.items():
            print(f"{what}: {scans.files[scans.names.index(scan)].name}: {why}", flush=True)
    kept = usable(scans, findings)
    without = [scans.names[i] for i in kept if scans.names[i] in bare]
    if parser is None and 0 < len(without) < len(kept):
        why = (
            f"has no labels, so those of the {len(kept) - len(without)} others are not used; add its own, or give "
            "--parser labels to do without this scan"
        )
        print(f"note: {without[0]}: {why}", flush=True)
        notes.setdefault(without[0], why)
    parser = parser or ("colour" if without else "labels")
    _write_kept(scans, kept, run / SCANS, parser == "labels")
    document = {
        "source": scans.name,
        "scans": len(scans),
        "kept": [scans.names[i] for i in kept],
        "parser": parser,
        "left_out": refused,
        "notes": notes,
    }
    write_text(run / CHECKED, json.dumps(document, indent=1))
    print(f"{len(kept)} of {len(scans)} scans can be used")


def segment_scans(run: Path, parser: str | None, layout: str) -> None:
    """Write ``RUN/labels``, and into ``segment.json`` which garments are worn and which scans show no clothes.

    parser: as given to :func:`check_scans`, which kept labels only where they are to be believed.

    Raises:
        CaphyError: no scan could be segmented, or none shows clothes.
    """
    from caphy.commands import segment
    from caphy.io.places import write_text
    from caphy.scan.checks import check_scan
    from caphy.scan.scan_set import ScanSet

    labels = run / LABELS
    chosen = parser or ("colour" if ScanSet.read(run / SCANS)[0].labels is None else "labels")
    command = segment.Segment(run / SCANS, labels, chosen, layout)
    left_out = segment.label(command)
    shown: dict[str, int] = dict.fromkeys(KINDS, 0)
    scans = ScanSet.read(run / SCANS, labels)
    for scan in scans:
        if scan.labels is None:
            left_out.setdefault(scan.name, "has no labels; see the stage's log")
            continue
        severe = [finding.message for finding in check_scan(scan) if finding.severe]
        if severe:
            left_out[scan.name] = severe[0]
            (labels / f"{scan.name}.npy").unlink()  # nobody may use it
            print(f"left out: {scan.name}: {severe[0]}")
            continue
        for kind, share in cloth_shares(scan).items():
            shown[kind] += share > 0.01
    used = len(scans) - len(left_out)
    if not used:
        raise CaphyError("no scan shows clothes:\n" + "\n".join(f"  {n}: {why}" for n, why in left_out.items()))
    kinds = [kind for kind, count in shown.items() if count >= WORN * used]
    if not kinds:
        raise CaphyError(
            f"half of the {used} scans must show an upper or a lower garment, got {shown}; are they of one person in "
            "the same clothes? Look at the labels, or give another --parser"
        )
    document = {"used": used, "kinds": kinds, "shown": shown, "left_out": left_out}
    write_text(run / LABELLED, json.dumps(document, indent=1))
    print(f"{used} scans labelled; worn: {', '.join(kinds)}")


def cloth_shares(scan: Scan) -> dict[str, float]:
    """Share of a labelled scan's vertices that show each kind of garment."""
    from caphy.scan.scan import LABEL_NAMES

    assert scan.labels is not None
    return {kind: float((scan.labels == LABEL_NAMES.index(kind)).mean()) for kind in KINDS}


def read(run: Path, name: str) -> dict[str, Any]:
    """A stage's JSON; empty where that stage has not been."""
    path = run / name
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def left_out(run: Path) -> dict[str, str]:
    """Every scan that is not in the run's avatar, with the first reason that was found."""
    reasons: dict[str, str] = {}
    for name in (CHECKED, LABELLED, "body.json"):
        for scan, why in read(run, name).get("left_out", {}).items():
            reasons.setdefault(scan, why)
    return reasons


def _write_kept(scans: ScanSet, kept: Sequence[int], folder: Path, with_labels: bool) -> None:
    from dataclasses import replace

    from caphy.scan.scan_set import write_scan_set

    for stray in folder.glob("*.ply"):
        if stray.stem not in {scans.names[i] for i in kept}:
            stray.unlink()
    read = (scans[i] for i in kept)  # one at a time: a set may not fit into memory
    chosen = read if with_labels else (replace(scan, labels=None) for scan in read)
    poses = scans.poses
    if poses is not None:
        index = list(kept)
        poses = replace(
            poses, poses=poses.poses[index], transl=poses.transl[index], unseen=None, source="poses of the scans"
        )
    write_scan_set(folder, chosen, SCANS, poses)  # whatever it was called, later stages follow from the same


def _reasons(findings: Sequence[Finding], severe: bool) -> dict[str, str]:
    reasons: dict[str, str] = {}
    for finding in findings:
        if finding.severe == severe:
            reasons.setdefault(finding.scan, finding.message)
    return reasons


def _every_tenth(what: str):
    def say(done: int, total: int) -> None:
        if done % 10 == 0 or done == total:
            print(f"{what} {done} of {total}", flush=True)

    return say
