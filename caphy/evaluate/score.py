"""One prediction held against one scan: distances and the difference of pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caphy.errors import CaphyError
from caphy.evaluate.chamfer import ScanCloth
from caphy.evaluate.dressed import Dressed
from caphy.evaluate.perceptual import Perceptual
from caphy.evaluate.views import cameras, dressed_view, scan_view, somebody
from caphy.register.points import ScanPoints
from caphy.scan.scan import Scan

ALL = "clothes"
"""Name of all garments together."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A scan that nothing was trained on, and how the body stands in it."""

    scan: Scan
    points: ScanPoints
    kinds: tuple[str, ...]
    """The subject's garments."""

    @cached_property
    def unshown(self) -> dict[str, str]:
        """The garments that it does not show, and why it cannot be held against them."""
        found = {}
        for kind in self.kinds:
            try:
                ScanCloth.of(self.scan, (kind,))
            except CaphyError as error:
                found[kind] = str(error)
        return found

    @property
    def shown(self) -> tuple[str, ...]:
        """The garments that it shows; raises CaphyError where these are none."""
        shown = tuple(kind for kind in self.kinds if kind not in self.unshown)
        if not shown:
            raise CaphyError(next(iter(self.unshown.values())))
        return shown

    @cached_property
    def cloths(self) -> dict[str, tuple[tuple[str, ...], ScanCloth]]:
        """Name -> the garments meant, and the scan's surface of them: all that it shows together, and each."""
        groups = {ALL: self.shown} | ({kind: (kind,) for kind in self.shown} if len(self.kinds) > 1 else {})
        return {name: (kinds, ScanCloth.of(self.scan, kinds)) for name, kinds in groups.items()}

    @cached_property
    def pictures(self) -> list[np.ndarray]:
        """The scan from four sides."""
        return [scan_view(self.scan, camera) for camera in cameras(self.scan)]

    def score(self, dressed: Dressed, look: Perceptual | None) -> dict[str, float]:
        """Figures of the garments shown in a prediction, names with units; ``perceptual`` is in those of ``look``."""
        figures: dict[str, float] = {}
        for name, (kinds, cloth) in self.cloths.items():
            found = cloth.chamfer(dressed, kinds)
            figures[f"{name}_chamfer_mm"] = 1e3 * found.root
            if name == ALL:
                figures |= {"mean_mm": 1e3 * found.mean, "pop_1e-4_m2": 1e4 * found.pop}
                figures |= {"to_scan_mm": 1e3 * found.to_scan, "from_scan_mm": 1e3 * found.from_scan}
        if look is not None:
            figures["perceptual"] = float(np.mean([error for _, error, _ in self.looks(dressed, look)]))
        return figures

    def looks(self, dressed: Dressed, look: Perceptual) -> list[tuple[np.ndarray, float, np.ndarray]]:
        """From each side: the prediction's picture, its mean error where either shows somebody, and the error map."""
        found = []
        for picture, camera in zip(self.pictures, cameras(self.scan), strict=True):
            test = dressed_view(dressed, camera)
            error = look.error_map(picture, test)
            found.append((test, float(error[somebody(picture, test)].mean()), error))
        return found

    def distances(self, dressed: Dressed) -> list[np.ndarray]:
        """Distance (V,) [m] of the vertices of each garment from the scan's clothes."""
        cloth = self.cloths[ALL][1]
        meshes = dressed.garments.values()
        return [np.abs(cloth.surface.nearest(vertices, cloth.points).distance) for vertices, _ in meshes]
