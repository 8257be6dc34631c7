"""The six garment families: what a user may ask of each, and how a cut becomes a :class:`Garment`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from caphy.body.model import BodyModel
from caphy.errors import CaphyError, TooSharp
from caphy.garment import bottoms, tops
from caphy.garment.cut import Cut
from caphy.garment.dressing import dress
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import contour, cut_sheet, too_sharp
from caphy.garment.template import Garment
from caphy.garment.topology import without_area


@dataclass(frozen=True)
class Top:
    """Options shared by tops. Lengths in metres; what is left out is proportioned to the body."""

    sleeve: float | None = None
    """Sleeve length from the shoulder joint along the arm."""
    length: float | None = None
    """Length from the base of the neck down to the hem."""
    ease: float = 0.025
    """Gap between the chest and the cloth; the chest girth grows by 2 pi times this (a quarter panel by pi/2)."""
    sleeve_ease: float = 0.016
    """Gap round the arm; it collects below the arm, so the cloth hangs there by twice this."""
    flare: float = 0.06
    """How much narrower, per metre, the trunk may be than it is above; 0 hangs straight from the chest."""
    neck_width: float = 0.015
    """Gap between the neck and the neckline at the sides."""
    neck_depth: float = 0.02
    """How far the neckline dips in front of the base of the neck."""
    edge_length: float = 0.0205
    """Target edge length of the mesh."""
    layer_thickness: float = 0.0
    """Extra distance to keep from the body below the waist, where trousers are worn underneath."""

    family: ClassVar[str] = "top"
    arm_share: ClassVar[float] = 0.0
    """Default sleeve as a share of the arm from shoulder to wrist."""

    def cut(self, marks: Landmarks) -> Cut:
        arm = float(np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder")))
        sleeve = self.arm_share * arm if self.sleeve is None else self.sleeve
        longest = marks.joint("neck")[1] - marks.joint("left_knee")[1]
        length = marks.joint("neck")[1] - marks.crotch - 0.03 if self.length is None else self.length
        _between("sleeve", sleeve, 0.0, arm)
        _between("length", length, marks.joint("neck")[1] - marks.armpit + 0.05, longest)
        return tops.top(
            marks,
            sleeve=sleeve,
            length=length,
            ease=self.ease,
            sleeve_ease=self.sleeve_ease,
            flare=self.flare,
            neck_width=self.neck_width,
            neck_depth=self.neck_depth,
        )


@dataclass(frozen=True)
class Tshirt(Top):
    """A T-shirt. Lengths in metres; what is left out is proportioned to the body."""

    family: ClassVar[str] = "tshirt"
    arm_share: ClassVar[float] = 0.4


@dataclass(frozen=True)
class LongSleeve(Top):
    """A long-sleeved shirt. Lengths in metres; what is left out is proportioned to the body."""

    family: ClassVar[str] = "longsleeve"
    arm_share: ClassVar[float] = 0.97


@dataclass(frozen=True)
class Tank(Top):
    """A tank top: armholes instead of sleeves, a deeper neckline. Lengths in metres; what is left out is proportioned
    to the body."""

    ease: float = 0.012
    flare: float = 0.15
    neck_width: float = 0.035
    neck_depth: float = 0.07

    family: ClassVar[str] = "tank"


@dataclass(frozen=True)
class Trousers:
    """Trousers. Lengths in metres; what is left out is proportioned to the body."""

    rise: float | None = None
    """Height of the waistband above the crotch."""
    leg: float | None = None
    """Length from the crotch down to the hem."""
    ease: float = 0.007
    """Gap at waist and hips."""
    leg_ease: float = 0.018
    """Gap round the leg."""
    taper: float = 0.08
    """How much the leg may narrow per metre; 0 falls straight from the thigh."""
    edge_length: float = 0.022
    """Target edge length of the mesh."""
    layer_thickness: float = 0.0025
    """Extra distance to keep from the body."""

    family: ClassVar[str] = "trousers"
    leg_share: ClassVar[float] = 0.92
    """Default leg as a share of the way from crotch to ankle."""

    def cut(self, marks: Landmarks) -> Cut:
        inseam = float(marks.crotch - marks.joint("left_ankle")[1])
        leg = self.leg_share * inseam if self.leg is None else self.leg
        rise = default_rise(marks) if self.rise is None else self.rise
        _between("leg", leg, 0.06, inseam)
        _between("rise", rise, 0.10, marks.armpit - marks.crotch - 0.05)
        return bottoms.trousers(marks, rise=rise, leg=leg, ease=self.ease, leg_ease=self.leg_ease, taper=self.taper)


@dataclass(frozen=True)
class Shorts(Trousers):
    """Shorts, looser in the leg than trousers. Lengths in metres; what is left out is proportioned to the body."""

    leg_ease: float = 0.028
    taper: float = 0.0
    edge_length: float = 0.018

    family: ClassVar[str] = "shorts"
    leg_share: ClassVar[float] = 0.36


@dataclass(frozen=True)
class Skirt:
    """A flared skirt. Lengths in metres; what is left out is proportioned to the body."""

    rise: float | None = None
    """Height of the waistband above the crotch."""
    length: float | None = None
    """Length from the waistband down to the hem."""
    ease: float = 0.007
    """Gap at waist and hips."""
    flare: float = 0.2
    """How much the gap widens per metre below the waist."""
    edge_length: float = 0.022
    """Target edge length of the mesh."""
    layer_thickness: float = 0.0
    """Extra distance to keep from the body."""

    family: ClassVar[str] = "skirt"

    def cut(self, marks: Landmarks) -> Cut:
        rise = default_rise(marks) if self.rise is None else self.rise
        full = marks.crotch + rise - marks.joint("left_ankle")[1]
        length = 0.55 * full if self.length is None else self.length
        _between("rise", rise, 0.10, marks.armpit - marks.crotch - 0.05)
        _between("length", length, rise + 0.05, full)
        return bottoms.skirt(marks, rise=rise, length=length, ease=self.ease, flare=self.flare)


Family = Tshirt | LongSleeve | Tank | Trousers | Shorts | Skirt
FAMILIES: Mapping[str, type[Family]] = {
    kind.family: kind for kind in (Tshirt, LongSleeve, Tank, Trousers, Shorts, Skirt)
}


RANGES: Mapping[str, tuple[float, float]] = {
    "edge_length": (0.006, 0.05),
    "ease": (-0.01, 0.5),
    "sleeve_ease": (-0.01, 0.3),
    "leg_ease": (-0.01, 0.3),
    "flare": (0.0, 2.0),
    "taper": (0.0, 1.0),
    "neck_width": (-0.02, 0.15),
    "neck_depth": (-0.03, 0.3),
    "layer_thickness": (0.0, 0.1),
}
"""What options of families may be, on any body; lengths [m], flare and taper metres per metre."""
SHARES = tuple(1 - k / 40 for k in range(13))
"""Edge lengths that are tried, as shares of the one asked for: which a sharp cut can be meshed with is chance."""


def default_rise(marks: Landmarks) -> float:
    """Height of a waistband above the crotch that sits just under the natural waist."""
    return 0.13 * marks.height


def _between(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        unit = "" if name in ("flare", "taper") else " m"
        raise CaphyError(
            f"{name} must lie between {low:.3f} and {high:.3f}{unit} on this body, got {value:.3f}{unit}; "
            "give another value or leave it out for one proportioned to the body"
        )


def make(family: Family, body: BodyModel, betas: np.ndarray | None = None) -> Garment:
    """Make a garment of ``family`` on ``body`` in shape ``betas`` (S,), T-pose.

    Raises
        CaphyError: if an option does not fit the body; the message names its range.
        TooSharp: if the cut turns too sharply for edges of its length.
    """
    for name, (low, high) in RANGES.items():
        if hasattr(family, name):
            _between(name, getattr(family, name), low, high)
    marks = Landmarks.of(body, betas)
    cut = family.cut(marks)
    vertices, faces = contour(cut.surface, cut.low, cut.high, min(0.01, 0.45 * family.edge_length))
    vertices, faces = cut_sheet(vertices, faces, list(cut.openings.values()), family.edge_length)
    garment = dress(family, marks, cut, vertices, faces.astype(np.int32))
    if without_area(garment.material).size:  # moved clear of the body, a face may fall flat
        raise too_sharp(family.edge_length)
    return garment


def make_nearest(family: Family, body: BodyModel) -> tuple[Family, Garment]:
    """What :func:`make` makes with the edge length asked for, or else with the longest below it that the cut allows.

    Returns:
        The family with the edge length that it was made with, and the garment.

    Raises:
        CaphyError: as :func:`make`; TooSharp only if edges shorter by :data:`SHARES` will not do either.
    """
    refused = []
    for share in SHARES:
        tried = replace(family, edge_length=share * family.edge_length)
        try:
            return tried, make(tried, body)
        except TooSharp as error:
            refused.append(error)
    raise refused[0]
