"""Effects tried as additions: nothing while switched off, and the columns that say what they would do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from caphy.effects.candidates import candidates, coefficients, switched_off, with_candidates
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term
from caphy.effects.presets import fabric_model, snug_model
from caphy.effects.registry import find_effect
from caphy.effects.trial import irregular_cloth, moment

CLOTH = irregular_cloth()
AT = moment(CLOTH)


@pytest.mark.parametrize("model", [snug_model(), fabric_model("gray-interlock")], ids=["snug", "measured"])
def test_candidates_change_nothing(model: Model) -> None:
    plain = Potential(model, CLOTH).gradient(AT.x, AT.step, AT.body)
    tried = with_candidates(model)
    assert len(tried.effects) > len(model.effects) + 25
    torch.testing.assert_close(Potential(tried, CLOTH).gradient(AT.x, AT.step, AT.body), plain, rtol=1e-12, atol=0)


def test_terms_add_up() -> None:
    potential = Potential(snug_model().with_effect("air_drag_normal"), CLOTH)
    at = moment(CLOTH, (2, 3))
    terms = potential.term_gradients(at.x, at.step, at.body)
    assert set(terms) == set(potential.terms)
    torch.testing.assert_close(sum(terms.values()), potential.gradient(at.x, at.step, at.body)[1])


@pytest.mark.parametrize("model", [snug_model(), fabric_model("gray-interlock")], ids=["snug", "measured"])
def test_columns_are_the_slopes_of_the_whole_gradient(model: Model) -> None:
    """Against differences of whole models, with the candidate at plus and minus a hundred-thousandth of its size."""
    tried = with_candidates(model)
    names = candidates(model)
    columns = Potential(tried, CLOTH).parameter_gradients(AT.x, AT.step, AT.body, coefficients(names))
    assert set(columns) == set(coefficients(names))
    for name in names:
        effect = find_effect(name)
        for key in effect.coefficients:
            default = np.asarray(effect.parameters[key].default, dtype=float)
            assert columns[f"{name}.{key}"].shape == (*default.shape, *AT.x.shape)
            place = np.unravel_index(np.abs(default).argmax(), default.shape)
            forces = []
            for size in (1e-5 * np.abs(default).max(), 0.0):
                values: dict[str, Any] = switched_off(name)
                values[key] = values[key].copy()
                values[key][place] = size
                alone = Potential(model.with_effect(name, **values), CLOTH)
                forces.append(alone.term_gradients(AT.x, AT.step, AT.body)[name])
            slope = (forces[0] - forces[1]) / (1e-5 * np.abs(default).max())
            scale = float(slope.abs().max())
            error = float((columns[f"{name}.{key}"][place] - slope).abs().max())
            assert scale > 0 and error < 1e-3 * scale, f"{name}.{key}: {error:g} of {scale:g}"


def test_a_lent_parameter_counts_where_it_is_borrowed() -> None:
    model = snug_model().with_effect("shrinkage", fraction=0.04).with_effect("contact_thickness")

    def gradient(**values: float) -> torch.Tensor:
        return Potential(model.with_effect("strain_stvk", **values), CLOTH).gradient(AT.x, AT.step, AT.body)[1]

    slope = Potential(model, CLOTH).parameter_gradients(AT.x, AT.step, AT.body, {"strain_stvk.lame_mu"})
    wanted = gradient(lame_mu=12.1) - gradient(lame_mu=11.1)
    assert list(slope) == ["strain_stvk.lame_mu"]
    torch.testing.assert_close(slope["strain_stvk.lame_mu"], wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("model", [snug_model(), fabric_model("gray-interlock")], ids=["snug", "measured"])
def test_what_is_switched_off_says_nothing_of_what_it_borrows(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not asked, which saves half of the time; asked, it says zero."""
    potential = Potential(with_candidates(model), CLOTH)
    quick = potential.parameter_gradients(AT.x, AT.step, AT.body)
    monkeypatch.setattr(Term, "is_off", False)
    whole = potential.parameter_gradients(AT.x, AT.step, AT.body)
    assert quick.keys() == whole.keys()
    for key, value in whole.items():
        torch.testing.assert_close(quick[key], value, rtol=1e-12, atol=0)


def test_slopes_of_large_stiffnesses_are_there_in_single_precision() -> None:
    """To a stiffness of 10^8 one more adds nothing there."""
    model, at = Model(0.2, {"body_contact": {"stiffness": 1e8}}), AT
    single = at.to(torch.float32)
    name = "body_contact.stiffness"
    (wanted,) = Potential(model, CLOTH).parameter_gradients(at.x, at.step, at.body, {name}).values()
    potential = Potential(model, CLOTH, torch.float32)
    (slope,) = potential.parameter_gradients(single.x, single.step, single.body, {name}).values()
    assert wanted.abs().max() > 0
    torch.testing.assert_close(slope.double(), wanted, rtol=1e-2, atol=1e-2 * float(wanted.abs().max()))


def test_slopes_of_a_batch_are_those_of_its_frames() -> None:
    potential = Potential(with_candidates(snug_model(), ["wind_field", "natural_curvature"]), CLOTH)
    at = moment(CLOTH, (3,))
    many = potential.parameter_gradients(at.x, at.step, at.body)
    for frame in range(3):
        one = at.frame(frame)
        for key, value in potential.parameter_gradients(one.x, one.step, one.body).items():
            torch.testing.assert_close(many[key].select(-3, frame), value)


def test_without_a_body_nothing_that_needs_one_is_tried() -> None:
    model = Model(0.2, {"strain_stvk": {}, "gravity": {}, "inertia": {}})
    assert "attachment" in candidates(model) and "attachment" not in candidates(model, on_body=False)
    assert "body_friction" not in candidates(model)  # there is no contact to lend its force
    assert "natural_curvature" not in candidates(model)  # nor bending
