"""Which garment template a scanned person wears: the best of several hundred styles, then refined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_NAMES
from caphy.garment.families import Family, make_nearest
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register.articulation import Figure, Placement
from caphy.register.borders import Borders
from caphy.register.chamfer import Target
from caphy.register.starts import plain_poses
from caphy.register.styles import (
    EASES,
    KINDS,
    NECK_DEPTHS,
    NECK_WIDTHS,
    TRIMS,
    Sheet,
    cuttable,
    longest,
    ranges,
    seen_lengths,
    styles_of,
)

STYLES = 330
"""Styles looked at for each kind of garment."""
SCANS = 40
"""Scans looked at: those nearest to a T- or A-pose. Where cloth ends is taken from all of them."""
COMPARED = 2
"""How many of them styles are compared with point by point."""
EASE_STEPS = {"ease": 0.012, "sleeve_ease": 0.008, "flare": 0.08, "leg_ease": 0.012, "taper": 0.05}
"""First steps of the refinement of a surface [m, or metres per metre]."""
NECK_SCANS = 8
"""How many of the plainest scans necklines are compared with: all of a neckline is a hundredth of a shirt."""
BORDER = 0.05
"""Cost [m] of a garment that ends in the wrong place, by the share of its area that is too much or missing.

Distances alone are blind to it: cutting off a hem that stands off further than the rest lowers the mean."""
ENDS = 0.3
"""Cost [m] of a sleeve or hem by the length [m] that it is longer or shorter than what the scans show on the body."""
LEAST_POINTS = 50
NOTHING = 1.0
"""Score [m] of a style of which fewer points than these are seen."""
USUAL = 0.0005
"""Cost [m] of a length that lies a whole range from the family's default: decides what no camera saw."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Choice:
    """The style that fits best."""

    style: Family
    distance: float
    """Mean two-way distance [m] from the cloth of the scans that styles are compared with, posed by the skeleton."""
    looked_at: int
    """How many styles were compared."""
    runners_up: tuple[tuple[str, float], ...]
    """Best distance [m] of each family, with what it costs to end in the wrong place."""


def dressed_body(figure: Figure) -> BodyModel:
    """The figure as a body of its own, whose mean shape it is."""
    vertices, joints = figure.rest
    return replace(figure.body, v_template=vertices, joints=joints)


def plainest(placements: Sequence[Placement], count: int = SCANS) -> list[int]:
    """Numbers of the ``count`` placements nearest to a T- or an A-pose, nearest first."""
    limbs = [i for i, name in enumerate(JOINT_NAMES[:22]) if i and not name.endswith(("wrist", "foot", "head", "neck"))]
    plain = [placement.rotations[limbs] for placement in plain_poses()[:2]]

    def angle(placement: Placement) -> float:
        own = placement.rotations[limbs]
        turns = [np.einsum("jab,jab->j", own, other) for other in plain]
        return min(float(np.arccos(np.clip((turn - 1) / 2, -1, 1)).mean()) for turn in turns)

    return [int(i) for i in np.argsort([angle(placement) for placement in placements])[:count]]


