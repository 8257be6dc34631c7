"""``caphy effects`` as a user types it."""

from __future__ import annotations

from pathlib import Path

import pytest

from caphy.cli import main
from caphy.effects import registry
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
    assert all(f"\n{name} " in printed for name in registered_effects())


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
    assert "known: air_drag_normal" in capsys.readouterr().err


def test_check_passes_a_good_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "check", "inertia"]) == 0
    assert "all passed" in capsys.readouterr().out


def test_check_finds_what_is_wrong_with_a_users_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.py"
    path.write_text(WRONG)
    assert main(["effects", "check", "--effect-file", str(path)]) == 1
    printed = capsys.readouterr().out
    for check in ("documented", "gradient is slope", "units fit", "same in every frame"):
        assert f"wrong  {check}: FAILED" in printed
    assert "wrong  finite: ok" in printed and "Traceback" not in printed
