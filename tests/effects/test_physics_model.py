"""A model checks what it is given, in words a user can act on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from caphy.effects.base import BodyState
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import fabric_model, snug_model
from caphy.effects.trial import irregular_cloth, moment
from caphy.errors import CaphyError
from caphy.material.fabrics import fabric, fabric_names


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"strain_stvk": {"mu": 1.0}}, "strain_stvk has no parameter 'mu'; it has: lame_lambda, lame_mu"),
        ({"strain_stvk": {"lame_mu": -1.0}}, r"lame_mu must lie in \[0, 100000\] N/m, got -1"),
        ({"gravity": {"acceleration": 9.81}}, r"acceleration must have shape \(3,\), got \(\)"),
        ({"body_friction": {}}, "body_friction needs body_contact in the same model"),
        ({"xyz": {}}, "there is no effect 'xyz'; known"),
        ({"pressur": {}}, r"'pressur' \(did you mean pressure\?\); known"),
    ],
)
def test_wrong_values_are_refused(effects: dict[str, Any], message: str) -> None:
    with pytest.raises(CaphyError, match=message):
        Model(0.2, effects)


@pytest.mark.parametrize("density", [0.0, -1.0, float("nan")])
def test_density_must_be_positive(density: float) -> None:
    with pytest.raises(CaphyError, match="density must be positive"):
        Model(density)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"density_kg_per_m2": 0.2, "effects": {"gravity": 3}}',
        '{"density_kg_per_m2": 0.2, "effects": {"gravity": null}}',
        '{"density_kg_per_m2": [0.2], "effects": {}}',
        "[" * 100_000,
        '{"density_kg_per_m2": 0.2, "effects": {}, "colour": "red"}',
        '{"density_kg_per_m2": true, "effects": {}}',
        '{"density_kg_per_m2": "0.2", "effects": {}}',
        '{"density_kg_per_m2": 200, "effects": {}}',
        '{"density_kg_per_m2": 0.2, "effects": {}, "schema": 9}',
        '{"density_kg_per_m2": 0.2, "effects": {"gravity": {}, "inertia": {}, "extra_mass": {"density": -0.2}}}',
        '{"density_kg_per_m2": 0.2, "effects": {"inertia": {}, "inertia": {}}}',
        '{"density_kg_per_m2": 0.2, "effects": {"strain_stvk": {"lame_mu": true}}}',
        '{"density_kg_per_m2": 0.2, "effects": {"strain_stvk": {"lame_mu": "20"}}}',
    ],
)
def test_a_broken_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(CaphyError, match=r"model\.json"):
        Model.load(path)


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text(snug_model().to_json(), encoding="utf-8-sig")
    assert Model.load(tmp_path / "model.json") == snug_model()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaphyError, match="cannot be read"):
        Model.load(tmp_path / "none.json")


def test_effects_are_added_and_taken_away() -> None:
    model = snug_model().with_effect("air_drag_normal", coefficient=3.0)
    assert model.effects["air_drag_normal"]["coefficient"] == 3.0
    assert "air_drag_normal" not in model.without_effect("air_drag_normal").effects


def test_snug_cotton_has_its_published_figures() -> None:
    """To the three digits that are printed."""
    model = snug_model()
    assert model.density == pytest.approx(0.2002, abs=1e-4)
    young, poisson, thickness = 0.7e5, 0.485, 0.47e-3
    lame_mu = young / (2 * (1 + poisson)) * thickness
    assert model.effects["strain_stvk"]["lame_mu"] == pytest.approx(lame_mu, abs=0.05)
    plane = young * poisson / (1 - poisson**2) * thickness  # plane stress
    assert model.effects["strain_stvk"]["lame_lambda"] == pytest.approx(plane, abs=0.05)


@pytest.mark.parametrize("name", fabric_names())
def test_fabric_models_carry_the_measurement(name: str) -> None:
    model, measured = fabric_model(name), fabric(name)
    assert model.density == measured.density
    assert (model.effects["strain_measured"]["stretching"] == measured.stretching).all()
    assert (model.effects["bending_measured"]["bending"] == measured.bending).all()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[1, 2]", "it is no object in braces"),
        ('{"density_kg_per_m2": 0.2, "effects": ["gravity"]}', r"effects must be an object, got \["),
        ('{"density_kg_per_m2": 0.2, "effects": {}, "history": 5}', "history must be a list, got 5"),
    ],
)
def test_json_of_another_shape_is_told_so(text, says):
    with pytest.raises(CaphyError, match=f"not a physics model .*{says}"):
        Model.from_json(text)


def test_contact_cannot_be_taken_away_by_its_distance():
    """The push grows with the square of the distance: of none there would be none, at any depth."""
    with pytest.raises(CaphyError, match="distance"):
        Model(0.2, {"body_contact": {"distance": 0.0}})


@pytest.mark.parametrize("distance", [5e-4, 4e-3])
def test_no_thickness_is_no_effect(distance):
    cloth = irregular_cloth()
    at = moment(cloth)
    up = torch.zeros_like(at.x) + torch.tensor([0.0, 1.0, 0.0], dtype=at.x.dtype)
    inside = BodyState(at.x + 0.004 * up, up, torch.zeros_like(at.x), at.x)
    plain = Model(cloth.density, {"body_contact": {"distance": distance}})
    without, with_none = (
        Potential(model, cloth).gradient(at.x, at.step, inside)
        for model in (plain, plain.with_effect("contact_thickness", thickness=0.0))
    )
    assert all(torch.equal(one, other) for one, other in zip(without, with_none, strict=True))


@pytest.mark.parametrize("thickness", [-0.02, -0.01, -0.004])
def test_contact_nearer_than_its_distance_is_still_contact(thickness):
    """30 mm inside the body: contact of 4 mm begins 4 - t mm from the skin, and pushes where that is passed."""
    cloth = irregular_cloth()
    at = moment(cloth)
    up = torch.zeros_like(at.x) + torch.tensor([0.0, 1.0, 0.0], dtype=at.x.dtype)
    inside = BodyState(at.x + 0.03 * up, up, torch.zeros_like(at.x), at.x)
    model = Model(cloth.density, {"body_contact": {}, "contact_thickness": {"thickness": thickness}})
    _, gradient = Potential(model, cloth).gradient(at.x, at.step, inside)
    assert float(gradient[:, 1].max()) < 0
