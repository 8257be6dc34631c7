"""The picture of what was told over what was hidden."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from benchmarks.diagnosis_picture import drawn, told


def case(hidden: str, effects: dict, found: list[str], numbers: dict[str, tuple[float, float, float]]) -> dict:
    """A row of the benchmark with what the picture reads; numbers are value, low, high."""
    coefficients = {name: dict(zip(("value", "low", "high"), three, strict=True)) for name, three in numbers.items()}
    diagnosis = {"found": found, "coefficients": coefficients}
    return {"kind": "one", "hidden": hidden, "answer": {"effects": effects}, "diagnosis": diagnosis}


def drag(value: float, low: float, high: float, found: str = "air_drag_normal") -> dict:
    effects = {"air_drag_normal": {"coefficient": 0.5}}
    return case("air_drag_normal", effects, [found], {"air_drag_normal.coefficient": (value, low, high)})


def test_numbers_are_divided_by_the_hidden_ones():
    (one,) = told(drag(0.4, 0.3, 0.6))
    assert (one.ratio, one.low, one.high) == pytest.approx((0.8, 0.6, 1.2)) and one.covered
    (missed,) = told(drag(0.4, 0.3, 0.45))
    assert not missed.covered
    curved = {"natural_curvature": {"curvature": -4.0}}
    (negative,) = told(case("natural_curvature", curved, [], {"natural_curvature.curvature": (-3.0, -5.0, -1.0)}))
    assert (negative.ratio, negative.low, negative.high) == pytest.approx((0.75, 0.25, 1.25)) and negative.covered


def test_of_a_vector_the_part_along_the_hidden_one_counts_and_all_intervals_must_cover():
    names = [f"uniform_acceleration.acceleration[{i}]" for i in range(3)]
    effects = {"uniform_acceleration": {"acceleration": [0.6, 0.0, -0.8]}}
    numbers = dict(zip(names, [(0.6, 0.5, 0.7), (0.3, 0.2, 0.4), (-0.8, -0.9, -0.7)], strict=True))
    (one,) = told(case("uniform_acceleration", effects, ["uniform_acceleration"], numbers))
    assert one.ratio == pytest.approx(1.0) and not one.covered


def test_a_dot_for_each_that_was_named_alone_and_a_cross_for_the_others():
    picture = drawn({"one set": [drag(0.4, 0.3, 0.6), drag(0.4, 0.3, 0.45), drag(0.4, 0.3, 0.6, "mass_damping")]})
    svg = ElementTree.fromstring(picture)
    dots = [each.get("class") for each in svg.iter("{http://www.w3.org/2000/svg}circle")]
    crosses = [each for each in svg.iter("{http://www.w3.org/2000/svg}path") if each.get("class") == "cross"]
    assert dots == ["covered", "missed"] and len(crosses) == 1
    assert "2 of 3 named alone" in picture and "air drag normal" in picture
