"""A user's own effect file is a first-class citizen."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from caphy.effects import registry
from caphy.effects.battery import CHECKS, elements_are_their_own
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect, register_file, registered_effects
from caphy.effects.trial import irregular_cloth, moment
from caphy.errors import CaphyError

WIND = '''
"""Wind that pulls every piece of cloth along."""

from caphy.effects.base import Effect, Parameter
from caphy.effects.vectors import dot


class MyWind(Effect):
    """Drag towards a uniform wind, E = dt c a / 2 |v - w|^2 [J] per vertex."""

    name = "my_wind"
    element = "vertex"
    parameters = {
        "coefficient": Parameter(0.5, "N s/m^3", 0.0, 100.0, doc="pull per area and speed"),
        "wind": Parameter((1.0, 0.0, 0.5), "m/s", -50.0, 50.0, linear=False, doc="velocity of the air"),
    }
    reference = "a user's own"
    needs_step = True

    def rest(self, cloth):
        return {"area": cloth.vertex_area}

    def energy(self, e, p):
        (v,) = e.velocity
        slip = v - p["wind"].reshape(3, *(1,) * (v.dim() - 1))
        return 0.5 * e.dt * p["coefficient"] * e.rest["area"] * dot(slip, slip)
'''


@pytest.fixture
def wind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "my_wind.py"
    path.write_text(WIND)
    assert register_file(path) == ["my_wind"]
    return "my_wind"


def test_a_users_effect_passes_the_battery_on_its_energy_alone(wind: str) -> None:
    for check in CHECKS:
        if check.__name__ == "same_in_every_frame":
            with pytest.raises(AssertionError):  # the wind blows in a direction of the world
                check(wind)
        else:
            check(wind)


def test_an_energy_that_couples_elements_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wind that is slowed by all of the cloth together has no Hessian made of elements one by one."""
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "my_wind.py"
    path.write_text(WIND.replace("slip = v -", "slip = v - 0.5 * v.mean(-1, keepdim=True) -"))
    register_file(path)
    with pytest.raises(AssertionError, match="elements that stay where they are while others move: off by"):
        elements_are_their_own("my_wind")


def test_a_users_effect_is_listed_and_modelled(wind: str) -> None:
    assert wind in registered_effects()
    assert Model(0.2, {wind: {"coefficient": 2.0}}).effects[wind]["coefficient"] == 2.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "defines no subclass"),
        ("import nowhere_at_all", "cannot be imported: ModuleNotFoundError"),
        ("def broken(:", "cannot be imported: SyntaxError"),
        ("raise SystemExit(3)", "cannot be imported: SystemExit: 3"),
        (
            WIND.replace('Parameter(0.5, "N s/m^3", 0.0, 100.0, doc="pull per area and speed")', "0.5"),
            r"MyWind.parameters\['coefficient'\] must be Parameter\(default, .* got 0.5",
        ),
    ],
)
def test_a_bad_file_is_refused_with_its_reason(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "effect.py"
    path.write_text(text)
    with pytest.raises(CaphyError, match=message):
        register_file(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "my_wind"', 'name = "gravity"', "there already is an effect 'gravity'"),
        ('element = "vertex"', 'element = "thread"', "element must be one of vertex, edge, face, hinge"),
        ('reference = "a user\'s own"', "", "reference must say"),
        ("def energy(", "def energies(", "must define energy"),
        ('"N s/m^3"', '"K/m^3"', "parameter coefficient: a unit must be made of kg, m, .* got 'K'"),
        ("Parameter(0.5,", "Parameter(500.0,", r"coefficient: its default must lie within its bounds \[0, 100\]"),
        ("Parameter(0.5,", "Parameter(float('nan'),", "its default must lie within its bounds"),
        ("Parameter(0.5,", 'Parameter("much",', "its default must be a number or tuples of them, got 'much'"),
        ('element = "vertex"', 'element = "vertex"\n    refines = "wind"', "refines must name an effect .* got 'wind'"),
        ('element = "vertex"', 'element = "vertex"\n    refines = "wind_normal"', "must define start"),
        ('element = "vertex"', 'element = "vertex"\n    further = {"wind": (1.0,)}', "look for one number wind"),
        (
            'element = "vertex"',
            'element = "vertex"\n    further = {"speed": ()}',
            r"further must name .* got \['speed'\]",
        ),
    ],
)
def test_an_incomplete_effect_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in WIND
    path = tmp_path / "effect.py"
    path.write_text(WIND.replace(old, new))
    with pytest.raises(CaphyError, match=message):
        register_file(path)


def test_an_effect_may_refine_another_of_the_same_file_but_not_itself(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(registry, "_from_files", {})
    law = WIND.replace("my_wind", "my_law").replace("class MyWind", "class MyLaw")
    law += '    refines = "NAME"\n\n    def start(self, found):\n        return dict(found)\n'
    path = tmp_path / "effect.py"
    path.write_text(law.replace("NAME", "my_wind") + WIND)
    assert register_file(path) == ["my_law", "my_wind"]
    path.write_text(law.replace("NAME", "my_law"))
    with pytest.raises(CaphyError, match="refines must name an effect that there is, got 'my_law'"):
        register_file(path)


def test_what_lies_beside_an_effect_can_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_from_files", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "tables_of_mine.py").write_text("SPEED = 2.0\n")
    path = tmp_path / "my_wind.py"
    path.write_text(WIND.replace("class MyWind", "from tables_of_mine import SPEED\n\n\nclass MyWind"))
    assert register_file(path) == ["my_wind"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('{"area": cloth.vertex_area}', "cloth.vertex_area", r"my_wind: rest\(cloth\) must return a dictionary"),
        (
            "cloth.vertex_area}",
            "cloth.vertex_area[:3]}",
            r"must have 42 entries .* got shape \(3,\)",
        ),
        ("return 0.5 * e.dt", "return 0.5  #", r"must return the energy of each element \(42,\), got float"),
        ("return 0.5", "return torch.zeros(42)  #", "must depend on e.x or e.velocity"),
    ],
)
def test_what_is_no_effect_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, message: str
) -> None:
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "my_wind.py"
    path.write_text("import torch\n" + WIND.replace(old, new))
    (name,) = register_file(path)
    cloth = irregular_cloth()
    at = moment(cloth)
    with pytest.raises(CaphyError, match=message):
        Potential(Model(0.2, {name: {}}), cloth).gradient(at.x, at.step, at.body)


def test_an_effect_file_may_hold_dataclasses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose annotations are looked up in the module that the file is; one that fails leaves none behind."""
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "winds_of_mine.py"
    held = "from __future__ import annotations\n\nfrom dataclasses import dataclass\n\n\n"
    held += "@dataclass\nclass Table:\n    speed: float = 1.0\n\n"
    path.write_text(held + WIND)
    assert register_file(path) == ["my_wind"]
    module = sys.modules["caphy_effect_winds_of_mine"]
    path.write_text("raise ValueError")
    with pytest.raises(CaphyError, match="cannot be imported"):
        register_file(path)
    assert sys.modules.pop("caphy_effect_winds_of_mine") is module
    with pytest.raises(CaphyError, match="cannot be imported"):
        register_file(path)
    assert "caphy_effect_winds_of_mine" not in sys.modules


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaphyError, match=r"existing \.py file"):
        register_file(tmp_path / "none.py")


def test_an_unknown_effect_is_refused_with_the_known_names() -> None:
    with pytest.raises(CaphyError, match="no effect 'wnid'; known: added_mass, air_drag_normal"):
        find_effect("wnid")
