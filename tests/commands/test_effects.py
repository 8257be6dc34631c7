"""``caphy effects`` as a user types it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from caphy.cli import main
from caphy.effects import registry
from caphy.effects.model import Model
from caphy.effects.registry import registered_effects
from caphy.material.fabrics import fabric_names

WRONG = """
from caphy.effects.base import Effect


class Wrong(Effect):
    "Forgets its units and half of its gradient."
    name = "wrong"
    element = "vertex"
    reference = "nobody, nowhere"

    def energy(self, e, p):
        return (e.x[0] ** 2).sum(0)

    def gradient(self, e, p):
        return self.energy(e, p), e.x
"""


@pytest.fixture(autouse=True)
def nothing_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_from_files", {})


def test_list_names_every_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "list"]) == 0
    printed = capsys.readouterr().out
    rows = printed.splitlines()[1:]
    assert {row.split("  ")[0]: 0 for row in rows}.keys() == {effect.group for effect in registered_effects().values()}
    for name, effect in registered_effects().items():
        assert any(row.startswith(effect.group) and f" {name} " in row for row in rows)


@pytest.mark.parametrize(
    ("name", "acts"),
    [
        ("bending", "always"),
        ("inertia", "in motion"),
        ("attachment", "on a body"),
        ("body_contact", "on a body"),
        ("contact_thickness", "on a body"),
        ("body_friction", "in motion on a body"),
    ],
)
def test_list_says_when_an_effect_acts(name: str, acts: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "list"]) == 0
    (row,) = (row for row in capsys.readouterr().out.splitlines() if row.split()[1] == name)
    assert re.split("  +", row)[3] == acts


def test_history_of_a_model_without_effects_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.json").write_text(Model(0.2, {}).to_json())
    assert main(["effects", "history", str(tmp_path / "model.json")]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "no effects; 0.2 kg/m^2"


def test_list_names_every_fabric(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "list", "--fabrics"]) == 0
    printed = capsys.readouterr().out
    assert all(f"\n{name} " in printed for name in fabric_names())


def test_show_gives_formula_parameters_and_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "show", "bending"]) == 0
    printed = capsys.readouterr().out
    assert "k l^2 / (8 A)" in printed
    assert "stiffness_weft [N m] in [0, 1]" in printed and "default 3.96e-05" in printed
    assert "Reference: CaPhy eq. 8" in printed


def test_show_of_an_unknown_effect_names_the_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "show", "bendin"]) == 2
    assert "known: added_mass, air_drag_normal" in capsys.readouterr().err


def test_check_passes_a_good_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "check", "inertia"]) == 0
    assert "all passed" in capsys.readouterr().out


def test_check_finds_what_is_wrong_with_a_users_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.py"
    path.write_text(WRONG)
    assert main(["effects", "check", "--effect-file", str(path)]) == 1
    printed = capsys.readouterr().out
    for check in ("documented", "gradient is slope", "units fit", "same in every place"):
        assert f"wrong  {check}: FAILED" in printed
    assert "wrong  finite: ok" in printed and "Traceback" not in printed
    assert "it may say: lacks" not in printed  # amid what no effect rightly lacks


def test_a_property_that_there_is_not_cannot_be_lacked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.py"
    assert main(["effects", "new", "mine", "-o", str(path)]) == 0
    path.write_text(path.read_text().replace("needs_step", 'lacks = {"units": "none"}\n    needs_step'))
    assert main(["effects", "check", "--effect-file", str(path)]) == 1
    assert "there is no property 'units'; there are batch_equals_loop" in capsys.readouterr().out


def test_what_is_no_effect_is_said_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.py"
    assert main(["effects", "new", "mine", "-o", str(path)]) == 0
    path.write_text(path.read_text().replace('{"area": cloth.vertex_area}', "[]"))
    assert main(["effects", "check", "--effect-file", str(path)]) == 1
    printed = capsys.readouterr().out
    assert printed.count("FAILED") == 1 and "dictionary, name -> array, got list; the rest was not tried" in printed


def test_show_says_what_an_addition_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "show", "shrinkage"]) == 0
    printed = capsys.readouterr().out
    assert "needs strain_stvk or strain_measured" in printed and "does nothing where zero: fraction" in printed


def test_a_new_effect_works_as_it_is_begun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "sticky_air.py"
    assert main(["effects", "new", "sticky_air", "-o", str(path)]) == 0
    assert f"caphy effects check --effect-file {path}" in capsys.readouterr().out
    assert main(["effects", "check", "--effect-file", str(path)]) == 0
    assert "sticky_air  gradient is slope: ok" in capsys.readouterr().out
    assert [file.name for file in tmp_path.iterdir()] == ["sticky_air.py"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gravity", "there already is an effect 'gravity'"),
        ("Sticky", "lower case"),
        ("lambda", "no word of Python's"),
        ("two words", "lower case"),
    ],
)
def test_a_new_effect_needs_a_name_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, message: str
) -> None:
    assert main(["effects", "new", name, "-o", str(tmp_path / "effect.py")]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_new_effect_overwrites_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.py"
    path.write_text("mine")
    assert main(["effects", "new", "mine", "-o", str(path)]) == 2
    assert "exists already" in capsys.readouterr().err and path.read_text() == "mine"
    assert main(["effects", "new", "mine", "-o", str(tmp_path / "nowhere" / "mine.py")]) == 2
    assert "cannot be written" in capsys.readouterr().err
