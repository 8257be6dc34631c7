"""The style space of the parametric garments as point sheets that are trimmed, not meshed: thousands a minute.

A family's surface depends on its eases; its lengths and its neckline only say where the cloth ends. So each of a few
surfaces is contoured once, as long as it can be, and a style is those of its points that lie inside the style's
openings. An opening's field is a distance along the garment: a longer garment has the same field, shifted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from caphy.garment import topology
from caphy.garment.attach import skinning_weights
from caphy.garment.families import FAMILIES, Family
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import Field, contour
from caphy.garment.tops import neckline
from caphy.register.borders import Borders

GRID = 0.015
"""Spacing of a surface's points [m]."""
POINTS = 8000
"""Points of each surface."""
KINDS: Mapping[str, tuple[str, ...]] = {
    "upper": ("tshirt", "longsleeve", "tank"),
    "lower": ("trousers", "shorts", "skirt"),
}
"""Families that each label of a scan can be."""

BELOW = 0.051
"""Least length [m] of a skirt below the crotch: a millimetre more than its cut asks for."""
TRIMS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "tshirt": {"length": {"hem": 1.0}, "sleeve": {"cuff": 1.0}},
    "longsleeve": {"length": {"hem": 1.0}, "sleeve": {"cuff": 1.0}},
    "tank": {"length": {"hem": 1.0}},
    "trousers": {"leg": {"hem": 1.0}, "rise": {"waist": 1.0}},
    "shorts": {"leg": {"hem": 1.0}, "rise": {"waist": 1.0}},
    "skirt": {"length": {"hem": 1.0}, "rise": {"waist": 1.0, "hem": -1.0}},
}
"""By how much each opening's field grows per metre of a length."""

EASES: Mapping[str, tuple[Mapping[str, float], ...]] = {
    "tshirt": (
        {},
        {"ease": 0.012, "sleeve_ease": 0.010},
        {"ease": 0.04, "sleeve_ease": 0.024},
        {"ease": 0.03, "flare": 0.0},
    ),
    "longsleeve": ({}, {"ease": 0.04, "sleeve_ease": 0.024}),
    "tank": ({}, {"ease": 0.03}),
    "trousers": ({}, {"leg_ease": 0.032, "taper": 0.0}),
    "shorts": ({}, {"leg_ease": 0.05}),
    "skirt": ({}, {"flare": 0.1}, {"flare": 0.35}),
}
"""Surfaces that are looked at, as differences from a family's defaults."""

NECKS = ((0.005, 0.01), (0.015, 0.02), (0.03, 0.05), (0.045, 0.09))
"""Widths and depths of necklines [m] that lengths are looked for with."""
NECK_WIDTHS, NECK_DEPTHS = np.arange(8) / 100, np.arange(16) / 100
"""Widths and depths [m] that are looked at when lengths are known, each with each."""


