"""What can be hidden in measurements: effects of the library alone and in pairs, forces from outside it, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from caphy.challenge.outside import FORCES
from caphy.challenge.swings import about_vertical
from caphy.effects.registry import find_effect

Verdict = Literal["named", "nothing", "parameters", "none of these"]

FORCED: Mapping[str, float] = {"tshirt": 4.0}
"""How much stronger forces are hidden where cloth lies on shoulders and arms: a drag moves a shirt by 1 to 2 cm."""


@dataclass(frozen=True)
class Hidden:
    """Something that acts on the cloth and that the user's model lacks.

    Attributes:
        name: what to call it.
        effects: effects of the library and their parameters; those the model has already are changed.
        outside: name of a force that is not in the library, or none.
        alike: for each effect, others that move cloth so similarly that naming them is not wrong.
        same_mesh: the truth is simulated on the user's mesh.
        scenes: where it acts; everywhere unless given.
        between: what else is drawn, "effect.parameter" -> lowest and highest value.
    """

    name: str
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    outside: str | None = None
    alike: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    same_mesh: bool = False
    scenes: tuple[str, ...] | None = None
    between: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def acts_in(self, scene: str) -> bool:
        """Whether it does anything there."""
        return self.scenes is None or scene in self.scenes

    def drawn(self, random: np.random.Generator, scene: str = "square") -> Hidden:
        """This effect with its strength drawn between 0.75 and 1.4 of its usual one, and wind from any side."""
        turn = about_vertical(random.uniform(0, 360))
        drawn = {
            name: _scaled(name, values, _usual(name, scene) * random.uniform(0.75, 1.4), turn)
            for name, values in self.effects.items()
        }
        for place, limits in self.between.items():
            name, key = place.split(".")
            drawn[name][key] = random.uniform(*limits)
        return replace(self, effects=drawn)


def _usual(name: str, scene: str) -> float:
    """Usual strength of an effect in a scene, over that of :data:`ONE`."""
    return FORCED.get(scene, 1.0) if find_effect(name).group in ("drag", "wind", "external") else 1.0


def _scaled(name: str, values: Mapping[str, Any], factor: float, turn: np.ndarray) -> dict[str, Any]:
    """Values with their coefficients multiplied and their horizontal vectors turned."""
    effect, scaled = find_effect(name), {}
    for key, value in values.items():
        new = np.asarray(value, dtype=float)
        if effect.parameters[key].linear or key in effect.coefficients:
            new = factor * new
        if new.shape == (3,):
            new = turn @ new
        scaled[key] = np.clip(new, effect.parameters[key].lower, effect.parameters[key].upper)
    return scaled


def _one(name: str, *alike: str, **values: Any) -> Hidden:
    return Hidden(name, {name: values}, alike={name: alike})


def _pair(one: str, other: str) -> Hidden:
    a, b = ONE[one], ONE[other]
    return Hidden(f"{one} and {other}", {**a.effects, **b.effects}, alike={**a.alike, **b.alike})


ONE: Mapping[str, Hidden] = {
    hidden.name: hidden
    for hidden in (
        _one("air_drag_normal", "air_drag_normal_quadratic", "wind_normal", coefficient=0.35),
        _one("air_drag_normal_quadratic", "air_drag_normal", "wind_normal_quadratic", coefficient=0.6),
        _one("air_drag_tangential", "air_drag_tangential_quadratic", "wind_tangential", coefficient=0.4),
        _one("wind_normal", "wind_normal_quadratic", coefficient=0.2, push=(0.12, 0.0, 0.08)),
        _one("wind_normal_quadratic", "wind_normal", coefficient=0.3, velocity=(0.7, 0.0, 0.5)),
        _one("wind_tangential", "wind_tangential_quadratic", coefficient=0.2, push=(0.2, 0.0, 0.2)),
        replace(
            _one("gust", cosine=(0.13, 0.0, 0.08), sine=(0.08, 0.0, -0.13)), between={"gust.frequency": (0.6, 2.4)}
        ),
        _one("uniform_acceleration", "wind_tangential", acceleration=(0.4, 0.0, 0.3)),
        _one("pressure", pressure=0.1),
        _one("mass_damping", "air_drag_tangential", "air_drag_normal", rate=1.2),
        _one("viscous_damping", viscosity=2.0),
        _one("weft_warp_stiffness", "shrinkage_directional", weft=60.0, warp=-20.0),
        _one("shear_stiffness", stiffness=40.0),
        _one("shrinkage", "shrinkage_directional", fraction=0.03),
        _one("extra_bending", "bending_anisotropy", stiffness=6e-5),
        _one("bending_anisotropy", "extra_bending", difference=4.2e-5),
        _one("natural_curvature", weft=12.0, warp=4.0),
        _one("added_mass", "extra_mass", density=0.06),
        _one("mass_gradient", "heavy_hem", gradient=0.4),
        _one("heavy_hem", "mass_gradient", "extra_mass", line_density=(0.004, 0.0, 0.0, 0.0)),
        _one("seam_tension", "shrinkage", "shrinkage_directional", tension=(0.05, 0.0, 0.0, 0.0)),
        _one("body_friction", coefficient=0.5),
        _one("contact_thickness", thickness=0.012),
    )
}
"""Single effects."""

PAIRS: Mapping[str, Hidden] = {
    hidden.name: hidden
    for hidden in (
        _pair("air_drag_normal", "shrinkage"),
        _pair("wind_normal", "extra_bending"),
        _pair("mass_damping", "natural_curvature"),
        _pair("uniform_acceleration", "shear_stiffness"),
        _pair("pressure", "heavy_hem"),
        _pair("air_drag_tangential", "mass_gradient"),
    )
}
"""Two effects at once."""

NOTHING: Mapping[str, Hidden] = {
    "nothing": Hidden("nothing"),
    "time step only": Hidden("time step only", same_mesh=True),
}
"""Nothing hidden, on another mesh and on the user's own."""

_FIXED_IN_SPACE = ("attraction", "swirl")
OUTSIDE: Mapping[str, Hidden] = {
    name: Hidden(name, outside=name, scenes=("square",) if name in _FIXED_IN_SPACE else None) for name in FORCES
}
"""Forces that no effect of the library states. People walk metres away from those that have a place in space."""

HIDDEN: Mapping[str, Hidden] = {**ONE, **PAIRS, **NOTHING, **OUTSIDE}
