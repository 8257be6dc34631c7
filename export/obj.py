"""Wavefront OBJ: one file per mesh and frame, for programs that read nothing else.

Format: Wavefront, "Appendix B1. Object Files (.obj)", Advanced Visualizer Manual. Metres, y up.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes
from export.motion import DressedMotion


def obj_bytes(name: str, vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """One mesh: vertices (V, 3) [m] to a micrometre, faces (F, 3)."""
    points = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    corners = [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return "\n".join([f"o {name}", *points, *corners, ""]).encode("ascii")


def write_obj_sequence(motion: DressedMotion, folder: Path) -> list[Path]:
    """``body_0000.obj`` and so on, one file per mesh and frame; returns them.

    Where that is stopped, frames that were not there before are removed again: some are no motion. Raises
    :class:`CaphyError` where the folder would hold frames of another motion as well.
    """
    digits = max(4, len(str(len(motion) - 1)))
    frames = {f"{name}_{frame:0{digits}}.obj" for name, *_ in motion.meshes() for frame in range(len(motion))}
    there = sorted(file.name for file in folder.glob("*_*.obj")) if folder.is_dir() else []
    others = [file for file in there if re.fullmatch(r".+_\d{4,}\.obj", file) and file not in frames]
    if others:
        raise CaphyError(f"{folder}: holds {len(others)} frames of another motion ({others[0]}); give an empty folder")
    written: list[Path] = []
    try:
        for name, mesh, vertices in motion.meshes():
            for frame, points in enumerate(vertices):
                written.append(folder / f"{name}_{frame:0{digits}}.obj")
                write_bytes(written[-1], obj_bytes(name, points, mesh.faces))
    except BaseException:
        for path in written:
            if path.name not in there:
                path.unlink(missing_ok=True)
        raise
    return written
