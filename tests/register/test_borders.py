"""Where cloth ends, on scans of garments that slid off the place where they were cut."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from dressed_scans import GARMENTS, Subject, look

from caphy.body.bundled import default_body
from caphy.body.surface import Surface
from caphy.garment.families import Skirt, Tshirt, default_rise, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register.articulation import Figure
from caphy.register.borders import LEAST_SCANS, Borders, Ends
from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.register.starts import plain_poses
from caphy.register.styles import longest, seen_lengths

SLID = np.array([0.025, 0.0, 0.0])
"""How the shirt slid to its left [m]."""


def bundled(name: str) -> Garment:
    return Garment.load(GARMENTS / f"{name}.npz")


def slid(garment: Garment) -> Garment:
    """A garment moved sideways on the T-posed body, and out of it where it would enter."""
    body = default_body()
    surface, vertices = Surface.of(body.faces, body.v_template), garment.vertices + SLID
    for _ in range(3):
        near = surface.nearest(vertices, body.v_template)
        vertices = vertices + np.maximum(0.006 - near.distance, 0)[:, None] * near.normal
    return replace(garment, vertices=vertices)


def seen(garments: list[Garment]) -> list[Target]:
    """A T- and an A-pose of the mean body in garments, as often as it takes for ends to be read off."""
    body, found = default_body(), []
    person = Subject(body, np.zeros(10), np.zeros_like(body.v_template), garments)
    for i, place in enumerate(plain_poses()[:2]):
        sight = look(person, place.pose, place.transl, i, 24000)
        cloud = Cloud(f"scan{i}", sight.points, sight.normals, sight.labels)
        found.append(Target.of(cloud, Figure.of(body).placed(place), "upper"))
    return found * (LEAST_SCANS // 2)


@pytest.fixture(scope="module")
def marks() -> Landmarks:
    return Landmarks.of(default_body())


@pytest.fixture(scope="module")
def shirt_and_trousers() -> list[Target]:
    return seen([slid(bundled("tshirt")), bundled("trousers")])


def relabelled(targets: list[Target], change: Callable[[Cloud], Cloud]) -> list[Target]:
    return [replace(target, scan=change(target.scan)) for target in targets]


def test_a_shirt_that_slid_to_one_side_ends_where_it_was_cut(shirt_and_trousers, marks):
    borders = Borders.of(shirt_and_trousers, marks)
    lengths = seen_lengths(longest("tshirt", {}, marks), borders, marks)
    arm = np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder"))
    assert lengths["sleeve"] == pytest.approx(0.4 * arm, abs=0.015)
    assert lengths["length"] == pytest.approx(marks.joint("neck")[1] - marks.crotch - 0.03, abs=0.015)


def test_trouser_legs_end_where_they_were_cut(shirt_and_trousers, marks):
    borders = Borders.of([replace(target, kind="lower") for target in shirt_and_trousers], marks)
    lengths = seen_lengths(longest("trousers", {}, marks), borders, marks)
    assert borders.cuff is None
    assert lengths == {"leg": pytest.approx(0.92 * (marks.crotch - marks.joint("left_ankle")[1]), abs=0.01)}


def test_a_shirt_without_sleeves_ends_at_the_shoulder(shirt_and_trousers, marks):
    def bare_arms(scan: Cloud) -> Cloud:
        arm = np.abs(scan.points[:, 0]) > marks.joint("left_shoulder")[0] - 0.06
        return replace(scan, labels=np.where(arm, 0, scan.labels))

    borders = Borders.of(relabelled(shirt_and_trousers, bare_arms), marks)
    assert borders.cuff is not None and borders.cuff < 0.03


@pytest.mark.parametrize(("length", "flare"), [(0.37, 0.2), (0.51, 0.35)])
def test_a_skirt_ends_where_it_does_or_nowhere(marks, length, flare):
    """The last of its cloth that lies near the legs is up to 33 cm above its hem where the rest stands off."""
    skirt = make(Skirt(length=length, flare=flare), marks.body)
    targets = [replace(target, kind="lower") for target in seen([bundled("tshirt"), skirt])]
    hem = marks.crotch + default_rise(marks) - length
    ends = np.array([loop.along for target in targets[:2] for loop in Ends.of(target, marks).hems.values()])
    assert Borders.of(targets, marks).hem is None
    assert np.abs(-hem - ends[np.isfinite(ends)]).max(initial=0.0) < 0.015
    assert np.isfinite(ends).any() == (flare == 0.2)


def test_what_no_scan_shows_is_unknown(shirt_and_trousers, marks):
    def legs(scan: Cloud) -> Cloud:
        below = scan.points[:, 1] < marks.armpit - 0.3
        return Cloud(scan.name, scan.points[below], scan.normals[below], scan.labels[below])

    borders = Borders.of(relabelled(shirt_and_trousers[::2], legs) * 2, marks)
    assert borders.cuff is None and borders.hem is not None


def test_few_scans_say_nothing(shirt_and_trousers, marks):
    assert Borders.of(shirt_and_trousers[1:], marks) == Borders()


def test_a_shirt_that_slid_to_one_side_is_no_longer_than_one_that_did_not(marks):
    """Each of its sides differs by 2 cm. One with sleeves and hem 3 cm longer reaches farther by most of that: a hem
    that stands off is carried to the thighs slantwise."""
    wide = Tshirt(length=0.62, sleeve=0.18, edge_length=0.03)
    plain, longer, slid_aside = (
        Ends.of(seen([garment])[0], marks)
        for garment in (
            make(wide, marks.body),
            make(replace(wide, length=0.65, sleeve=0.21), marks.body),
            slid(make(wide, marks.body)),
        )
    )
    sides = [np.nanmean(slid_aside.cuffs[side].along - plain.cuffs[side].along) for side in (1.0, -1.0)]
    assert sides[0] > 0.015 and sides[1] < -0.015
    assert slid_aside.beyond(plain) == pytest.approx((0.0, 0.0), abs=0.005)
    assert longer.beyond(plain) == pytest.approx((0.027, 0.027), abs=0.004)
    assert plain.beyond(replace(plain, cuffs={1.0: plain.cuffs[1.0]})) == (None, 0.0)  # one arm alone tells nothing
