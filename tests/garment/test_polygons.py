"""Polygons become triangles that cover them once, whatever their shape."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.garment.polygons import triangles
from caphy.garment.usermesh import clean_mesh, read_mesh

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def _area(flat: np.ndarray) -> float:
    """By the shoelace formula."""
    x, y = flat.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _cut(flat: np.ndarray, turn: np.ndarray = TURN) -> tuple[list, np.ndarray]:
    points = np.column_stack([flat, np.zeros(len(flat))]) @ turn.T + [1.0, -2.0, 0.5]
    (found,) = triangles(points, [list(range(len(flat)))])
    return found, np.array([_area(flat[list(each)]) for each in found])


def test_stars_are_covered_once():
    random = np.random.default_rng(0)
    for corners in range(4, 12):
        for _ in range(20):
            angle = 2 * np.pi * (np.arange(corners) + 0.8 * random.uniform(size=corners)) / corners
            radius = random.uniform(0.3, 1.0, corners)
            star = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
            found, areas = _cut(star)
            assert len(found) == corners - 2
            assert (areas > 0).all()  # none is folded over
            np.testing.assert_allclose(areas.sum(), _area(star), rtol=1e-9)


def test_what_a_fan_cuts_well_stays_a_fan():
    hexagon = np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3])
    assert _cut(hexagon)[0] == [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]


@pytest.mark.parametrize("first", range(4))
def test_a_corner_amid_a_side_makes_no_sliver(first):
    flat = np.roll([[0.0, 0.0], [0.5, 1e-7], [1.0, 0.0], [0.5, 0.8]], first, axis=0)
    _, areas = _cut(flat)
    assert areas.min() > 0.1


def test_a_polygon_that_crosses_itself_is_named(tmp_path: Path):
    path = tmp_path / "bow.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0 2 0\nv 1 2 0\nf 3 1 2 4\nf 3 4 5 6\n")
    with pytest.raises(CaphyError, match=r"face 1 with 4 corners cannot be cut into triangles \(1 such faces\)"):
        clean_mesh(read_mesh(path), triangulate=True)
    sheet = "".join(f"v {x} {y} 3\n" for y in (0, 1) for x in (0, 1)) + "f 7 8 10\nf 7 10 9\n"
    path.write_text(path.read_text() + sheet)
    assert len(clean_mesh(read_mesh(path), triangulate=True, component="1").faces) == 2  # another piece than the bow's


def test_lines_of_an_obj_may_be_continued(tmp_path: Path):
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 \\\n 2 3 \\\n4\nf 1 2 9\n")
    with pytest.raises(CaphyError, match="refers to vertex 9"):
        read_mesh(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 \\\n 2 3 \\\n4\nx\nf 1 2\n")
    with pytest.raises(CaphyError, match="line 9"):
        read_mesh(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 \\\n 2 3 \\\n4\n")
    assert read_mesh(path).polygons == [[0, 1, 2, 3]]