def ranges(family: str, marks: Landmarks) -> dict[str, tuple[float, float]]:
    """Least and greatest value [m] of each length of a family on a body."""
    arm = float(np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder")))
    inseam = float(marks.crotch - marks.joint("left_ankle")[1])
    neck, knee = marks.joint("neck")[1], marks.joint("left_knee")[1]
    rise = (0.10, 0.17 * marks.height)
    tops = {"length": (neck - marks.crotch - 0.25, min(neck - marks.crotch + 0.12, neck - knee - 0.001))}
    return {
        "tshirt": tops | {"sleeve": (0.12 * arm, 0.70 * arm)},
        "longsleeve": tops | {"sleeve": (0.70 * arm, 0.999 * arm)},
        "tank": tops,
        "trousers": {"leg": (0.6 * inseam, 0.999 * inseam), "rise": rise},
        "shorts": {"leg": (0.07, 0.6 * inseam), "rise": rise},
        "skirt": {"length": (0.3, marks.crotch + rise[0] - marks.joint("left_ankle")[1]), "rise": rise},
    }[family]


def cuttable(style: Family) -> Family:
    """The style; a skirt that would end above the crotch, or right below it, is as long as its cut asks for."""
    if style.family != "skirt":
        return style
    return replace(style, length=max(style.length, style.rise + BELOW))  # pyright: ignore


@dataclass(eq=False)
class Sheet:
    """One surface of a family: points of the longest garment, and how far inside each opening they lie."""

    longest: Family
    vertices: np.ndarray
    """Mesh of the surface on the T-posed body (M, 3) [m]."""
    faces: np.ndarray
    """(F, 3)."""
    face: np.ndarray
    """The face that each of N points lies on; they are spread at random, since a grid's rows would round lengths."""
    points: np.ndarray
    """(N, 3) [m]."""
    weights: np.ndarray
    """Skinning weights of the points (N, 55)."""
    marks: Landmarks
    _inside: dict[tuple[float, float] | None, dict[str, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, longest: Family, marks: Landmarks, seed: int = 0) -> Sheet:
        """Contour the surface of ``longest``."""
        cut = longest.cut(marks)
        vertices, faces = contour(cut.surface, cut.low, cut.high, GRID)
        near = np.all([value(vertices) > -0.1 for value in cut.openings.values()], axis=0)  # the head is none of it
        faces = faces[near[faces].all(axis=1)]
        used, flat = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], flat.reshape(faces.shape)
        weights = skinning_weights(vertices, faces, marks.body, marks.vertices)
        rng, area = np.random.default_rng(seed), topology.face_areas(vertices, faces)
        face = rng.choice(len(faces), POINTS, p=area / area.sum())
        share = rng.dirichlet(np.ones(3), POINTS)
        points, own = (np.einsum("nk,nkc->nc", share, values[faces[face]]) for values in (vertices, weights))
        return cls(longest, vertices, faces, face, points, own, marks)

    def kept(self, style: Family) -> np.ndarray:
        """Which points (N,) belong to a style of this surface."""
        inside = self._openings(style)
        shifts = dict.fromkeys(inside, 0.0)
        for length, openings in TRIMS[style.family].items():
            for opening, rate in openings.items():
                shifts[opening] += rate * (getattr(style, length) - getattr(self.longest, length))
        return np.all([value + shifts[name] > 0 for name, value in inside.items()], axis=0)

    @cached_property
    def _longest(self) -> dict[str, Field]:
        """The openings of the longest garment; the others do not ask where its neckline is."""
        return dict(self.longest.cut(self.marks).openings)

    def _openings(self, style: Family) -> dict[str, np.ndarray]:
        """Depth inside each opening (N,) [m] of the longest garment with this style's neckline."""
        neck = (style.neck_width, style.neck_depth) if hasattr(style, "neck_width") else None  # pyright: ignore
        if neck not in self._inside:
            openings = self._longest | ({} if neck is None else {"neck": neckline(self.marks, *neck)})
            whole = np.all([value(self.vertices) > 0 for value in openings.values()], axis=0)
            within = np.flatnonzero(whole[self.faces].any(axis=1))
            piece = within[topology.components(self.faces[within])[0]]
            found = {name: value(self.points) for name, value in openings.items()}
            self._inside[neck] = found | {"piece": np.where(np.isin(self.face, piece), np.inf, -np.inf)}
        return self._inside[neck]


def seen_lengths(style: Family, borders: Borders, marks: Landmarks) -> dict[str, float]:
    """The lengths [m] with which a style would end where ``borders`` say; a tank top's sleeve is none."""
    found = {}
    if borders.cuff is not None and hasattr(style, "sleeve"):
        found["sleeve"] = borders.cuff
    if borders.hem is not None:
        name = "leg" if hasattr(style, "leg") else "length"
        top = marks.crotch if name == "leg" else marks.joint("neck")[1]
        if style.family == "skirt":
            top = marks.crotch + style.rise  # pyright: ignore
        found[name] = float(top - borders.hem)
    return found


def longest(family: str, eases: Mapping[str, float], marks: Landmarks) -> Family:
    """A family as long as it can be, with the given eases."""
    lengths = {name: high for name, (_, high) in ranges(family, marks).items()}
    return FAMILIES[family](**lengths, **eases)


def styles_of(sheet: Sheet, count: int, rng: np.random.Generator) -> Iterator[Family]:
    """About ``count`` styles of one surface: lengths spread evenly over their ranges, necklines in turn."""
    limits = ranges(sheet.longest.family, sheet.marks)
    places = (np.stack([rng.permutation(count) for _ in limits], axis=1) + 0.5) / count  # a Latin hypercube
    for i, place in enumerate(places):
        chosen = {name: low + p * (high - low) for p, (name, (low, high)) in zip(place, limits.items(), strict=True)}
        if any(f.name == "neck_width" for f in fields(sheet.longest)):
            chosen["neck_width"], chosen["neck_depth"] = NECKS[i % len(NECKS)]
        yield cuttable(replace(sheet.longest, **chosen))
