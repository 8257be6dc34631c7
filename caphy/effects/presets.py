"""Ready-made models: SNUG's cotton and the measured fabrics, worn on a body."""

from __future__ import annotations

from caphy.effects.model import Model
from caphy.material.fabrics import fabric

WORN = {"gravity": {}, "inertia": {}, "body_contact": {}, "attachment": {}}
"""What acts on every worn garment besides its elasticity."""


def snug_model() -> Model:
    """SNUG's cotton: 426 kg/m^3 at 0.47 mm, lambda 20.9 and mu 11.1 N/m, bending 3.96e-5 N m.

    Source: Santesteban, Otaduy, Casas, SNUG, CVPR 2022, supplementary material.
    """
    return Model(426 * 0.47e-3, {"strain_stvk": {}, "bending": {}, **WORN})


def fabric_model(name: str) -> Model:
    """A measured fabric by name (:func:`caphy.material.fabrics.fabric_names`)."""
    cloth = fabric(name)
    elastic = {"strain_measured": {"stretching": cloth.stretching}, "bending_measured": {"bending": cloth.bending}}
    return Model(cloth.density, {**elastic, **WORN})
