"""PC2 point caches: the vertices of a mesh over time, for Blender's Mesh Cache modifier, 3ds Max and Houdini.

Layout, little-endian: "POINTCACHE2\\0", version 1 (int32), points (int32), first frame (float32), frames per sample
(float32), samples (int32), then float32 x y z per point and sample. Metres, y up.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes
from export.motion import DressedMotion
from export.obj import obj_bytes

HEADER = struct.Struct("<12siiffi")


def pc2_bytes(vertices: np.ndarray) -> bytes:
    """The point cache of vertices (T, V, 3) [m]; its frame 0 is the first."""
    frames, count, _ = vertices.shape
    header = HEADER.pack(b"POINTCACHE2\0", 1, count, 0.0, 1.0, frames)
    return header + np.ascontiguousarray(vertices, "<f4").tobytes()


def write_pc2(motion: DressedMotion, folder: Path) -> list[Path]:
    """Per mesh ``NAME.obj``, its first frame, and ``NAME.pc2``, the cache to put on it; returns them.

    Raises :class:`CaphyError` where it would replace a ``NAME.obj`` that has no cache.
    """
    for name, *_ in motion.meshes():
        if (folder / f"{name}.obj").exists() and not (folder / f"{name}.pc2").exists():
            raise CaphyError(f"{folder / name}.obj: has no point cache, and would be replaced; give another folder")
    written = []
    for name, mesh, vertices in motion.meshes():
        written += [folder / f"{name}.obj", folder / f"{name}.pc2"]
        write_bytes(written[-2], obj_bytes(name, vertices[0], mesh.faces))
        write_bytes(written[-1], pc2_bytes(vertices))
    return written
