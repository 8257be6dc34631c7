"""Template selection against garments whose lengths are known."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from dressed_scans import GARMENTS, Subject, look

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.garment.families import FAMILIES, Skirt, Trousers, Tshirt, default_rise, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register import template
from caphy.register.articulation import Figure, PlacedFigure
from caphy.register.borders import Borders
from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.register.fit import quiet
from caphy.register.starts import plain_poses
from caphy.register.styles import BELOW, EASES, KINDS, Sheet, cuttable, longest, ranges, styles_of

CHOSEN_FROM = {"upper": ("tshirt", "tank"), "lower": ("trousers", "shorts")}
"""Families of this test; all six take a minute."""


def bundled() -> list[Garment]:
    """T-shirt and trousers, made with the default lengths of the mean body."""
    return [Garment.load(GARMENTS / f"{name}.npz") for name in ("tshirt", "trousers")]


def a_pose(garments: list[Garment]) -> tuple[Cloud, PlacedFigure]:
    """A scan of the mean body in garments, and where the body is."""
    body = default_body()
    person = Subject(body, np.zeros(10), np.zeros_like(body.v_template), garments)
    place = plain_poses()[1]
    sight = look(person, place.pose, place.transl, 0, 12000)
    return Cloud("a_pose", sight.points, sight.normals, sight.labels), Figure.of(body).placed(place)


@pytest.fixture(scope="module")
def scene():
    return a_pose(bundled())


def standing_off(shirt: Garment, marks: Landmarks) -> Garment:
    """A shirt whose hem is half as wide again, and 5 cm higher."""
    down = np.clip((marks.armpit - 0.05 - shirt.vertices[:, 1]) / 0.3, 0, 1)
    down *= np.abs(shirt.vertices[:, 0]) < marks.joint("left_shoulder")[0] + 0.02  # sleeves stay
    wider = shirt.vertices * (1 + 0.5 * down[:, None] * [1, 0, 1])
    return replace(shirt, vertices=wider + 0.05 * down[:, None] * [0, 1, 0])


def cropped(garment: Garment, low: float, high: float) -> Garment:
    """What of a garment lies between two heights y [m]."""
    within = (garment.vertices[:, 1] > low) & (garment.vertices[:, 1] < high)
    kept = within[garment.faces].all(axis=1)
    return replace(garment, faces=garment.faces[kept], material=garment.material[kept])


@pytest.mark.parametrize("kind", ["upper", "lower"])
def test_family_and_lengths_come_back(scene, kind, monkeypatch):
    monkeypatch.setattr(template, "KINDS", CHOSEN_FROM)
    monkeypatch.setattr(template, "EASES", {name: EASES[name][:1] for name in EASES})
    monkeypatch.setattr(template, "EASE_STEPS", {})
    cloud, placed = scene
    marks = Landmarks.of(default_body())
    choice = template.choose(placed.figure, [Target.of(cloud, placed, kind)], kind, quiet)
    assert choice.looked_at >= 300
    targets = [Target.of(cloud, placed, kind)]
    assert template.distance(choice.style, placed.figure, targets) == choice.distance
    assert choice.style.family == {"upper": "tshirt", "lower": "trousers"}[kind]
    arm = np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder"))
    true = {
        "sleeve": 0.4 * arm,
        "length": marks.joint("neck")[1] - marks.crotch - 0.03,
        "leg": 0.92 * (marks.crotch - marks.joint("left_ankle")[1]),
    }
    for name, value in true.items():
        if hasattr(choice.style, name):
            assert getattr(choice.style, name) == pytest.approx(value, abs=0.015), name


@pytest.fixture
def trousers_alone(monkeypatch):
    monkeypatch.setattr(template, "KINDS", {"lower": ("trousers",)})
    monkeypatch.setattr(template, "EASES", {"trousers": EASES["trousers"][:1]})
    monkeypatch.setattr(template, "EASE_STEPS", {})
    monkeypatch.setattr(template, "STYLES", 60)


@pytest.mark.usefixtures("trousers_alone")
def test_a_waistband_under_a_shirt_that_stands_off_is_where_it_usually_is():
    """Hidden cloth lies nearer to what is seen of the trousers below the hem than to the shirt that hides it."""
    marks = Landmarks.of(default_body())
    shirt, trousers = bundled()
    cloud, placed = a_pose([standing_off(shirt, marks), trousers])
    choice = template.choose(placed.figure, [Target.of(cloud, placed, "lower")], "lower", quiet)
    assert choice.style.rise == pytest.approx(default_rise(marks), abs=0.015)


@pytest.mark.usefixtures("trousers_alone")
def test_a_waistband_that_is_seen_is_where_it_is_seen():
    marks = Landmarks.of(default_body())
    shirt, trousers = bundled()
    waist = default_rise(marks) - 0.06
    worn = [cropped(shirt, marks.crotch + 0.28, np.inf), cropped(trousers, -np.inf, marks.crotch + waist)]
    cloud, placed = a_pose(worn)
    choice = template.choose(placed.figure, [Target.of(cloud, placed, "lower")], "lower", quiet)
    assert choice.style.rise == pytest.approx(waist, abs=0.015)


def test_a_neckline_is_no_matter_of_luck(monkeypatch):
    """Styles draw lengths and necklines together, and lengths weigh far more."""
    monkeypatch.setattr(template, "KINDS", {"upper": ("tshirt",)})
    monkeypatch.setattr(template, "EASES", {"tshirt": EASES["tshirt"][:1]})
    monkeypatch.setattr(template, "EASE_STEPS", {})
    monkeypatch.setattr(template, "STYLES", 42)
    deep = make(Tshirt(neck_width=0.015, neck_depth=0.05), default_body())
    cloud, placed = a_pose([deep, bundled()[1]])
    target = Target.of(cloud, placed, "upper")
    styles = [template.choose(placed.figure, [target], "upper", quiet, seed).style for seed in range(3)]
    for name, true in (("neck_width", 0.015), ("neck_depth", 0.05)):
        told = [getattr(style, name) for style in styles]
        assert told == pytest.approx([true] * 3, abs=0.015)
        assert np.ptp(told) <= 0.01


def test_a_sheet_trims_as_the_cut_itself_does():
    """A style's points are the longest garment's that lie inside the openings of the style's own cut."""
    marks = Landmarks.of(default_body())
    sheet = Sheet.of(longest("trousers", {}, marks), marks)
    short = Trousers(leg=0.4, rise=0.15)
    inside = [value(sheet.points) > 0 for value in short.cut(marks).openings.values()]
    kept = sheet.kept(short)
    assert 500 < kept.sum() < len(kept)
    assert not (kept & ~np.all(inside, axis=0)).any()
    assert (np.all(inside, axis=0) & ~kept).sum() < 0.02 * kept.sum()  # what is not part of the garment's piece


