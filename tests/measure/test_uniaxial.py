"""Tensile tests of models against closed forms, and the real knits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.effects.model import Model
from caphy.effects.presets import fabric_model
from caphy.io.measurements import ForceCurve, read_force_curves
from caphy.measure.uniaxial import at_edges, compare_curve, compare_curves, curve_sentences, model_curve


def stvk(lame_lambda: float, lame_mu: float) -> Model:
    values = {"lame_lambda": lame_lambda, "lame_mu": lame_mu}
    return Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": values})


@pytest.mark.parametrize("direction", ["weft", "warp"])
def test_an_isotropic_sheet_follows_its_closed_form(direction):
    """dW/dG across = 0 gives G_t = -lambda/(lambda + 2 mu) G_a, and force per width (1 + e) E_2d G_a."""
    lam, mu = 20.0, 15.0
    axial = np.linspace(0, 0.3, 7)
    green = axial + 0.5 * axial**2
    across = -lam / (lam + 2 * mu) * green
    said = model_curve(stvk(lam, mu), axial, direction)
    np.testing.assert_allclose(said.transverse, np.sqrt(1 + 2 * across) - 1, atol=1e-6)
    modulus = 4 * mu * (lam + mu) / (lam + 2 * mu)
    np.testing.assert_allclose(said.force, (1 + axial) * modulus * green, rtol=1e-5, atol=1e-6)


def test_real_knits_stiffen_and_differ_between_directions(shared_data):
    curves = read_force_curves(shared_data / "fabric_tests" / "knit_uniaxial.csv")
    rows = [compare_curve(stvk(20.9, 11.1), curve) for curve in curves]
    assert all(np.isfinite(row["rms_n_per_m"]) for row in rows)
    assert "Weft and warp differ" in " ".join(curve_sentences(rows))
    own = [row["measured"] for row in rows]
    exact = compare_curve(stvk(20.9, 11.1), curves[0])
    assert exact["relative_error"] > 0.1
    assert len(own[0]["force"]) <= 120


def test_rounding_is_neither_too_stiff_nor_too_soft():
    """Of a model's own curve, and of one that is 2 % off at most; of one that stiffens it is said."""
    axial, model = np.linspace(0, 0.25, 60), stvk(20.9, 11.1)
    own = model_curve(model, axial, "weft")
    for off, says in ((0.0, 1), (1e-4, 1), (0.02, 1), (0.2, 2)):
        curve = ForceCurve("mine", "weft", 1, axial, own.transverse, (1 - off * axial / 0.25) * own.force, "mine.csv")
        said = curve_sentences([compare_curve(model, curve)])
        assert len(said) == says and "over 1 loading," in said[0]


@pytest.mark.parametrize(
    ("offs", "says"),
    [((0.2, 0.2), "in both loadings"), ((0.2,) * 3, "in all 3 loadings"), ((0.2,) * 4 + (0,), "4 of 5")],
)
def test_how_many_loadings_say_so_is_counted(offs, says):
    """Of two it was in "four of five or more"."""
    axial, model = np.linspace(0, 0.25, 60), stvk(20.9, 11.1)
    own = model_curve(model, axial, "weft")
    forces = [(1 - off * axial / 0.25) * own.force for off in offs]
    rows = [
        compare_curve(model, ForceCurve("mine", "weft", i + 1, axial, own.transverse, force, "mine.csv"))
        for i, force in enumerate(forces)
    ]
    assert any("too stiff at large strains" in said and says in said for said in curve_sentences(rows))


def test_it_is_the_same_whichever_way_rows_run():
    axial = np.linspace(0, 0.25, 60)
    pulled = {"weft": 900.0 * axial, "warp": 520.0 * axial}
    curves = [ForceCurve("mine", way, 1, axial, -0.3 * axial, force, "mine.csv") for way, force in pulled.items()]
    turned = [replace(c, axial=c.axial[::-1], transverse=c.transverse[::-1], force=c.force[::-1]) for c in curves]
    said, again = (curve_sentences([compare_curve(stvk(20.9, 11.1), c) for c in each]) for each in (curves, turned))
    assert said == again and "Weft and warp differ" in said[-1]


@pytest.mark.parametrize("mass", ["extra_mass", "heavy_hem"])
def test_weight_does_not_pull_the_strip(mass):
    axial = np.linspace(0, 0.2, 3)
    heavy = stvk(20.9, 11.1).with_effect(mass)
    for direction in ("weft", "warp"):
        said, light = (model_curve(model, axial, direction) for model in (heavy, stvk(20.9, 11.1)))
        np.testing.assert_allclose(said.force, light.force, rtol=1e-12)
        np.testing.assert_allclose(said.transverse, light.transverse, rtol=1e-12)


@pytest.mark.parametrize("seam", ["seam_stiffness", "seam_tension"])
def test_seams_do_not_pull_the_strip_and_are_told(seam):
    """How much they would depends on the strip's width, which a force per width does not know."""
    axial = np.linspace(0, 0.2, 5)
    plain, sewn = stvk(20.9, 11.1), stvk(20.9, 11.1).with_effect(seam)
    said, known = model_curve(sewn, axial, "weft"), model_curve(plain, axial, "weft")
    np.testing.assert_allclose(said.force, known.force, rtol=1e-12)
    np.testing.assert_allclose(said.transverse, known.transverse, rtol=1e-12)
    curve = ForceCurve("mine", "weft", 1, axial, -0.3 * axial, 900.0 * axial, "mine.csv")
    told, before = (compare_curves(model, [curve], "mine", "mine.csv")["sentences"] for model in (sewn, plain))
    assert told[:-1] == before and told[-1].endswith(f"places do: {seam}.")


def test_only_what_acts_at_edges_is_left_out():
    """A measured fabric, whose stresses are its own, and all effects at once."""
    assert at_edges(fabric_model("gray-interlock")) == ()
    inside = {"shear_stiffness": {}, "weft_warp_stiffness": {}, "shrinkage": {}, "natural_curvature": {}, "bending": {}}
    assert at_edges(Model(0.2, {**stvk(20.9, 11.1).effects, **inside, "heavy_hem": {}, "extra_mass": {}})) == ()
