"""What lies nearest to what between cloth and a scan's points of it: by trees on the CPU, in groups on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from caphy.body.grouped import GroupedClouds, GroupedSurface
from caphy.body.surface import Surface
from caphy.errors import CaphyError
from caphy.register.cloud import even_sample
from caphy.register.points import ScanPoints
from caphy.training.in_threads import in_threads

SAMPLE = 2500
"""Points of a scan's garment that are held against the cloth: spread evenly, 2 cm apart on a shirt."""
UNSEEN = 0.03
"""Cloth farther than this from everything that the scan shows [m] was seen by no camera: it is not pulled."""
THINNED = 20_000
"""Points of a scan that are kept to tell what no camera saw: under 2 cm apart."""
LEAST_POINTS = 50
"""Points below which a scan does not show a garment."""


def require_shown(scan: ScanPoints, worn: str) -> None:
    """Raise CaphyError where a scan shows next to nothing of the garment ``worn``, a part of its points."""
    count = len(getattr(scan, worn))
    if count < LEAST_POINTS:
        raise CaphyError(
            f"{scan.name}: has {count} points of the {worn} garment, at least {LEAST_POINTS} are needed; check its "
            "labels, or take it out of split.json"
        )


@dataclass(frozen=True, eq=False)
class Target:
    """One garment in one scan."""

    sample: np.ndarray
    """Points of it spread evenly (N, 3) [m]."""
    cloth: KDTree
    """All its points."""
    over: KDTree | None
    """Points of what is worn over it, if anything is."""
    everything: KDTree
    """Points of the whole scan, thinned."""

    @classmethod
    def of(cls, scan: ScanPoints, worn: str, over: Sequence[str]) -> Target:
        """The garment ``worn`` (a part of the scan's points) with the parts worn ``over`` it.

        Raises:
            CaphyError: the scan shows next to nothing of it.
        """
        require_shown(scan, worn)
        own = getattr(scan, worn).astype(np.float64)
        above = [getattr(scan, part) for part in over if len(getattr(scan, part))]
        shown = np.concatenate([scan.body, scan.upper, scan.lower])
        some = np.random.default_rng(0).permutation(len(shown))[:THINNED]
        return cls(
            own[even_sample(own, SAMPLE)] if len(own) > SAMPLE else own,
            KDTree(own),
            KDTree(np.concatenate(above)) if above else None,
            KDTree(shown[some]),
        )

    def counterparts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The point (V, 3) of the scan's garment nearest to each vertex x (V, 3), and which vertices (V,) it shows.

        It does not show what lies under another garment (a point of that is nearer), nor what no camera saw.
        """
        distance, nearest = self.cloth.query(x)
        shown = np.ones(len(x), dtype=bool)
        if self.over is not None:
            shown &= self.over.query(x, distance_upper_bound=distance.max() + 1e-9)[0] > distance
        far = np.flatnonzero(shown & (distance > UNSEEN))
        if len(far):
            shown[far] = self.everything.query(x[far], distance_upper_bound=UNSEEN)[0] < UNSEEN
        return self.cloth.data[nearest], shown


class Counterparts(NamedTuple):
    """What lies nearest to what, between cloth of V vertices and N points of a scan; any leading axes count scans."""

    point: Tensor
    """The scan's point nearest to each vertex (..., V, 3) [m]."""
    shown: Tensor
    """1 where the scan shows the vertex, else 0 (..., V)."""
    sample: Tensor
    """Points of the scan (..., N, 3) [m]."""
    share: Tensor
    """What each of them counts for, in all 1 (..., N)."""
    corners: Tensor
    """Corners of the cloth's face nearest to each (..., N, 3)."""
    barycentric: Tensor
    """Where on it (..., N, 3)."""


def look(surface: Surface, x: Tensor, targets: Sequence[Target]) -> Counterparts:
    """Counterparts (B, ...) of cloth at x (B, V, 3) in as many scans, found by trees; surface: of the cloth's faces."""
    still = x.detach().cpu().double().numpy()

    def one(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        back = surface.nearest(targets[i].sample, still[i])
        return *targets[i].counterparts(still[i]), surface.faces[back.face], np.asarray(back.barycentric)

    points, shown, corners, barycentric = zip(*in_threads(one, len(targets)), strict=True)
    sample, share = _samples(targets)
    found = np.stack(points), np.stack(shown), sample, share, *map(_padded, (corners, barycentric))
    return Counterparts(*(torch.from_numpy(each).to(x if each.dtype != np.int64 else x.device) for each in found))


class Grouped:
    """Scans whose points lie on a GPU in groups, where counterparts are looked up as by :func:`look`."""

    def __init__(self, surface: Surface, targets: Sequence[Target], device: torch.device) -> None:
        """``surface``: of the cloth's faces."""
        nothing = np.zeros((0, 3))
        self.surface = GroupedSurface(surface, device)
        self.cloth, self.over, self.everything = (
            GroupedClouds([nothing if tree is None else tree.data for tree in trees], device)
            for trees in zip(*((t.cloth, t.over, t.everything) for t in targets), strict=True)
        )
        self.sample, self.share = (torch.from_numpy(part).float().to(device) for part in _samples(targets))

    def look(self, x: Tensor, scans: Sequence[int]) -> Counterparts:
        """Counterparts (B, ...) of cloth at x (B, V, 3) in the ``scans`` (B,)."""
        x, scan = x.detach(), torch.as_tensor(scans, device=x.device)
        distance, point = self.cloth.nearest(x, scan)
        # All points of the garment tell that it was seen there, else the thinned ones of everything
        seen = (distance <= UNSEEN) | (self.everything.nearest(x, scan)[0] < UNSEEN)
        shown = seen & (self.over.nearest(x, scan)[0] > distance)
        back = self.surface.nearest(self.sample[scan], x)
        corners = self.surface.faces[back.face]
        return Counterparts(point, shown.to(x), self.sample[scan], self.share[scan], corners, back.barycentric)


def _samples(targets: Sequence[Target]) -> tuple[np.ndarray, np.ndarray]:
    """The samples (B, N, 3) [m] of scans, and the share (B, N) of each point in its scan's."""
    return _padded([t.sample for t in targets]), _padded([np.full(len(t.sample), 1 / len(t.sample)) for t in targets])


def _padded(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of different lengths in one, zeros at the end of the shorter."""
    result = np.zeros((len(parts), max(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype)
    for row, part in zip(result, parts, strict=True):
        row[: len(part)] = part
    return result
