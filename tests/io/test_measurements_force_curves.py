"""Tensile tests: the real knit table against the strains its authors' summary gives, and clear errors."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from caphy.errors import CaphyError
from caphy.io.measurements import read_force_curves


def test_knit_curves_agree_with_the_published_summary(shared_data):
    curves = read_force_curves(shared_data / "fabric_tests" / "knit_uniaxial.csv")
    with (shared_data / "fabric_tests" / "knit_uniaxial_summary.csv").open(newline="") as file:
        summary = {(row["sample"], row["video"]): row for row in csv.DictReader(file)}
    assert len(curves) == len(summary) == 40
    assert {curve.direction for curve in curves} == {"weft", "warp"}
    off = []
    for curve in curves:
        axis = "X" if curve.direction == "weft" else "Y"
        row = summary[f"{curve.fabric}_{axis}", f"video{curve.loading}"]
        for force in (50, 100, 200):
            for name, values in (("gauge", curve.axial), ("transverse", curve.transverse)):
                expected = float(row[f"{name}_strain_at_{force}Npm"] or "nan")
                if np.isfinite(expected):
                    off.append(np.interp(force, np.maximum.accumulate(curve.force), values) - expected)
    assert len(off) > 200
    # Lengths at rest are known to half a per cent, and a load cell's ripple moves the crossing by as much.
    assert np.median(np.abs(off)) < 0.005
    assert np.quantile(np.abs(off), 0.95) < 0.03


def test_plain_table(tmp_path):
    path = tmp_path / "denim.csv"
    path.write_text("loading,axial_strain,force_per_width_N_per_m\n1,0,0\n1,0.1,5\n1,0.2,11\n2,0,0\n2,0.1,4\n2,0.2,9\n")
    first, second = read_force_curves(path)
    assert (first.fabric, first.direction, first.loading, second.loading) == ("denim", "weft", 1, 2)
    np.testing.assert_array_equal(second.force, [0, 4, 9])
    assert np.isnan(first.transverse).all()


def test_a_strip_that_is_let_go_and_cells_that_are_empty(tmp_path):
    path = tmp_path / "linen.csv"
    head = "axial_strain,transverse_strain,force_per_width_N_per_m\n"
    path.write_text(head + "0,,0,\n0.1,-0.02,5,\n0.2,,11,\n0.1,-0.01,4,\n0,0,0,\n")
    (curve,) = read_force_curves(path)
    np.testing.assert_array_equal(curve.transverse, [np.nan, -0.02, np.nan, -0.01, 0])
    assert len(curve.force) == 5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("axial_strain,force_per_width_N_per_m\n0,0\n5,1\n20,2\n", "divide percent by 100"),
        ("axial_strain,force_per_width_N_per_m\n0,0\nx,1\n1,2\n", "line 3: axial_strain must be a number, got 'x'"),
        ("strain,force\n0,0\n", "needs the columns"),
        ("axial_strain,axial_strain,force_per_width_N_per_m\n0,0,0\n", "'axial_strain' is there twice"),
        ("axial_strain,transverse_strain,force_per_width_N_per_m\n0,0,0\n.1,-4,1\n.2,-8,2\n", "transverse.*got 8;"),
        ("axial_strain,force_per_width_N_per_m\n0,0\n1,1\n3.75,2\n", "divide percent by 100"),
        (
            "Direction,axial_strain,force_per_width_N_per_m\nwarp,0,0\nwarp,0.1,1\nwarp,0.2,2\n",
            "nobody reads the column 'Direction'; the columns are fabric, direction,",
        ),
        ("axial_strain,force_per_width_N_per_m\n", "header and rows"),
        (
            "axial_strain,force_per_width_N_per_m\n0,0,0,0\n0,05,1,2\n0,1,2,4\n",
            "line 2 has more cells than the first line names",
        ),
        (
            "axial_strain,force_per_width_N_per_m\n0,0\n.1,1\n.2,2\n0,0\n.1,3\n.2,6\n",
            "bad weft, loading 1: its strain falls and rises again by 0.2",
        ),
        (
            "axial_strain,force_per_width_N_per_m\n0,0\n.1,1\n.2,2\n0,0\n.1,3\n.21,6\n",
            "more than one loading; number them",
        ),
        (
            'axial_strain,force_per_width_N_per_m\n0,0\n"' + 20000 * "0.1,10\n",
            "bad.csv: line 3: field larger than .* is a quotation mark left open there",
        ),
        (
            "axial_strain,transverse_strain,force_per_width_N_per_m\n0,0,0\n.5,-.6,1\n1,-1.25,2\n",
            "transverse strains must be above -1, .* got -1.25; divide percent by 100",
        ),
        ("axial_strain,force_per_width_N_per_m\n0,0\n-.5,1\n-1,2\n", "axial strains must be above -1, .* got -1;"),
        (
            "axial_strain,transverse_strain,force_per_width_N_per_m\n0,0,0\n.015,,1\n.02,-.6,1\n.025,-.75,2\n",
            "transverse strains must be at most 5 times .* got 30 times .*; percent beside fractions",
        ),
        (
            "axial_strain,force_per_width_N_per_m\n0,0\n\nnan,1\n",
            "line 4: axial_strain must be finite, got 'nan'",
        ),
        ("direction,axial_strain,force_per_width_N_per_m\nup,0,0\nup,0.1,1\nup,0.2,2\n", "'weft' or 'warp', got 'up'"),
    ],
)
def test_what_is_wrong_with_a_table_is_told(tmp_path, text, says):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(CaphyError, match=says):
        read_force_curves(path)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"gauge_len_mm": "0"}, "line 4: gauge_len_mm must be a length above 0 .mm., got '0'"),
        ({"gauge_len_mm": "-91.6"}, "line 4: gauge_len_mm must be a length above 0 .mm., got '-91.6'"),
        ({"pin_transverse_mm": "0"}, "line 4: pin_transverse_mm must be a length above 0"),
        ({"gauge_len_mm": "nan"}, "line 4: gauge_len_mm must be finite, got 'nan'"),
        ({"video": "video0"}, "line 4: the number in video must be 1 for the first loading .* got '0'"),
    ],
)
def test_what_is_wrong_with_a_table_of_knits_is_told(tmp_path, changed, says):
    rows = [
        {"sample": "rib_X", "video": "video1", "force_per_width_N_per_m": f"{20 * k}", "gauge_len_mm": f"{90 + k}",
         "pin_transverse_mm": f"{50 - k}"} for k in range(4)
    ]  # fmt: skip
    path = tmp_path / "knit.csv"
    for last, error in (({}, None), (changed, says)):
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows([*rows[:2], rows[2] | last, rows[3]])
        if error is None:
            assert read_force_curves(path)[0].loading == 1
        else:
            with pytest.raises(CaphyError, match=error):
                read_force_curves(path)
