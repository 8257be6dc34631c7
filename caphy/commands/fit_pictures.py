"""The pictures on the page of ``caphy fit``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from caphy.commands.fit_scans import LABELS, SCANS, read

if TYPE_CHECKING:
    from caphy.evaluate.dressed import Dressed, Subject
    from caphy.report.page.compose import Picture

SHOWN = 2
"""Scans that are pictured."""
SIZE = (240, 360)
MOMENTS = (20, 50, 80, 110)
"""Frames of a made motion that the avatar is pictured in."""


def all_pictures(run: Path) -> list[tuple[str, str, list[Picture]]]:
    """Heading, note and pictures of each part of the page."""
    from caphy.evaluate.dressed import Subject

    subject = Subject.read(run)
    parts = [
        ("Scans", "from three sides, and what is what on them", _scans(run)),
        ("Body", "scan by label, body with the scan's skin, body", _file(run / "body.png", "body under the clothes")),
        ("Templates and avatar", "at rest, and in a made motion it has not seen", [_avatar(run, subject)]),
        ("Held-out scans", "prediction, distance from the scan, and how different the pictures look", _held_out(run)),
    ]
    return [(heading, note, pictures) for heading, note, pictures in parts if pictures]


def _picture(image: np.ndarray, caption: str) -> Picture:
    import cv2

    from caphy.report.page.compose import Picture

    return Picture(cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes(), caption, 0)


def _file(path: Path, caption: str) -> list[Picture]:
    from caphy.report.page.compose import Picture

    return [Picture(path.read_bytes(), caption, 0)] if path.is_file() else []


def _scans(run: Path) -> list[Picture]:
    from caphy.report.render import contact_sheet
    from caphy.scan.pictures import scan_pictures
    from caphy.scan.scan_set import ScanSet

    scans, used = ScanSet.read(run / SCANS, run / LABELS), list(read(run, "body.json")["scans"])
    shown = [scans[scans.names.index(name)] for name in used[:: max(1, len(used) // SHOWN)][:SHOWN]]
    images = [image for scan in shown for image in scan_pictures(scan, SIZE)]
    labels = [scan.name for scan in shown for _ in range(4)]
    return [_picture(contact_sheet(images, 4, labels), ", ".join(scan.name for scan in shown))]


def _avatar(run: Path, subject: Subject) -> Picture:
    """Templates on the T-posed body, and what the networks make of moments of a motion."""
    from caphy.report.render import contact_sheet

    rest = subject.template().held(np.zeros((55, 3)), np.zeros(3))
    images, labels = [_view(rest, 0), _view(rest, 180)], ["templates", "templates"]
    for frame, dressed in zip(MOMENTS, _moments(run, subject), strict=True):
        images.append(_view(dressed, 25))
        labels.append(f"{frame / 30:.1f} s")
    return _picture(contact_sheet(images, len(images), labels), "templates, and the avatar moving")


def _moments(run: Path, subject: Subject) -> list[Dressed]:
    from caphy.evaluate.dressed import Dressed
    from caphy.io.procedural import procedural_motion

    avatar = subject.wearing(run / "avatar")
    motion = procedural_motion(7, 4.0, 30.0).to_y_up(subject.body.joints[0])
    poses, transl = motion.poses[: MOMENTS[-1] + 1], motion.transl[: MOMENTS[-1] + 1]
    moved = {kind: network.stream(poses, transl) for kind, network in avatar.networks.items()}
    bodies = subject.body.pose(poses[list(MOMENTS)], transl[list(MOMENTS)])
    return [
        Dressed(
            body, subject.body.faces, {k: (v[frame].astype(float), subject.garments[k].faces) for k, v in moved.items()}
        )
        for frame, body in zip(MOMENTS, bodies, strict=True)
    ]


def _view(dressed: Dressed, azimuth: float) -> np.ndarray:
    from caphy.evaluate.views import dressed_view
    from caphy.report.camera import Camera

    return dressed_view(dressed, Camera.framing(dressed.body, azimuth, aspect=SIZE[0] / SIZE[1], margin=1.1))


def _held_out(run: Path) -> Sequence[Picture]:
    paths = [run / name for name in read(run, "evaluation.json").get("pictures", [])]
    return [picture for path in paths for picture in _file(path, path.stem)]
