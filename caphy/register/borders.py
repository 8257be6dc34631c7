"""Where cloth ends, read off scans: how far sleeves reach along the arm, hems down the body.

Cloth that hangs lies elsewhere than a template that follows the skeleton: sleeves gather beneath a lowered arm, a shirt
slides to one side. What keeps, taken round a limb and over many poses, is how far along the body it ends. So each point
of a scan is carried to the nearest place of the T-posed body; round the limb they fall into sectors, and in each the
edge lies where fewest points are on its wrong side.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caphy.body.surface import Surface
from caphy.conventions import JOINT_NAMES
from caphy.garment.landmarks import PARTS, Landmarks
from caphy.garment.sections import slice_frame
from caphy.register.chamfer import LABELS, Target
from caphy.scan.scan import LOWER, UPPER

SECTORS = 12
"""Sectors round an arm, a leg or the trunk."""
SEEN = 0.6
"""Share of the sectors that must show an edge for a loop to count."""
ASTRAY = 0.10
"""Distance [m] from the middle of its loop at which an edge is something else, as a forearm laid on the shirt."""
MIXED = 0.2
"""Share of a sector's points on the wrong side of an edge above which there is none."""
UNDER = 0.5
"""What a bare point within an edge counts for, against a cloth point beyond: one looks into sleeves and under hems."""
WHOLE = 0.05
"""An arm of which nothing is seen nearer to the shoulder joint than this [m] tells nothing of its sleeve."""
IN_COMMON = 0.4
"""Share of the sectors in which two must show an edge for one to be farther than the other."""
LEAST_SCANS = 6
"""Scans below which ends are not read off: in a few poses a shirt hangs to one side, or hems are folded up."""
LEAST = 3
"""Points on either side of an edge below which there is none."""
BARE = 0.02
"""Share of a limb's points that are cloth below which the garment ends before it."""
FAR, FACING = 0.08, 0.2
"""Points farther from the body [m], or turned from it by more than this cosine, belong to another part of it. Cloth so
far off, as a flared skirt's, still says that no edge lies before it."""
GAP = 0.004
"""How far [m] cloth goes on beyond its last point, at most."""


@dataclass(frozen=True)
class Borders:
    """Where a garment ends on the T-posed body; none where too little is seen of it."""

    cuff: float | None = None
    """Along the arm from the shoulder joint [m]."""
    hem: float | None = None
    """Height y [m]."""

    @classmethod
    def of(cls, targets: Sequence[Target], marks: Landmarks) -> Borders:
        """Medians over ``targets``, all of one kind, on the body of ``marks``; nothing from too few of them."""
        if len(targets) < LEAST_SCANS:
            return cls()
        surface = Surface.of(marks.body.faces, marks.vertices)
        laid = [_Laid.of(target, surface, marks) for target in targets]
        down = _median(loop.middle for each in laid for _, loop in each.hems())
        return cls(
            cuff=_median(loop.middle for each in laid for _, loop in each.cuffs()),
            hem=None if down is None else -down,
        )


@dataclass(frozen=True, eq=False)
class Ends:
    """Where one scan's cloth ends on the T-posed body, sector by sector: cuffs along the arm, hems down the body.

    By side of the body (1.0 the left, -1.0 the right, 0.0 neither); none where that side shows nothing.
    """

    cuffs: Mapping[float, _Loop]
    hems: Mapping[float, _Loop]

    @classmethod
    def of(cls, target: Target, marks: Landmarks) -> Ends:
        """Of a scan, or of cloth of known points, on the body of ``marks``."""
        laid = _Laid.of(target, Surface.of(marks.body.faces, marks.vertices), marks)
        return cls(dict(laid.cuffs()), dict(laid.hems()))

    def beyond(self, other: Ends) -> tuple[float | None, float | None]:
        """How much farther than another's these cuffs and these hems reach [m]; none where too little is seen of both.

        Cloth that slides to one side ends higher here and lower there, so both sides count alike; and where an edge is
        seen in part, parts are held against the same parts.
        """
        return _beyond(self.cuffs, other.cuffs), _beyond(self.hems, other.hems)


@dataclass(frozen=True, eq=False)
class _Loop:
    """The edge of a garment, sector by sector."""

    along: np.ndarray
    """(K,) [m], growing from the cloth to what is bare; NaN where it was not seen."""

    @classmethod
    def of(cls, along: np.ndarray, around: np.ndarray, cloth: np.ndarray, far: np.ndarray) -> _Loop:
        """The edge between points (N, 3) that are ``cloth`` (N,) and others, which lie at ``around`` (N,) [rad].

        There is none where cloth that is ``far`` (N,) off the body lies beyond it.
        """
        near = ~far
        if near.any() and cloth[near].mean() < BARE:
            places = np.full(SECTORS, along[near].min())
        else:
            sectors = (_sector(around[near]) == k for k in range(SECTORS))
            places = np.array([_edge(along[near][mine], cloth[near][mine]) for mine in sectors])
        sector = _sector(around[far])
        beyond = np.bincount(sector[along[far] > places[sector]], minlength=SECTORS)
        places[beyond >= LEAST] = np.nan
        if np.isfinite(places).any():
            places[np.abs(places - np.nanmedian(places)) > ASTRAY] = np.nan
        return cls(places)

    @property
    def middle(self) -> float | None:
        """Mean place of the edge [m]."""
        seen = np.isfinite(self.along)
        return float(self.along[seen].mean()) if seen.mean() >= SEEN else None


