"""The measured tables and what is read from them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from published_stretching import stretching_stiffness

from caphy.errors import CaphyError
from caphy.material.fabrics import bending_stiffness, fabric, fabric_names


def test_there_are_ten_and_each_says_where_it_comes_from() -> None:
    assert len(fabric_names()) == 10
    for name in fabric_names():
        cloth = fabric(name)
        assert cloth.stretching.shape == (6, 4) and cloth.bending.shape == (3, 5)
        assert 0.1 < cloth.density < 0.4 and "Wang" in cloth.source


def test_an_unknown_fabric_is_refused_with_the_known_names() -> None:
    with pytest.raises(CaphyError, match=r"no measured fabric 'denim'; known: 11oz-black-denim"):
        fabric("denim")


def test_figures_are_the_published_ones(shared_data: Path) -> None:
    for name in fabric_names():
        published = json.loads((shared_data / "fabric_materials" / f"{name}.json").read_text())
        cloth = fabric(name)
        assert cloth.density == published["density"]
        np.testing.assert_array_equal(cloth.stretching, published["stretching"])
        np.testing.assert_array_equal(cloth.bending, published["bending"])


def test_stretching_is_the_published_evaluation(shared_data: Path) -> None:
    """Within 1e-4 of the 110 values computed by running ARCSim's own source."""
    with (shared_data / "fabric_materials" / "reference_values.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 110
    for row in rows:
        strain = np.array([float(row[key]) for key in ("G_uu", "G_vv", "G_uv")])
        wanted = [float(row[f"k{i}_direct"]) for i in range(4)]
        np.testing.assert_allclose(
            stretching_stiffness(fabric(row["material"]).stretching, strain), wanted, rtol=1e-4, atol=1e-9
        )


def test_stretching_takes_many_strains_at_once() -> None:
    table = fabric("gray-interlock").stretching
    strains = np.random.default_rng(0).uniform(-0.1, 0.3, (4, 5, 3))
    together = stretching_stiffness(table, strains)
    for index in np.ndindex(4, 5):
        np.testing.assert_array_equal(together[index], stretching_stiffness(table, strains[index]))


def test_bending_meets_its_table() -> None:
    table = fabric("pink-ribbon-brown").bending
    for i, degrees in enumerate((0, 45, 90)):
        for j, curvature in enumerate((0, 5, 10, 15, 20)):
            for angle in (np.deg2rad(degrees), -np.deg2rad(degrees), np.pi - np.deg2rad(degrees)):
                assert bending_stiffness(table, angle, -curvature) == pytest.approx(table[i, j], rel=1e-9)
    assert bending_stiffness(table, 0.0, 1000.0) == pytest.approx(table[0, 4])
    assert bending_stiffness(table, np.pi / 8, 2.5) == pytest.approx(table[:2, :2].mean())
