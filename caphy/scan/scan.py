"""One scan of a clothed person, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError

LABEL_NAMES: Final = ("body", "upper", "lower")
BODY, UPPER, LOWER = range(3)
"""What a vertex can be: bare body (skin, hair, shoes), upper garment, lower garment (CaPhy, section 3.1)."""

UNKNOWN: Final = 255
"""Label of a vertex of which nobody knows what it is."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A triangle mesh of one person in one pose, in metres with y up.

    Raises :class:`CaphyError`, naming the source, where shapes do not fit together or a value is not finite.
    """

    name: str
    vertices: np.ndarray
    """(V, 3) float64 [m]."""
    faces: np.ndarray
    """(F, 3) int32, counter-clockwise seen from outside."""
    colours: np.ndarray | None = None
    """sRGB colours (V, 3) uint8, or none."""
    labels: np.ndarray | None = None
    """(V,) uint8: :data:`BODY`, :data:`UPPER`, :data:`LOWER` or :data:`UNKNOWN`; or none."""
    pose: np.ndarray | None = None
    """Initial guess of the SMPL-X joint rotations (55, 3) [rad], or none."""
    transl: np.ndarray | None = None
    """Translation (3,) [m] that goes with ``pose``."""
    source: str = ""
    """The file it came from."""
    pelvis: np.ndarray | None = None
    """Where the initial pose has the pelvis joint (3,) [m]: unlike ``transl`` the same for any body."""

    def __post_init__(self) -> None:
        count = len(self.vertices)
        shapes = {"vertices": (count, 3), "faces": (len(self.faces), 3), "colours": (count, 3), "labels": (count,)}
        shapes |= {"pose": (JOINT_COUNT, 3), "transl": (3,), "pelvis": (3,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise self.error(f"{name} must have shape {shape}, got {value.shape}")
        if count == 0:
            raise self.error("a scan must have vertices, this one has none; leave the file out")
        bad = np.flatnonzero(~np.isfinite(self.vertices).all(axis=1))
        if len(bad):
            raise self.error(
                f"vertices must be finite; {len(bad)} of {count} are not, the first is number {bad[0]}. Remove them in "
                "a mesh editor, or export the scan again"
            )
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < count:
            raise self.error(f"faces must index {count} vertices, got {self.faces.min()} to {self.faces.max()}")
        for name in ("pose", "transl", "pelvis"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise self.error(f"the initial {name} must be finite; leave the poses out if they are not known")

    def error(self, message: str) -> CaphyError:
        """An error that names this scan."""
        return CaphyError(f"{self.source or self.name}: {message}")

    @cached_property
    def normals(self) -> np.ndarray:
        """Area-weighted unit vertex normals (V, 3); zero at vertices without a face."""
        from caphy.report.render import vertex_normals

        return vertex_normals(self.vertices, self.faces)

    def points(self, label: int) -> np.ndarray:
        """The vertices (N, 3) [m] of one label; raises where the scan has no labels."""
        if self.labels is None:
            raise self.error("has no labels yet; make them with 'caphy segment'")
        return self.vertices[self.labels == label]

    def with_labels(self, labels: np.ndarray) -> Scan:
        """The same scan with labels (V,)."""
        return replace(self, labels=np.asarray(labels, dtype=np.uint8))