def choose(figure: Figure, targets: Sequence[Target], kind: str, progress: Progress, seed: int = 0) -> Choice:
    """The style of a kind (``upper``, ``lower``) nearest to the cloth of ``targets``, the plainest scan first."""
    marks, rng = Landmarks.of(dressed_body(figure)), np.random.default_rng(seed)
    progress(f"{kind}: where it ends", 0, 1)
    borders = Borders.of(targets, marks)
    surfaces = [(family, eases) for family in KINDS[kind] for eases in EASES[family]]
    each, found, looked_at = -(-STYLES // len(surfaces)), [], 0
    for i, (family, eases) in enumerate(surfaces):
        progress(f"{kind}: styles", i, len(surfaces))
        judge = Judge(Sheet.of(longest(family, eases, marks), marks), targets[:COMPARED], borders)
        scores = [(judge(style), style) for style in styles_of(judge.sheet, each, rng)]
        looked_at += len(scores)
        style = judge.ended(min(scores, key=lambda pair: pair[0])[1])
        style = with_neck(judge, refined_lengths(judge, style, judge(style))[1], judge.targets)
        found.append((judge(style), style, judge))
    best = min(found, key=lambda item: item[0])
    families = {family: min(f[0] for f in found if f[1].family == family) for family in KINDS[kind]}
    progress(f"{kind}: refining", 0, 1)
    style, judge = refined(best[1], best[2], targets[:NECK_SCANS])
    return Choice(style, judge.distance(style), looked_at, tuple(sorted(families.items(), key=lambda item: item[1])))


class Judge:
    """Compares styles of one surface with the scans."""

    def __init__(self, sheet: Sheet, targets: Sequence[Target], borders: Borders):
        self.sheet, self.targets, self.borders = sheet, targets, borders
        self._posed = [target.posed(sheet.points, sheet.weights) for target in targets]
        self._away = [target.from_garment(posed) for target, posed in zip(targets, self._posed, strict=True)]
        self._seen = [target.seen(posed) for target, posed in zip(targets, self._posed, strict=True)]
        self._limits = ranges(sheet.longest.family, sheet.marks)

    def of(self, longest: Family) -> Judge:
        """A judge of another surface."""
        return Judge(Sheet.of(longest, self.sheet.marks), self.targets, self.borders)

    def __call__(self, style: Family) -> float:
        """Mean two-way distance [m], with what wrong ends and unusual lengths cost."""
        kept = self.sheet.kept(style)
        if not self._shown(kept):
            return NOTHING
        wrong = [((kept != cloth) & known).sum() / (kept & known).sum() for known, cloth in self._seen]
        cost = BORDER * np.mean(wrong) + self._misplaced(style) + self._unusual(style)
        return self._distance(kept) + float(cost)

    def distance(self, style: Family) -> float:
        """Mean two-way distance [m]."""
        kept = self.sheet.kept(style)
        return self._distance(kept) if self._shown(kept) else NOTHING

    def ended(self, style: Family) -> Family:
        """The style with the lengths that the scans show, as far as its family goes."""
        lengths = {name: np.clip(value, *self._limits[name]) for name, value in self._lengths(style).items()}
        return cuttable(replace(style, **{name: float(value) for name, value in lengths.items()}))

    def _shown(self, kept: np.ndarray) -> bool:
        return all((kept & known).sum() >= LEAST_POINTS for known, _ in self._seen)

    def _distance(self, kept: np.ndarray) -> float:
        both = [
            0.5 * (away[kept & known].mean() + target.to_garment(posed[kept]))
            for target, posed, away, (known, _) in zip(self.targets, self._posed, self._away, self._seen, strict=True)
        ]
        return float(np.mean(both))

    def _misplaced(self, style: Family) -> float:
        """What it costs [m] that the style ends elsewhere than the cloth of the scans."""
        lengths = seen_lengths(style, self.borders, self.sheet.marks)
        return ENDS * sum(abs((getattr(style, name) or 0.0) - max(value, 0.0)) for name, value in lengths.items())

    def _lengths(self, style: Family) -> dict[str, float]:
        lengths = seen_lengths(style, self.borders, self.sheet.marks)
        return {name: value for name, value in lengths.items() if name in self._limits}

    def _unusual(self, style: Family) -> float:
        if not hasattr(style, "rise"):
            return 0.0
        low, high = self._limits["rise"]
        return USUAL * ((style.rise - 0.13 * self.sheet.marks.height) / (high - low)) ** 2  # pyright: ignore


def refined_lengths(judge: Judge, style: Family, score: float) -> tuple[float, Family]:
    """The style with its lengths at the nearest minimum (Nelder and Mead), within their ranges."""
    limits = ranges(style.family, judge.sheet.marks)
    names = list(TRIMS[style.family])
    low, high = (np.array([limits[name][k] for name in names]) for k in (0, 1))

    def styled(values: np.ndarray) -> Family:
        return cuttable(replace(style, **dict(zip(names, np.clip(values, low, high).tolist(), strict=True))))

    start = np.array([getattr(style, name) for name in names])
    corners = np.vstack([start, start + 0.03 * np.eye(len(names))])
    options = {"initial_simplex": corners, "xatol": 0.001, "fatol": 1e-6, "maxfev": 40 * len(names)}
    answer = minimize(lambda x: judge(styled(x)), start, method="Nelder-Mead", options=options)
    return (float(answer.fun), styled(answer.x)) if answer.fun < score else (score, style)


def with_neck(judge: Judge, style: Family, shown: Sequence[Target]) -> Family:
    """The style with the neckline that fits the scans ``shown`` best at its lengths.

    Lengths must be right before: a centimetre of them costs 3 mm, and necklines differ by tenths.
    """
    if not hasattr(style, "neck_width"):
        return style
    necks = product(NECK_WIDTHS.tolist(), NECK_DEPTHS.tolist())
    styles = [replace(style, neck_width=width, neck_depth=depth) for width, depth in necks]
    return min(style, *styles, key=Judge(judge.sheet, shown, judge.borders))


def refined(style: Family, judge: Judge, shown: Sequence[Target]) -> tuple[Family, Judge]:
    """The style with neckline, eases and lengths improved one after another, with steps that halve; and its judge.

    Necklines are held against the scans ``shown``, the rest against those of ``judge``.
    """
    steps = {name: step for name, step in EASE_STEPS.items() if hasattr(style, name)}
    for share in (1.0, 0.5):
        style = with_neck(judge, style, shown)
        score = judge(style)
        for name, step in steps.items():
            for sign in (1.0, -1.0):
                value = max(getattr(style, name) + sign * share * step, 0.0)
                other = judge.of(replace(judge.sheet.longest, **{name: value}))
                tried = replace(style, **{name: value})
                found = other(tried)
                if found < score:
                    score, style, judge = found, tried, other
                    break
        score, style = refined_lengths(judge, style, score)
    return style, judge


def distance(style: Family, figure: Figure, targets: Sequence[Target]) -> float:
    """The :attr:`Choice.distance` [m] of a style all of whose lengths are given; the plainest of ``targets`` first."""
    marks = Landmarks.of(dressed_body(figure))
    eases = {name: getattr(style, name) for name in EASE_STEPS if hasattr(style, name)}
    sheet = Sheet.of(longest(style.family, eases, marks), marks)
    return Judge(sheet, targets[:COMPARED], Borders()).distance(style)


def made(style: Family, figure: Figure) -> tuple[Family, Garment]:
    """A style as a garment on the fitted body, T-pose, and with the edge length that it can be made with."""
    return make_nearest(style, dressed_body(figure))