@dataclass(frozen=True, eq=False)
class _Laid:
    """A scan carried to the T-posed body, and what of it is near enough to count."""

    target: Target
    marks: Landmarks
    places: np.ndarray
    """Nearest places on the T-posed body (N, 3) [m]."""
    weights: np.ndarray
    """The body's skinning weights there (N, 55)."""
    near: np.ndarray
    """Which points belong to where they were carried (N,)."""
    far: np.ndarray
    """Which are cloth too far off for that (N,)."""

    @classmethod
    def of(cls, target: Target, surface: Surface, marks: Landmarks) -> _Laid:
        scan, posed, faces = target.scan, target.placed.vertices, marks.body.faces
        found = surface.nearest(scan.points, posed)
        a, b, c = (posed[faces[found.face, k]] for k in range(3))
        outward = np.cross(b - a, c - a)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-30
        near = ((outward * scan.normals).sum(axis=1) > FACING) & (found.distance < FAR)
        far = (scan.labels == LABELS[target.kind]) & (found.distance >= FAR)
        places, weights = (
            np.einsum("nk,nkc->nc", found.barycentric, values[faces[found.face]])
            for values in (marks.vertices, marks.body.weights)
        )
        return cls(target, marks, places, weights, near, far)

    def cuffs(self) -> Iterator[tuple[float, _Loop]]:
        """The ends of the sleeves, by side; lengths run from the shoulder joint."""
        if self.target.kind == "lower":
            return
        shoulder = self.marks.joint("left_shoulder")
        frame = slice_frame(self.marks.joint("left_wrist") - shoulder)
        for side in (1.0, -1.0):
            local = (self.places * [side, 1, 1] - shoulder) @ frame.T
            on = self._on("arm", "hand") & (side * self.places[:, 0] > 0) & (self.target.scan.labels != LOWER)
            seen = local[on & self.near, 0]
            if len(seen) and seen.min() < WHOLE:
                yield side, self._loop(local[:, 0], local[:, 1], local[:, 2], on)

    def hems(self) -> Iterator[tuple[float, _Loop]]:
        """The lower ends, by side; of trousers one for each leg. Lengths run down from height zero."""
        x, y, z = self.places.T
        middle = self.marks.joint("pelvis")
        if self.target.kind == "upper":
            on = self._on("leg", "trunk") & (y < self.marks.armpit - 0.1) & (y > self.marks.joint("left_knee")[1])
            yield 0.0, self._loop(-y, x - middle[0], z - middle[2], on)
            return
        hip, ankle = self.marks.joint("left_hip"), self.marks.joint("left_ankle")
        share = ((hip[1] - y) / (hip[1] - ankle[1]))[:, None]
        bone = hip + share * (ankle - hip)
        for side in (1.0, -1.0):
            on = self._on("leg", "foot") & (side * x > 0) & (y > ankle[1] - 0.03)
            yield side, self._loop(-y, side * x - bone[:, 0], z - bone[:, 2], on & (self.target.scan.labels != UPPER))

    def _on(self, *parts: str) -> np.ndarray:
        """Which points (N,) count and lie on parts of the body."""
        joints = [JOINT_NAMES.index(name) for part in parts for name in PARTS[part]]
        return (self.near | self.far) & (self.weights[:, joints].sum(axis=1) > 0.5)

    def _loop(self, along: np.ndarray, right: np.ndarray, front: np.ndarray, on: np.ndarray) -> _Loop:
        scan = self.target.scan
        cloth = scan.labels == LABELS[self.target.kind]
        return _Loop.of(along[on], np.arctan2(front, right)[on] % (2 * np.pi), cloth[on], self.far[on])


def _sector(around: np.ndarray) -> np.ndarray:
    """Numbers (N,) of the sectors at angles (N,) [rad]."""
    return np.floor(around / (2 * np.pi) * SECTORS).astype(int) % SECTORS


def _edge(along: np.ndarray, cloth: np.ndarray) -> float:
    """Where ``along`` (N,) [m] cloth ends; NaN where it does not."""
    if min(cloth.sum(), (~cloth).sum()) < LEAST:
        return np.nan
    order = np.argsort(along)
    along, cloth = along[order], cloth[order]
    wrong = cloth.sum() + np.append(0, np.cumsum(np.where(cloth, -1, UNDER)))  # with the first k points within
    k = int(wrong.argmin())
    if k in (0, len(along)) or wrong[k] > MIXED * len(along):
        return np.nan
    return float(along[k - 1] + min(0.5 * (along[k] - along[k - 1]), GAP))


def _beyond(these: Mapping[float, _Loop], others: Mapping[float, _Loop]) -> float | None:
    """The mean over all sides of how much farther one edge is than the other [m]; none unless all show it."""
    sides = these.keys() & others.keys()
    further = [these[side].along - others[side].along for side in sorted(sides)]
    if not further or sides != these.keys() | others.keys():
        return None
    seen = [np.isfinite(each) for each in further]
    if min(each.mean() for each in seen) < IN_COMMON:
        return None
    return float(np.mean([each[known].mean() for each, known in zip(further, seen, strict=True)]))


def _median(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
