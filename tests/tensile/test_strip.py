"""Tabulated curves against the strip's balance solved by hand."""

from __future__ import annotations

import numpy as np
import pytest
from closed_form import Sheet
from scipy.interpolate import CubicHermiteSpline

from caphy.effects import registry
from caphy.effects.base import Parameter
from caphy.effects.membrane import Membrane, square
from caphy.effects.model import Model
from caphy.effects.presets import fabric_model
from caphy.material.fabrics import fabric_names
from caphy.measure.uniaxial import _strip_energy, model_curve
from caphy.tensile.candidates import candidates
from caphy.tensile.strip import Strip, _least

STRAIN = np.linspace(0, 0.3, 31)
STVK = {"strain_stvk": {"lame_lambda": 20.0, "lame_mu": 15.0}}


def said(direction: str, **effects: dict):
    model = Model(0.2, {**STVK, **effects})
    return Strip(STRAIN, direction).curve(model, tuple(model.effects))


@pytest.mark.parametrize("direction", ["weft", "warp"])
def test_a_stiffening_orthotropic_strip(direction):
    force, narrow = Sheet(90.0, 45.0, 20.0, fourth=800.0).curve(STRAIN, direction)
    curve = said(direction, weft_warp_stiffness={"weft": 40.0, "warp": -5.0}, strain_stiffening={"stiffness": 800.0})
    np.testing.assert_allclose(curve.transverse, narrow, atol=2e-5)
    np.testing.assert_allclose(curve.force, force, rtol=2e-4, atol=2e-3)


class Doubled(Membrane):
    """What softening took, once more [J] per face."""

    name = "doubled"
    parameters = {"factor": Parameter(1.0, "1", doc="how often")}
    reference = "a test's own"
    borrows = ("softening",)

    def density(self, strain, e, p):
        return -p["factor"] * p["softening.share"] * square(strain)


def test_what_is_borrowed_may_borrow_itself(monkeypatch):
    monkeypatch.setattr(registry, "_from_files", {"doubled": Doubled})
    strip, effects = Strip(STRAIN, "weft"), {**STVK, "softening": {}}
    twice = strip.table(Model(0.2, {**effects, "doubled": {"factor": 2.0}}), "doubled")
    np.testing.assert_allclose(twice, 2 * strip.table(Model(0.2, {**effects, "doubled": {}}), "doubled"))
    assert np.abs(twice).max() > 0
    assert "doubled" in candidates(Model(0.2, effects)).added


def test_friction_along_the_path():
    """The path is taken from the balance without friction at first, so its start is coarse in narrowing."""
    fine = np.linspace(0, 0.3, 301)
    force, narrow = Sheet(50.0, 50.0, 20.0, friction=2.0).curve(fine, "weft")
    curve = said("weft", hysteresis={"friction": 2.0})
    np.testing.assert_allclose(curve.force[2:], force[20::10], rtol=0.02)
    np.testing.assert_allclose(curve.transverse[6:], narrow[60::10], atol=3e-3)


@pytest.mark.parametrize("direction", ["weft", "warp"])
@pytest.mark.parametrize("name", fabric_names())
def test_measured_fabrics_as_compared(name, direction):
    """The same curve as ``caphy compare`` draws, which searches the balance without tables, and as trying every
    transverse stretch finds: pulled along the warp, the rib knit of this table widens as much as it lengthens, into a
    well of its energy that is narrower than a hundredth of stretch."""
    model, strain = fabric_model(name), np.linspace(0, 0.2, 49)
    slow = model_curve(model, strain, direction)
    quick = Strip(strain, direction).curve(model, ("strain_measured",))
    np.testing.assert_allclose(quick.force, slow.force, rtol=5e-3, atol=0.02)
    np.testing.assert_allclose(quick.transverse, slow.transverse, atol=2e-3)
    energy, tried = _strip_energy(model, direction), np.arange(0.6, 1.3, 2e-5)
    least = [tried[energy(np.full_like(tried, 1 + along), tried).argmin()] - 1 for along in strain[::8]]
    np.testing.assert_allclose(slow.transverse[::8], least, atol=1e-4)


def test_softening_takes_its_share_and_gives_it_back():
    """Stress (1 - s (1 - W / W_m)) of the first loading's at equal narrowing, all of it from W_m on."""
    first = said("weft")
    work = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(STRAIN) * (first.force[1:] + first.force[:-1]))])
    again = said("weft", softening={"share": 0.3, "reach": float(work[20])})
    share = np.where(work < work[20], 1 - 0.3 * (1 - work / work[20]), 1.0)
    np.testing.assert_allclose(again.force, share * first.force, rtol=2e-3, atol=1e-3)


def test_which_effects_a_slow_pull_shows():
    """Told by trying: in the plane, independent of size and rate, without force at no load."""
    found = candidates(Model(0.2, STVK))
    assert set(found.added) == {"hysteresis", "softening", "strain_stiffening", "weft_warp_stiffness"}
    reasons = {
        "gravity": "outside",
        "bending": "does not change",
        "shear_stiffness": "does not change",
        "seam_stiffness": "edges",
        "viscous_damping": "rate",
        "shrinkage": "no load",
    }
    for name, word in reasons.items():
        assert word in found.unseen[name]


@pytest.mark.parametrize("ends", [(1, 1, 0, 1), (0, -1, 0, 1), (0, 1, 1, 1), (1, 0, 0, 0)])
def test_the_least_of_a_cubic_between_two_nodes(ends):
    """Of value and slope at 2 and at 2.5, against trying every place."""
    low, rising, high, rises = ends
    cubic, tried = CubicHermiteSpline([2.0, 2.5], [low, high], [rising, rises]), np.linspace(2, 2.5, 100_001)
    at, value = _least(*(np.array([each]) for each in (2.0, low, rising, 2.5, high, rises)))
    assert value[0] == pytest.approx(cubic(tried).min(), abs=1e-9)
    assert cubic(at[0]) == pytest.approx(value[0], abs=1e-12)