def test_a_sheet_knows_other_necklines():
    marks = Landmarks.of(default_body())
    sheet = Sheet.of(longest("tshirt", {}, marks), marks)
    deep = replace(sheet.longest, neck_width=0.04, neck_depth=0.1)
    inside = np.all([value(sheet.points) > 0 for value in deep.cut(marks).openings.values()], axis=0)
    kept, usual = sheet.kept(deep), sheet.kept(sheet.longest)
    assert not (kept & ~inside).any() and (inside & ~kept).sum() < 0.02 * kept.sum()
    assert (usual & ~kept).sum() > 50


def test_every_family_has_styles_that_can_be_cut():
    marks = Landmarks.of(default_body())
    rng = np.random.default_rng(0)
    assert sorted(name for names in KINDS.values() for name in names) == sorted(FAMILIES)
    for family in FAMILIES:
        whole = longest(family, EASES[family][-1], marks)
        sheet = Sheet(whole, *(np.zeros((0, 3)) for _ in range(5)), marks)
        styles = list(styles_of(sheet, 7, rng))
        assert len(styles) == 7
        limits = ranges(family, marks)
        for name, (low, high) in limits.items():
            values = sorted(getattr(style, name) for style in styles)
            assert low < values[0] < low + (high - low) / 6 and high - (high - low) / 6 < values[-1] < high
        for style in (whole, styles[0]):
            style.cut(marks)  # raises where a length does not fit the body


class Scored:
    """A judge that likes skirts short and high: both lengths are taken to the ends of their ranges."""

    def __init__(self, sheet: Sheet):
        self.sheet = sheet

    def __call__(self, style: Skirt) -> float:
        return style.length - style.rise


def test_short_skirts_with_high_waists_can_be_cut():
    """Lengths range from 30 cm and rises to 29, and a skirt needs 5 cm below the crotch."""
    marks = Landmarks.of(default_body())
    sheet = Sheet(longest("skirt", {}, marks), *(np.zeros((0, 3)) for _ in range(5)), marks)
    for corner in product(*ranges("skirt", marks).values()):
        style = Skirt(**dict(zip(ranges("skirt", marks), corner, strict=True)))
        cut = cuttable(style)
        cut.cut(marks)  # raises where a length does not fit the body
        assert cut.rise == style.rise and cut.length in (style.length, style.rise + BELOW)
        template.refined_lengths(Scored(sheet), style, np.inf)[1].cut(marks)
        template.Judge(sheet, [], Borders(hem=marks.crotch)).ended(style).cut(marks)
    drawn = list(styles_of(sheet, 1000, np.random.default_rng(0)))
    min(drawn, key=lambda style: style.length - style.rise).cut(marks)


def test_a_scan_without_the_garment_says_so(scene):
    cloud, placed = scene
    bare = Cloud("bare", cloud.points, cloud.normals, np.where(cloud.labels == 2, 0, cloud.labels))
    with pytest.raises(CaphyError, match="bare: has no points labelled lower"):
        Target.of(bare, placed, "lower")


def test_the_plainest_pose_is_the_t_or_the_a():
    poses = plain_poses()
    bent = np.zeros((55, 3))
    bent[1, 0], bent[4, 0], bent[16, 1] = -1.2, 1.5, 0.7
    others = [type(poses[0]).of(bent * share, np.zeros(3)) for share in (1.0, 0.6)]
    assert template.plainest([others[0], poses[5], others[1]], 2) == [1, 2]
