"""A garment's template: rest mesh on the body's T-pose, rest metric in the thread frame, attachment to the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from zipfile import is_zipfile

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.garment import topology
from caphy.io.places import new_file
from caphy.io.unpacked import require_unpackable

FORMAT = "caphy-garment-1"
REALS = ("vertices", "material", "weights", "layer_thickness", "attached")
"""The arrays of real numbers, float64 in memory."""
WHOLE = 1e-3
"""How far the weights of a vertex may be from one in sum; files hold single precision."""
MOST_REGIONS = 256
"""Bundles and pages number them in a byte."""


@dataclass(frozen=True)
class Garment:
    """One piece of clothing as the simulator, the network and the exporter see it. Arrays are numpy, SI units."""

    name: str
    vertices: np.ndarray
    """Rest positions (V, 3) [m] on the body in T-pose: y up, facing +z."""
    faces: np.ndarray
    """Triangles (F, 3) int32, wound counter-clockwise seen from outside."""
    material: np.ndarray
    """Rest shape of each triangle (F, 3, 2) [m] in its own thread frame: first column weft u, second warp v.
    Warp runs along the garment's length. Neighbours need not share a frame; the area is positive."""
    weights: np.ndarray
    """Skinning weights (V, 55), rows sum to one, at most four are not zero."""
    regions: np.ndarray
    """Name of the part each vertex (V,) belongs to, such as ``chest``, ``sleeve_left`` or ``hem``."""
    layer_thickness: np.ndarray
    """Distance (V,) [m] to keep from the body beyond the contact's own, to leave room for what is worn below."""
    attached: np.ndarray
    """Strength (V,) from 0 (free) to 1 (held where skinning puts it, as a waistband is)."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Where it came from: family and parameters, or file; the rest metric's origin."""
    joints: np.ndarray | None = None
    """Rest joints (55, 3) [m] of the body that it was made on; none if nobody knows."""

    def __post_init__(self) -> None:
        count, shapes = (
            len(self.vertices),
            {
                "vertices": (len(self.vertices), 3),
                "faces": (len(self.faces), 3),
                "material": (len(self.faces), 3, 2),
                "weights": (len(self.vertices), JOINT_COUNT),
                "regions": (len(self.vertices),),
                "layer_thickness": (len(self.vertices),),
                "attached": (len(self.vertices),),
            },
        )
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise CaphyError(
                    f"garment {self.name!r}: {name} must have shape {shape}, got {getattr(self, name).shape}"
                )
        if self.joints is not None and self.joints.shape != (JOINT_COUNT, 3):
            raise CaphyError(
                f"garment {self.name!r}: joints must have shape {(JOINT_COUNT, 3)}, got {self.joints.shape}"
            )
        for name in REALS:
            if not np.isfinite(getattr(self, name)).all():
                raise CaphyError(f"garment {self.name!r}: {name} must be finite, got NaN or infinity")
        if count == 0 or self.faces.min(initial=0) < 0 or self.faces.max(initial=-1) >= count:
            raise CaphyError(f"garment {self.name!r}: faces must index its {count} vertices")

    def apart(self, joints: np.ndarray) -> float:
        """How far at most rest joints (55, 3) lie from those that it was made on [m]; 0 where these are unknown."""
        return 0.0 if self.joints is None else float(np.linalg.norm(self.joints - joints, axis=1).max())

    @cached_property
    def boundary_loops(self) -> list[np.ndarray]:
        """Openings (neck, hems, cuffs, waist) as closed vertex loops, the longest first."""
        return topology.boundary_loops(self.faces)

    @cached_property
    def hinges(self) -> np.ndarray:
        """Interior edges with their wings (H, 4), see :func:`caphy.garment.topology.hinges`."""
        return topology.hinges(self.faces)

    @cached_property
    def rest_areas(self) -> np.ndarray:
        """Areas (F,) [m^2] of the rest metric."""
        return topology.face_areas(self.material)

    def masses(self, density: float) -> np.ndarray:
        """Lumped vertex masses (V,) [kg] for an area density [kg/m^2]."""
        return topology.vertex_masses(self.rest_areas, self.faces, len(self.vertices), density)

    def region(self, *prefixes: str) -> np.ndarray:
        """Indices of the vertices whose region starts with one of ``prefixes``."""
        return np.flatnonzero(np.any([np.char.startswith(self.regions, p) for p in prefixes], axis=0))

    def save(self, path: str | Path) -> None:
        """Write an npz without pickles, atomically. Reals are float32 (a tenth of a micrometre), indices int32."""
        arrays = {name: getattr(self, name).astype(np.float32) for name in REALS}
        arrays |= {
            "format": np.array(FORMAT),
            "name": np.array(self.name),
            "faces": self.faces.astype(np.int32),
            "regions": self.regions,
            "provenance": np.array([[str(k), str(v)] for k, v in self.provenance.items()], str).reshape(-1, 2),
        }
        if self.joints is not None:
            arrays["joints"] = self.joints.astype(np.float32)
        write_npz(Path(path), arrays)

    @classmethod
    def load(cls, path: str | Path) -> Garment:
        """Read what :meth:`save` wrote.

        Raises
            CaphyError: if the file is missing, is no garment npz, holds pickles, its arrays do not fit together, its
                mesh is no cloth's, or its weights do not sum to one.
        """
        arrays = read_npz(Path(path))
        missing = {"name", "faces", "regions", "provenance", *REALS} - arrays.keys()
        if str(arrays.get("format")) != FORMAT or missing:
            raise CaphyError(
                f"{path}: must be a garment npz of format {FORMAT!r}, got format {str(arrays.get('format'))!r}, "
                f"without {sorted(missing) or 'nothing else'}; write one with 'caphy garment make' or 'from-mesh'"
            )
        garment = cls(
            name=str(arrays["name"]),
            faces=arrays["faces"].astype(np.int32),
            regions=arrays["regions"],
            provenance={str(k): str(v) for k, v in arrays["provenance"]},
            joints=arrays["joints"].astype(np.float64) if "joints" in arrays else None,
            **{name: arrays[name].astype(np.float64) for name in REALS},
        )
        garment._require_sound(path)
        return garment

    def _require_sound(self, path: str | Path) -> None:
        """Raise CaphyError, naming the file, unless the mesh is a cloth's, its vertices are carried, and its parts have
        names."""
        made = "it was not written by caphy as it is; make it again with 'caphy garment make' or 'from-mesh'"
        if defects := topology.check_manifold(self.faces, len(self.vertices)):
            raise CaphyError(f"{path}: must be an oriented manifold with boundary, has {defects.describe()}; {made}")
        off = np.abs(self.weights.sum(axis=1) - 1)
        if off[wrong := int(off.argmax())] > WHOLE:
            raise CaphyError(
                f"{path}: weights must sum to 1 for each vertex, got {self.weights[wrong].sum():.3g} for vertex "
                f"{wrong}; {made}"
            )
        if self.regions.dtype.kind != "U" or len(np.unique(self.regions)) > MOST_REGIONS:
            raise CaphyError(
                f"{path}: regions must be up to {MOST_REGIONS} names, got {len(np.unique(self.regions))} of type "
                f"{self.regions.dtype}; {made}"
            )


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = True) -> None:
    """Write an npz, whole or not at all; its folder is made. Raises :class:`CaphyError` where that fails."""
    with new_file(path) as stream:
        (np.savez_compressed if compressed else np.savez)(stream, allow_pickle=False, **arrays)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz, refusing pickles.

    Raises
        CaphyError: if the file is missing or is no npz of plain arrays.
    """
    require_unpackable(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise CaphyError(f"{path}: there is no such file") from error
    except Exception as error:
        why = "it is no npz" if path.is_file() and not is_zipfile(path) else error  # numpy takes it for a pickle
        raise CaphyError(f"{path}: must be an npz of plain arrays, could not be read ({why})") from error
